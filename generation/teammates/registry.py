"""From a task's teammate entry to a playing teammate, and back."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from numbers import Real
from pathlib import Path
from typing import Any

import jax
import numpy as np

from generation.policy import Noise, Policy, as_params
from generation.teammates import learned
from generation.teammates.heuristics import assembly_line, recipe_aware_button, territory, utility_greedy
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError, TaskFormatError, unknown
from icrl4aht_data.format.schema import TEAMMATES
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_FAMILIES = {module.KIND: module for module in (recipe_aware_button, territory, assembly_line, utility_greedy)}

_JITTER = 0.2
"""How far a sampled parameter strays from its preset, as a share of its full range."""


def heuristic_teammate(family: str, preset: str, theta_id: int) -> dict[str, Any]:
    """The teammate entry of a heuristic's preset, every parameter explicit."""
    module = _module(family)
    if preset not in module.PRESETS:
        raise unknown(f"preset of {family}", preset, module.PRESETS)
    theta = module.DEFAULTS | module.PRESETS[preset]
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": 0, "theta": theta}


def sample(family: str, theta_id: int, split: str, base_seed: int = 0) -> dict[str, Any]:
    """The teammate entry whose preset and parameters are drawn by the string `family:theta_id:split:base_seed`.

    No published task comes from here: their manifests give every parameter (paper, App. B.2, train and test ranges).

    Args:
        family: a heuristic's name.
        theta_id: any number that tells the draws apart.
        split: "train" or "test", which have ranges of their own.
        base_seed: shared by the draws of one run.

    Returns:
        The entry, every parameter explicit: float32 values as floats, whole numbers as ints.

    Raises:
        UnknownNameError: for a family or split that does not exist.
    """
    module = _module(family)
    samplings = {"train": module.TRAIN, "test": module.TEST}
    if split not in samplings:
        raise unknown("split", split, samplings)
    presets, ranges = samplings[split]
    digest = hashlib.sha256(f"{family}:{theta_id}:{split}:{base_seed}".encode()).hexdigest()
    key, own = jax.random.split(jax.random.key(int(digest[:8], 16)))
    theta = module.DEFAULTS | module.PRESETS[presets[_below(own, len(presets))]]
    for name, value in theta.items():
        key, own = jax.random.split(key)
        if isinstance(ranges.get(name), list):
            theta[name] = ranges[name][_below(own, len(ranges[name]))]
        elif name in ranges:
            theta[name] = _between(own, *ranges[name])
        elif name in module.SPANS:
            low, high = module.SPANS[name]
            away = _JITTER * (high - low)
            theta[name] = _between(own, max(value - away, low), min(value + away, high))
        elif isinstance(value, float):
            theta[name] = float(np.float32(value))
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": base_seed, "theta": theta}


def _below(key: jax.Array, n: int) -> int:
    return int(jax.random.randint(key, (), 0, n))


def _between(key: jax.Array, low: float, high: float) -> float:
    return float(jax.random.uniform(key, (), minval=low, maxval=high))


def build(
    layout: Layout,
    teammate: dict[str, Any],
    slot: int = TEAMMATE,
    noise: Noise = "seeded",
    suite: Path | None = None,
) -> Policy:
    """The policy of a task's teammate entry; learned ones act greedily.

    Args:
        layout: the kitchen.
        teammate: a heuristic's parameters, or a checkpoint; see `icrl4aht_data.benchmark.tasks.Task`.
        slot: 0 or 1, the agent it plays.
        noise: of heuristics, see `base.Noise`.
        suite: the folder that checkpoints are in: a suite, or TEAMMATES of a release.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: for unknown or missing parameters, values out of range, and slots other than 0 and 1.
        OptionError: for a checkpoint that is missing or does not fit the layout.
    """
    if slot not in (EGO, TEAMMATE):
        raise TaskFormatError(f"teammate {teammate['family']}: slot {slot!r}, expected {EGO} or {TEAMMATE}")
    if teammate.get("kind") == "rl":
        return learned.build_entry(layout, teammate, suite)
    check_theta(teammate)
    module = _module(teammate["family"])
    return _default(module, layout, slot, noise)._replace(params=as_params(teammate["theta"], module.DEFAULTS))


def recover_teammate(dataset: Dataset, history_id: int) -> Policy:
    """The teammate of a history, as it played.

    Raises:
        OptionError: if the release does not hold the teammate's checkpoint.
    """
    entry = dataset.recover_teammate(history_id)
    if entry["kind"] == "rl" and not dataset.origin.below(f"{TEAMMATES}/{entry['theta']['sha256']}").is_dir():
        raise OptionError(
            f"{dataset.root / TEAMMATES}: lacks checkpoint {entry['theta']['sha256']}, the teammate of history "
            f"{history_id}: this release came without it; take it from the release that it was made of"
        )
    layout = get_layout(dataset.index.entry(history_id).layout)
    return build(layout, entry, entry.get("slot", TEAMMATE), entry.get("noise", "seeded"), dataset.root / TEAMMATES)


@lru_cache(maxsize=64)
def _default(module, layout: Layout, slot: int, noise: Noise) -> Policy:
    """The family's default; its functions serve all teammates of the family, so that they share compilations."""
    return module.build(layout, module.DEFAULTS, slot, noise)


def check_theta(teammate: dict[str, Any]) -> None:
    """Whether a heuristic's entry has every parameter, no other, and each within its range.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: names the parameters, what was found and what was expected.
    """
    module, theta = _module(teammate["family"]), teammate["theta"]
    if set(theta) != set(module.DEFAULTS):
        raise TaskFormatError(
            f"teammate {teammate['family']}: missing parameters {sorted(set(module.DEFAULTS) - set(theta))}, "
            f"unknown parameters {sorted(set(theta) - set(module.DEFAULTS))}"
        )
    wrong = [
        f"{name} = {value!r} (expected {_expected(module, name)})"
        for name, value in theta.items()
        if not _possible(module, name, value)
    ]
    if wrong:
        raise TaskFormatError(f"teammate {teammate['family']}: out of range: {', '.join(wrong)}")


def _possible(module, name: str, value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        return False
    whole = isinstance(module.DEFAULTS[name], float) or float(value).is_integer()
    return whole and 0 <= float(value) <= _highest(module, name)


def _highest(module, name: str) -> float:
    if name in module.CHOICES:
        return module.CHOICES[name] - 1
    return math.inf if name in module.UNBOUNDED else 1.0


def _expected(module, name: str) -> str:
    kind = "a whole number" if isinstance(module.DEFAULTS[name], int) else "a number"
    highest = _highest(module, name)
    return f"{kind} from 0" if math.isinf(highest) else f"{kind} in 0..{highest:g}"


def _module(family: str):
    if family not in _FAMILIES:
        raise unknown("teammate family", family, _FAMILIES)
    return _FAMILIES[family]
