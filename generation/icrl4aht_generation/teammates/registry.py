"""Conversion of a task's teammate entry to a policy, and back."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import TEAMMATE_PLUGINS
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError, TaskFormatError, check_choice, unknown
from icrl4aht_data.format.schema import TEAMMATES
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_generation.policy import Noise, Policy
from icrl4aht_generation.teammates import learned
from icrl4aht_generation.teammates.heuristics.assembly_line import ASSEMBLY_LINE
from icrl4aht_generation.teammates.heuristics.heuristic import RANDOM_ACTIONS, Heuristic
from icrl4aht_generation.teammates.heuristics.recipe_aware_button import RECIPE_AWARE_BUTTON
from icrl4aht_generation.teammates.heuristics.territory import TERRITORY
from icrl4aht_generation.teammates.heuristics.utility_greedy import UTILITY_GREEDY

HEURISTIC_FAMILIES = {
    heuristic.kind: heuristic for heuristic in (RECIPE_AWARE_BUTTON, TERRITORY, ASSEMBLY_LINE, UTILITY_GREEDY)
}
"""The heuristics of the benchmark by kind; other installed packages register further ones."""

_JITTER = 0.2
"""Largest distance of a sampled parameter from its preset, as a share of its full range."""


def heuristic_teammate(family: str, preset: str, theta_id: int) -> dict[str, Any]:
    """Return the teammate entry of a heuristic's preset, every parameter explicit.

    Raises:
        UnknownNameError: for a family or preset that does not exist.
    """
    heuristic = _family(family)
    check_choice(f"preset of {family}", preset, heuristic.presets)
    theta = heuristic.defaults | heuristic.presets[preset]
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": 0, "theta": theta}


def sample_teammate(family: str, theta_id: int, split: str, base_seed: int = 0) -> dict[str, Any]:
    """Return a teammate entry with preset and parameters drawn by the string `family:theta_id:split:base_seed`.

    Published tasks do not come from here: their manifests state every parameter (paper, App. B.2, train and test
    ranges).

    Args:
        family: a heuristic's name.
        theta_id: any number that distinguishes the draws.
        split: "train" or "test", which have ranges of their own, or "diverse", see `Heuristic.diverse`.
        base_seed: shared by the draws of one run.

    Returns:
        The entry, every parameter explicit: float32 values as floats, integers as ints.

    Raises:
        UnknownNameError: for a family or split that does not exist.
    """
    heuristic = _family(family)
    samplings = {"train": heuristic.train, "test": heuristic.test}
    samplings |= {"diverse": heuristic.diverse} if heuristic.diverse else {}
    check_choice("split", split, samplings)
    presets, ranges = samplings[split]
    # A hash, because a draw must depend neither on the order of draws nor on Python's own salted hashes.
    digest = hashlib.sha256(f"{family}:{theta_id}:{split}:{base_seed}".encode()).hexdigest()
    key, own = jax.random.split(jax.random.key(int(digest[:8], 16)))
    theta = heuristic.defaults | heuristic.presets[presets[_randint(own, len(presets))]]
    for name, value in theta.items():
        key, own = jax.random.split(key)  # for every parameter, drawn or not: ranges can change one by one
        if isinstance(ranges.get(name), list):
            theta[name] = ranges[name][_randint(own, len(ranges[name]))]
        elif name in ranges:
            theta[name] = _uniform(own, *ranges[name])
        elif name in heuristic.spans:
            low, high = heuristic.spans[name]
            distance = _JITTER * (high - low)
            theta[name] = _uniform(own, max(value - distance, low), min(value + distance, high))
        elif isinstance(value, float):
            theta[name] = float(np.float32(value))
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": base_seed, "theta": theta}


def _randint(key: jax.Array, n: int) -> int:
    return int(jax.random.randint(key, (), 0, n))


def _uniform(key: jax.Array, low: float, high: float) -> float:
    """Draws a float32 that is rounded once, whatever XLA does: with other options it rounds product and sum."""
    least, width = np.float32(low), np.float32(high) - np.float32(low)
    drawn = np.float64(jax.random.uniform(key, ())) * np.float64(width) + np.float64(least)
    return float(max(np.float32(drawn), least))


def build_teammate(
    layout: Layout | None,
    teammate: dict[str, Any],
    slot: int = TEAMMATE,
    noise: Noise = "seeded",
    suite: Path | None = None,
) -> Policy:
    """Return the policy of a task's teammate entry; learned ones act greedily.

    Args:
        layout: the layout whose state records or observations it sees; None for a heuristic that sees a `Situation`,
            and so plays every layout.
        teammate: a heuristic's parameters, or a checkpoint; see `icrl4aht_data.benchmark.tasks.Task`.
        slot: 0 or 1, the agent it plays.
        noise: source of a heuristic's randomness, see `icrl4aht_generation.policy.Noise`.
        suite: folder of the checkpoints: a suite, or the folder TEAMMATES of a release.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: for unknown or missing parameters, values out of range, and slots other than 0 and 1.
        OptionError: for a checkpoint that is missing or does not fit the layout.
    """
    if slot not in (EGO, TEAMMATE):
        raise TaskFormatError(f"teammate {teammate['family']}: slot {slot!r}, expected {EGO} or {TEAMMATE}")
    if teammate.get("kind") == "rl":
        if layout is None:
            raise OptionError(f"teammate {teammate['theta']['checkpoint']}: a checkpoint plays one layout, give it")
        return learned.build_learned_entry(layout, teammate, suite)
    check_theta(teammate)
    return _family(teammate["family"]).build(layout, teammate["theta"], slot, noise)


def with_equal_parameters(teammates: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return entries of which all of one family have `RANDOM_ACTIONS` if any has, so that they play in one program."""
    mixed = {entry["family"] for entry in teammates if RANDOM_ACTIONS in entry["theta"]}
    return [
        entry | {"theta": {RANDOM_ACTIONS: 0.0} | entry["theta"]} if entry["family"] in mixed else entry
        for entry in teammates
    ]


