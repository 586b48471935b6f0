"""From a task's teammate entry to a playing teammate, and back."""

from __future__ import annotations

import hashlib
import math
from numbers import Real
from typing import Any

import jax
import numpy as np

from generation.teammates import assembly_line, recipe_aware_button, territory, utility_greedy
from generation.teammates.base import Noise, Policy, Sampling
from icrl4aht_data.benchmark import SPLITS, TEAMMATE, unknown
from icrl4aht_data.errors import TaskFormatError
from icrl4aht_data.overcooked.layouts import Layout

_FAMILIES = {module.KIND: module for module in (recipe_aware_button, territory, assembly_line, utility_greedy)}

_CHOICES: dict[str, dict[str, int]] = {
    territory.KIND: territory.CHOICES,
    assembly_line.KIND: assembly_line.CHOICES,
}

_H4_TRAIN = Sampling(
    ("default", "delivery_focused"),
    {
        "w_deliver": (8.0, 18.0),
        "w_pickup_cooked": (6.0, 14.0),
        "w_add_ingredient": (3.0, 8.0),
        "dist_weight": (0.2, 0.7),
        "inertia": (0.1, 0.5),
    },
)
_H4_TEST = Sampling(
    ("prep_focused", "high_inertia", "distance_sensitive"),
    {
        "w_deliver": (5.0, 12.0),
        "w_pickup_cooked": (3.0, 8.0),
        "w_add_ingredient": (7.0, 12.0),
        "dist_weight": (0.6, 1.2),
        "inertia": (0.5, 0.9),
    },
)
_H4_SPANS = {
    "w_deliver": (5.0, 20.0),
    "w_pickup_cooked": (3.0, 15.0),
    "w_get_plate": (2.0, 10.0),
    "w_add_ingredient": (3.0, 12.0),
    "w_fetch_ingredient": (2.0, 10.0),
    "w_stage_on_counter": (0.5, 5.0),
    "w_start_cooking": (3.0, 15.0),
    "w_press_L": (1.0, 8.0),
    "dist_weight": (0.1, 1.5),
    "inertia": (0.0, 1.0),
    "counter_preference": (0.0, 1.0),
}

_SAMPLING: dict[str, tuple[Sampling, Sampling, dict[str, tuple[float, float]]]] = {
    utility_greedy.KIND: (_H4_TRAIN, _H4_TEST, _H4_SPANS),
    **{m.KIND: (m.TRAIN, m.TEST, m.SPANS) for m in (recipe_aware_button, territory, assembly_line)},
}
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
    if split not in SPLITS:
        raise unknown("split", split, SPLITS)
    *samplings, spans = _SAMPLING[family]
    presets, ranges = samplings[SPLITS.index(split)]
    digest = hashlib.sha256(f"{family}:{theta_id}:{split}:{base_seed}".encode()).hexdigest()
    key, own = jax.random.split(jax.random.key(int(digest[:8], 16)))
    theta = module.DEFAULTS | module.PRESETS[presets[_below(own, len(presets))]]
    for name, value in theta.items():
        key, own = jax.random.split(key)
        if isinstance(ranges.get(name), list):
            theta[name] = ranges[name][_below(own, len(ranges[name]))]
        elif name in ranges:
            theta[name] = _between(own, *ranges[name])
        elif name in spans:
            low, high = spans[name]
            away = _JITTER * (high - low)
            theta[name] = _between(own, max(value - away, low), min(value + away, high))
        elif isinstance(value, float):
            theta[name] = float(np.float32(value))
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": base_seed, "theta": theta}


def _below(key: jax.Array, n: int) -> int:
    return int(jax.random.randint(key, (), 0, n))


def _between(key: jax.Array, low: float, high: float) -> float:
    return float(jax.random.uniform(key, (), minval=low, maxval=high))


def build(layout: Layout, teammate: dict[str, Any], slot: int = TEAMMATE, noise: Noise = "seeded") -> Policy:
    """The policy of a task's teammate entry.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: for unknown or missing parameters and impossible values; names them.
    """
    module = _module(teammate["family"])
    theta = teammate["theta"]
    if set(theta) != set(module.DEFAULTS):
        raise TaskFormatError(
            f"teammate {teammate['family']}: missing parameters {sorted(set(module.DEFAULTS) - set(theta))}, "
            f"unknown parameters {sorted(set(theta) - set(module.DEFAULTS))}"
        )
    wrong = {name: value for name, value in theta.items() if not _possible(module, name, value)}
    if wrong:
        raise TaskFormatError(f"teammate {teammate['family']}: impossible parameters {_in_words(module, wrong)}")
    return module.build(layout, theta, slot, noise)


def _possible(module, name: str, value: Any) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        return False
    number, choices = float(value), _CHOICES.get(module.KIND, {}).get(name, math.inf)
    return isinstance(module.DEFAULTS[name], float) or (number.is_integer() and 0 <= number < choices)


def _in_words(module, wrong: dict[str, Any]) -> str:
    def expected(name: str) -> str:
        choices = _CHOICES.get(module.KIND, {}).get(name)
        whole = "a whole number from 0" if isinstance(module.DEFAULTS[name], int) else "a number"
        return f"one of 0..{choices - 1}" if choices else whole

    return ", ".join(f"{name} = {value!r} (expected {expected(name)})" for name, value in wrong.items())


def _module(family: str):
    if family not in _FAMILIES:
        raise unknown("teammate family", family, _FAMILIES)
    return _FAMILIES[family]
