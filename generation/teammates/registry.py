"""From a task's teammate entry to a playing teammate, and back."""

from __future__ import annotations

from typing import Any

from generation.teammates import utility_greedy
from generation.teammates.base import Noise, Policy
from icrl4aht_data.benchmark import TEAMMATE, unknown
from icrl4aht_data.errors import TaskFormatError
from icrl4aht_data.overcooked.layouts import Layout

_FAMILIES = {utility_greedy.KIND: utility_greedy}


def heuristic_teammate(family: str, preset: str, theta_id: int) -> dict[str, Any]:
    """The teammate entry of a heuristic's preset, every parameter explicit."""
    module = _module(family)
    if preset not in module.PRESETS:
        raise unknown(f"preset of {family}", preset, module.PRESETS)
    theta = module.DEFAULTS | module.PRESETS[preset]
    return {"kind": "heuristic", "family": family, "theta_id": theta_id, "base_seed": 0, "theta": theta}


def build(layout: Layout, teammate: dict[str, Any], slot: int = TEAMMATE, noise: Noise = "seeded") -> Policy:
    """The policy of a task's teammate entry.

    Raises:
        UnknownNameError: for a family that does not exist.
        TaskFormatError: for unknown or missing parameters; names them.
    """
    module = _module(teammate["family"])
    theta = teammate["theta"]
    if set(theta) != set(module.DEFAULTS):
        raise TaskFormatError(
            f"teammate {teammate['family']}: missing parameters {sorted(set(module.DEFAULTS) - set(theta))}, "
            f"unknown parameters {sorted(set(theta) - set(module.DEFAULTS))}"
        )
    return module.build(layout, theta, slot, noise)


def _module(family: str):
    if family not in _FAMILIES:
        raise unknown("teammate family", family, _FAMILIES)
    return _FAMILIES[family]