def recover_teammate(dataset: Dataset, history_id: int, episode: int = 0) -> Policy:
    """Return the teammate of a history, as it played an episode; the number matters only where teammates change.

    Raises:
        OptionError: if the release does not hold the teammate's checkpoint.
    """
    entry = dataset.recover_teammate(history_id, episode)
    if entry["kind"] == "rl" and not dataset.origin.below(f"{TEAMMATES}/{entry['theta']['sha256']}").is_dir():
        raise OptionError(
            f"{dataset.root / TEAMMATES}: checkpoint {entry['theta']['sha256']} is missing, the teammate of history "
            f"{history_id}: this release was made without it; copy it from the release that it was made of"
        )
    layout = get_layout(dataset.index.entry(history_id).layout)
    slot, noise = entry.get("slot", TEAMMATE), entry.get("noise", "seeded")
    return build_teammate(layout, entry, slot, noise, dataset.root / TEAMMATES)


def check_theta(teammate: dict[str, Any]) -> None:
    """Validate a heuristic's entry: every parameter, perhaps `RANDOM_ACTIONS`, no other, and each within its range.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: names the parameter, what was found and what was expected.
    """
    theta, kind = teammate["theta"], _family(teammate["family"]).theta_type
    try:
        msgspec.convert(theta, kind)
    except msgspec.ValidationError as error:
        problem = str(error).replace("Expected", "expected")
        raise TaskFormatError(
            f"teammate {teammate['family']}: parameters: {problem}; expected {', '.join(kind.__struct_fields__)}, the "
            f"last one optional, found {theta!r:.500}"
        ) from error


def _family(name: str) -> Heuristic:
    if name in HEURISTIC_FAMILIES:
        return HEURISTIC_FAMILIES[name]
    if name not in TEAMMATE_PLUGINS.names:
        raise unknown("teammate family", name, (*HEURISTIC_FAMILIES, *TEAMMATE_PLUGINS.names))
    heuristic = TEAMMATE_PLUGINS.load(name, Heuristic)
    if heuristic.kind != name:
        raise TEAMMATE_PLUGINS.error(name, f"expected kind {name!r}, found {heuristic.kind!r}")
    return heuristic
