"""The published test instances: five parameter sets of each heuristic family, and the 160 test tasks made of them.

H1 and H2 have sets of their own for cramped_down; H3 and H4 are the same on every layout. Source: the published
manifests; the tasks' ids hash to the published ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS, track_of
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import unknown
from icrl4aht_data.overcooked.layouts import get_layout

ParameterSets = dict[str, tuple[float, ...]]
"""Parameter -> values in t0..t4, parameters in order of declaration."""

_H1: ParameterSets = {
    "press_L_when_unknown": (0.8, 0.1, 0.3, 0.02, 0.7),
    "refresh_interval": (100, 300, 200, 1000, 100),
    "cost_sensitivity": (0.1, 0.9, 0.5, 0.98, 0.2),
    "strict_recipe": (0.9, 0.1, 0.4, 0.02, 0.8),
    "exploration_bias": (0.0, 0.8, 0.4, 0.8, 0.1),
    "plate_timing": (0.0, 0.1, 0.2, 0.05, 0.95),
    "dist_weight": (0.3, 0.1, 0.05, 0.1, 0.4),
    "inertia": (0.5, 0.2, 0.95, 0.3, 0.8),
    "task_specialization": (1.0, 0.0, 0.0, 0.0, 1.0),
    "stubbornness": (0.3, 0.5, 0.9, 0.7, 0.7),
    "wrong_ingredient_prob": (0.0, 0.9, 0.3, 0.98, 0.0),
    "idle_prob": (0.1, 0.75, 0.6, 0.7, 0.15),
    "path_blocking": (0.0, 0.4, 0.85, 0.6, 0.3),
}
_H1_CRAMPED: ParameterSets = _H1 | {
    "press_L_when_unknown": (0.9, 0.5, 0.3, 0.2, 0.7),
    "refresh_interval": (80, 120, 200, 250, 100),
    "cost_sensitivity": (0.1, 0.4, 0.7, 0.8, 0.2),
    "strict_recipe": (0.9, 0.5, 0.3, 0.2, 0.7),
    "exploration_bias": (0.0, 0.2, 0.5, 0.4, 0.1),
    "plate_timing": (0.0, 0.3, 0.25, 0.4, 0.9),
    "dist_weight": (0.15, 0.1, 0.2, 0.25, 0.2),
    "inertia": (0.85, 0.95, 0.7, 0.6, 0.75),
    "stubbornness": (0.6, 0.9, 0.4, 0.5, 0.6),
    "wrong_ingredient_prob": (0.0, 0.2, 0.5, 0.8, 0.0),
    "idle_prob": (0.2, 0.3, 0.6, 0.15, 0.2),
    "path_blocking": (0.1, 0.8, 0.3, 0.2, 0.15),
}
_H2: ParameterSets = {
    "split_mode": (0, 0, 1, 0, 0),
    "strictness": (0.5, 0.3, 0.2, 0.4, 0.8),
    "shared_margin": (1, 2, 1, 1, 0),
    "rescue_threshold": (0.9, 0.9, 0.9, 0.95, 0.95),
    "yield_bias": (0.05, 0.1, 0.2, 0.05, 0.02),
    "behavior_mode": (1, 2, 3, 4, 5),
    "action_probability": (1.0, 1.0, 0.15, 1.0, 1.0),
}
_H2_CRAMPED: ParameterSets = _H2 | {
    "strictness": (0.7, 0.6, 0.5, 0.65, 0.9),
    "shared_margin": (0, 1, 1, 1, 0),
    "rescue_threshold": (0.95, 0.9, 0.9, 0.95, 0.95),
    "yield_bias": (0.01, 0.05, 0.1, 0.02, 0.01),
    "action_probability": (1.0, 1.0, 0.1, 1.0, 1.0),
}
_H3: ParameterSets = {
    "role_mode": (2, 2, 0, 2, 1),
    "handoff_style": (0, 1, 2, 0, 1),
    "plate_urgency": (0.5, 0.4, 0.2, 0.6, 0.3),
    "prestage_bias": (0.3, 0.2, 0.6, 0.4, 0.5),
    "start_cook_bias": (0.6, 0.5, 0.4, 0.7, 0.3),
    "hesitation_prob": (0.4, 0.1, 0.15, 0.1, 0.2),
    "wrong_action_prob": (0.0, 0.35, 0.0, 0.1, 0.05),
    "task_abandon_prob": (0.0, 0.1, 0.0, 0.3, 0.1),
    "stubbornness": (0.0, 0.0, 0.5, 0.0, 0.2),
    "timing_mismatch": (0.3, 0.0, 0.2, 0.1, 0.5),
}
_H4: ParameterSets = {
    "w_deliver": (18.0, 6.0, 10.0, 10.0, 9.0),
    "w_pickup_cooked": (15.0, 4.0, 8.0, 9.0, 7.0),
    "w_get_plate": (10.0, 3.0, 6.0, 6.0, 6.0),
    "w_add_ingredient": (5.0, 14.0, 8.0, 7.0, 8.0),
    "w_fetch_ingredient": (4.0, 12.0, 7.0, 5.0, 7.0),
    "w_stage_on_counter": (1.0, 4.0, 3.0, 2.0, 8.0),
    "w_start_cooking": (8.0, 16.0, 9.0, 8.0, 6.0),
    "w_press_L": (0.0, 0.0, 0.0, 0.0, 0.0),
    "dist_weight": (0.3, 0.4, 1.5, 0.5, 0.4),
    "inertia": (0.4, 0.5, 0.2, 0.85, 0.3),
    "counter_preference": (0.3, 0.7, 0.5, 0.5, 0.9),
}

_FAMILIES = {"recipe_aware_button": _H1, "territory": _H2, "assembly_line": _H3, "utility_greedy": _H4}
_CRAMPED = _FAMILIES | {"recipe_aware_button": _H1_CRAMPED, "territory": _H2_CRAMPED}

TESTED_FAMILIES = tuple(_FAMILIES)
"""Families with test instances: those of the paper."""

INSTANCES = 5


def published_thetas(layout: str, family: str) -> list[dict[str, Any]]:
    """Return the published parameter sets t0..t4 of a family on a layout (short name)."""
    sets = (_CRAMPED if layout == "cramped_down" else _FAMILIES)[family]
    return [{name: _published(values[t], family) for name, values in sets.items()} for t in range(INSTANCES)]


def _published(value: float, family: str) -> float:
    """A value as in the manifests: integers unchanged, other numbers of H1 to H3 rounded to float32, of H4 not."""
    if isinstance(value, int) or family == "utility_greedy":
        return value
    return float(np.float32(value))


def published_task(layout: str, teammate: str) -> Task:
    """Return the test task of a layout, of the test or the training split, with a teammate such as "H3/t1".

    Raises:
        UnknownNameError: for an unknown layout, family or instance.
    """
    name = get_layout(layout).name
    names = {f"{HEURISTIC_KINDS[family]}/t{t}": (family, t) for family in _FAMILIES for t in range(INSTANCES)}
    if teammate not in names:
        raise unknown("teammate", teammate, names)
    track = track_of(name)
    split = "test" if name in TRACKS[track]["test"] else "train"
    return make_task(track, split, name, published_teammate(name, *names[teammate]), seed=0)


def published_teammate(layout: str, family: str, number: int) -> dict[str, Any]:
    """Return the teammate entry of a test instance on a layout (short name), as in a task."""
    theta = published_thetas(layout, family)[number]
    return {"kind": "heuristic", "family": family, "theta_id": number, "base_seed": 0, "theta": theta}


def published_tasks(track: str) -> list[Task]:
    """Return the published test tasks of a track, by layout, family and instance."""
    return [
        make_task(track, "test", layout, published_teammate(layout, family, number), seed=0)
        for layout in TRACKS[track]["test"]
        for family in _FAMILIES
        for number in range(INSTANCES)
    ]
