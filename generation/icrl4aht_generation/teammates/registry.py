"""Conversion of a task's teammate entry to a policy, and creation of entries."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import TEAMMATE_PLUGINS
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError, TaskFormatError, check_choice, unknown_name
from icrl4aht_data.format.schema import TEAMMATES
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.files import short_hash
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
"""Heuristic families of the benchmark by kind; other installed packages can register more families."""

_JITTER = 0.2
"""Maximum distance of a sampled parameter from its preset, as a share of the parameter's full range."""


def heuristic_entry(family: str, theta_id: int, base_seed: int, theta: dict[str, Any]) -> dict[str, Any]:
    """Return the teammate entry of a heuristic with the given values of all parameters."""
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": base_seed, "theta": theta}


def heuristic_teammate(family: str, preset: str, theta_id: int) -> dict[str, Any]:
    """Return the teammate entry of a heuristic's preset, with explicit values of all parameters.

    Raises:
        UnknownNameError: if the family or the preset does not exist.
    """
    heuristic = _family(family)
    check_choice(f"preset of {family}", preset, heuristic.presets)
    return heuristic_entry(family, theta_id, 0, heuristic.defaults | heuristic.presets[preset])


def sample_teammate(family: str, theta_id: int, split: str, base_seed: int = 0) -> dict[str, Any]:
    """Return a teammate entry with random parameters, seeded by the string `family:theta_id:split:base_seed`.

    The ranges of the splits "train" and "test" are the paper's (App. B.2). Teammates of the published manifests are not
    sampled, because the manifests contain every parameter.

    Args:
        family: name of a heuristic.
        theta_id: number of the sampled teammate.
        split: ranges of the parameters: "train", "test", or "diverse", see `Heuristic.diverse`.
        base_seed: seed that a set of sampled teammates shares.

    Returns:
        The entry with all parameters: float32 values as floats, integers as ints.

    Raises:
        UnknownNameError: if the family or the split does not exist.
    """
    theta = _sampled_theta(_family(family), split, f"{family}:{theta_id}:{split}:{base_seed}")
    return heuristic_entry(family, theta_id, base_seed, dict(theta))


@cache  # several callers sample the same parameters, and each sample takes many JAX calls
def _sampled_theta(heuristic: Heuristic, split: str, seed: str) -> dict[str, float]:
    samplings = {"train": heuristic.train, "test": heuristic.test}
    samplings |= {"diverse": heuristic.diverse} if heuristic.diverse else {}
    check_choice("split", split, samplings)
    presets, ranges = samplings[split]
    # A SHA-256 hash as seed depends neither on the order of calls nor on Python's salted hashes.
    key, own = jax.random.split(jax.random.key(int(short_hash(seed.encode(), 8), 16)))
    theta = heuristic.defaults | heuristic.presets[presets[_randint(own, len(presets))]]
    for name, value in theta.items():
        key, own = jax.random.split(key)  # also for fixed parameters, so no draw depends on which others have ranges
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
    return theta


def _randint(key: jax.Array, n: int) -> int:
    return int(jax.random.randint(key, (), 0, n))


def _uniform(key: jax.Array, low: float, high: float) -> float:
    """Return a random float32 that is rounded only once, so the value does not depend on options of XLA."""
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
    """Return the policy of a task's teammate entry; learned teammates act greedily.

    Args:
        layout: layout of the state records or observations that the teammate sees; None makes a heuristic that sees a
            `Situation` and can play on any layout.
        teammate: a heuristic's parameters, or a checkpoint; see `icrl4aht_data.benchmark.tasks.Task`.
        slot: 0 or 1, the agent that the teammate plays.
        noise: source of a heuristic's randomness, see `icrl4aht_generation.policy.Noise`.
        suite: folder of the checkpoints: a suite, or the folder TEAMMATES of a release.

    Raises:
        UnknownNameError: if the family does not exist.
        TaskFormatError: if parameters are unknown, missing or out of range, or the slot is not 0 or 1.
        OptionError: if a checkpoint is missing or does not match the layout.
    """
    if slot not in (EGO, TEAMMATE):
        raise TaskFormatError(f"teammate {teammate['family']}: expected slot {EGO} or {TEAMMATE}, found {slot!r}")
    if teammate.get("kind") == "rl":
        if layout is None:
            raise OptionError(f"teammate {teammate['theta']['checkpoint']}: a checkpoint needs `layout`, found None")
        return learned.build_learned_entry(layout, teammate, suite)
    check_theta(teammate)
    return _family(teammate["family"]).build(layout, teammate["theta"], slot, noise)


def with_equal_parameter_names(teammates: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add `RANDOM_ACTIONS` to all entries of a family if any entry has it, so they share a compilation."""
    mixed = {entry["family"] for entry in teammates if RANDOM_ACTIONS in entry["theta"]}
    return [
        entry | {"theta": {RANDOM_ACTIONS: 0.0} | entry["theta"]} if entry["family"] in mixed else entry
        for entry in teammates
    ]


def recover_teammate(dataset: Dataset, history_id: int, episode: int = 0) -> Policy:
    """Return the policy of a history's teammate in an episode; the episode only matters if the teammate changes.

    Raises:
        OptionError: if the release does not contain the teammate's checkpoint.
    """
    entry = dataset.recover_teammate(history_id, episode)
    if entry["kind"] == "rl" and not dataset.origin.fetch_folder(f"{TEAMMATES}/{entry['theta']['sha256']}").is_dir():
        raise OptionError(
            f"{dataset.root / TEAMMATES}: no checkpoint {entry['theta']['sha256']}, the teammate of history "
            f"{history_id}; copy the checkpoint from the release that this release was made from"
        )
    layout = get_layout(dataset.index.entry(history_id).layout)
    slot, noise = entry.get("slot", TEAMMATE), entry.get("noise", "seeded")
    return build_teammate(layout, entry, slot, noise, dataset.root / TEAMMATES)


def check_theta(teammate: dict[str, Any]) -> None:
    """Validate that a heuristic's entry has all parameters within their ranges, and no unknown parameters.

    Raises:
        UnknownNameError: if the family does not exist.
        TaskFormatError: if a parameter is invalid; the message names the parameter and the expected values.
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
        raise unknown_name("teammate family", name, (*HEURISTIC_FAMILIES, *TEAMMATE_PLUGINS.names))
    heuristic = TEAMMATE_PLUGINS.load(name, Heuristic)
    if heuristic.kind != name:
        raise TEAMMATE_PLUGINS.error(name, f"expected kind {name!r}, found {heuristic.kind!r}")
    return heuristic
