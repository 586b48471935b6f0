"""Heuristic teammates that differ widely from each other and from all test instances.

`spread.jsonl` has one line for each training layout: the teammates that `icrl4aht-data research draws --spread` chose,
with measured distances and returns, so tasks can be planned without simulation. The candidates are presets, specialists
for one part of the work, a teammate that never acts, diverse sampled teammates of all families, and mixtures of these
with random actions. Among candidates that behave differently from the test instances, the next chosen teammate is
always the candidate that is farthest from all chosen teammates, until no candidate is far enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, SPREAD_SEED, TESTED_ON, layout_sort_key
from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_generation.teammates.draws import Draw, equal_parameters, find_draw, read_measured
from icrl4aht_generation.teammates.heuristics.assembly_line import PLATER, RUNNER
from icrl4aht_generation.teammates.heuristics.heuristic import RANDOM_ACTIONS
from icrl4aht_generation.teammates.heuristics.territory import (
    BLOCKER,
    COUNTER,
    HOARDER,
    HORIZONTAL,
    INVADER,
    LAZY,
    STATIONS,
)
from icrl4aht_generation.teammates.registry import HEURISTIC_FAMILIES, heuristic_entry, sample_teammate

SPREAD_TABLE = Path(__file__).with_name("spread.jsonl")
"""Path of the table of the chosen teammates."""

_DRAWS = 32
"""Number of diverse sampled teammates of each family among the candidates."""

_MIXED_DRAWS = 8
"""Number of sampled teammates of each family that are also mixed with random actions."""

_CHANCES = (0.25, 0.5, 0.75)
"""Chances of a random action, which mixtures use in turn."""

_FIRST_DRAW, _FIRST_MIXTURE = 100, 200  # first theta_id of sampled candidates, and of mixtures

MOST_CHOSEN = 45
"""Maximum number of chosen teammates on a layout."""

VALIDATES = 5
"""Every fifth chosen teammate is for validation, so both splits cover all behaviours."""

_SPECIALISTS: dict[str, tuple[dict[str, float], ...]] = {
    "recipe_aware_button": (
        {"task_specialization": 1.0},  # the teammate only plates and delivers soups
        {"wrong_ingredient_prob": 1.0},  # the teammate fetches wrong ingredients
        {"path_blocking": 1.0},  # the teammate blocks pots and goals
        {"plate_timing": 1.0},  # the teammate fetches a plate early
        {"idle_prob": 0.5},
    ),
    "territory": (
        {"behavior_mode": LAZY, "action_probability": 0.0},  # the teammate never acts
        {"behavior_mode": LAZY, "action_probability": 0.5},
        {"behavior_mode": BLOCKER},
        {"behavior_mode": HOARDER},  # the teammate carries everything to counters
        {"behavior_mode": HOARDER, "split_mode": HORIZONTAL, "strictness": 1.0, "shared_margin": 0},
        {"behavior_mode": COUNTER},  # the teammate puts dishes on counters
        {"behavior_mode": COUNTER, "split_mode": HORIZONTAL, "strictness": 1.0, "shared_margin": 0},
        {"behavior_mode": INVADER, "strictness": 1.0, "shared_margin": 0},
        {"behavior_mode": INVADER, "split_mode": STATIONS, "strictness": 1.0, "shared_margin": 0},
    ),
    "assembly_line": (
        {"role_mode": RUNNER, "handoff_style": 1},  # the teammate only carries ingredients to pots or central counters
        {"role_mode": RUNNER, "handoff_style": 2},  # the teammate only carries ingredients to pots or near its partner
        {"role_mode": PLATER, "task_abandon_prob": 0.5},
        {"task_abandon_prob": 1.0},  # the teammate puts down whatever it fetches
        {"wrong_action_prob": 1.0},
        {"stubbornness": 1.0},
        {"timing_mismatch": 1.0},
    ),
    "utility_greedy": (
        {"w_press_L": 20.0},  # the teammate presses the button whenever possible
        {"w_fetch_ingredient": 0.0, "w_get_plate": 20.0},
        {"w_fetch_ingredient": 20.0, "w_get_plate": 0.0},
        {"w_stage_on_counter": 20.0, "counter_preference": 1.0},
        {"dist_weight": 10.0},
        {RANDOM_ACTIONS: 1.0},
    ),
}
"""Parameters of the specialists of each family that differ from the defaults."""


class SpreadTeammate(Struct, forbid_unknown_fields=True):
    """A teammate that was chosen for a layout.

    Attributes:
        split: "train" or "validation".
        family: kind of the heuristic.
        theta_id: number of the candidate.
        theta: all parameters of the teammate.
        nearest: test instance of the same family with the most similar behaviour, such as "H3/t1".
        distance: Hamming distance to `nearest`, see `icrl4aht_generation.teammates.distances`.
        other: test instance of another family with the most similar behaviour.
        other_distance: Hamming distance to `other`.
        separation: Hamming distance to the nearest teammate that was chosen earlier; 1 for the first teammate.
        stay: mean return of the ego `stay` with the teammate in 20 episodes of 100 steps.
        random: mean return of the ego `random` with the teammate.
        oracle: mean return of the ego `oracle` with the teammate.
    """

    split: str
    family: str
    theta_id: int
    theta: dict[str, int | float]
    nearest: str
    distance: float
    other: str
    other_distance: float
    separation: float
    stay: float
    random: float
    oracle: float

    @property
    def entry(self) -> dict[str, Any]:
        """The field `teammate` of a task with this teammate, see `heuristic_entry`."""
        return heuristic_entry(self.family, self.theta_id, SPREAD_SEED, dict(self.theta))


class LayoutSpread(Struct, forbid_unknown_fields=True):
    """Teammates chosen for a layout, first choice first, and the number of candidates that passed each filter.

    Attributes:
        layout: short name of a training layout.
        tried: number of candidates.
        unlike_tests: number of candidates at Hamming distance `DIVERSE_DISTANCE` or more from every test instance.
        headroom: number of candidates counted in `unlike_tests` with returns of the reference egos that differ by
            `LEAST_HEADROOM` or more. Other candidates are only chosen if this number is 0.
        chosen: the chosen teammates.
    """

    layout: str
    tried: int
    unlike_tests: int
    headroom: int
    chosen: tuple[SpreadTeammate, ...]

    @property
    def order(self) -> tuple[Any, ...]:
        """Sort key of the table's rows: the benchmark's order of layouts."""
        return layout_sort_key(self.layout)

    def of_split(self, split: str) -> list[SpreadTeammate]:
        """Return the chosen teammates of split "train" or "validation", in order of choice."""
        return [mate for mate in self.chosen if mate.split == split]


def read_spread(layout: str) -> LayoutSpread:
    """Return the list of chosen teammates of a training layout.

    Raises:
        UnknownNameError: if the layout has no training tasks.
        OptionError: if the layout was not measured.
    """
    name = get_layout(layout).name
    check_choice("training layout", name, TESTED_ON)
    if name not in _bundled_spreads():
        raise OptionError(f"{SPREAD_TABLE}: no line for {name}; run `icrl4aht-data research draws --spread`")
    return _bundled_spreads()[name]


def spread_teammates(layout: str, split: str, count: int) -> list[dict[str, Any]]:
    """Return the entries of the first teammates in a layout's list, which differ most from each other.

    Args:
        layout: a training layout.
        split: "train" or "validation".
        count: number of teammates.

    Raises:
        UnknownNameError: if the layout has no training tasks.
        OptionError: if the layout was not measured, or has fewer chosen teammates of the split.
    """
    if count == 0:
        return []
    spread = read_spread(layout)
    found = spread.of_split(split)
    if count > len(found):
        raise OptionError(
            f"{spread.layout}: {count} {split} teammates requested from teammates/spread.jsonl, which has "
            f"{len(found)}: {spread.unlike_tests} of {spread.tried} candidates differ from the test teammates, and "
            f"{spread.headroom} of these have headroom; request fewer"
        )
    return [mate.entry for mate in found[:count]]


def find_measured(layout: str, teammate: Mapping[str, Any]) -> Draw | None:
    """Return the measurements of a teammate entry from the tables of draws and spreads; None if it was not measured.

    For a teammate of `spread.jsonl`, `behaviour` is the teammate's number in the layout's list.
    """
    if teammate.get("kind") != "heuristic" or teammate.get("base_seed") != SPREAD_SEED:
        return find_draw(layout, teammate)
    spread = _bundled_spreads().get(layout)
    for number, mate in enumerate(spread.chosen if spread else ()):
        if (mate.family, mate.theta_id) == (teammate["family"], teammate["theta_id"]):
            if not equal_parameters(mate.theta, teammate["theta"]):
                return None
            near, other = (mate.nearest, mate.distance), (mate.other, mate.other_distance)
            returns = (mate.stay, mate.random, mate.oracle)
            return Draw(layout, mate.family, SPREAD_SEED, mate.theta_id, *near, number, *returns, *other)
    return None


@lru_cache(maxsize=1)
def _bundled_spreads() -> dict[str, LayoutSpread]:
    return {spread.layout: spread for spread in read_measured(SPREAD_TABLE, LayoutSpread)}


def spread_rows(spreads: Iterable[LayoutSpread]) -> list[dict[str, Any]]:
    """Return a row of measures for each layout, such as numbers of candidates and minimum distances.

    Returns:
        One row for each layout; distances are None if no teammate was chosen.
    """
    return [
        {
            "layout": spread.layout,
            "candidates": spread.tried,
            "unlike_tests": spread.unlike_tests,
            "with_headroom": spread.headroom,
            **{split: len(spread.of_split(split)) for split in ("train", "validation")},
            "families": " ".join(
                f"{HEURISTIC_KINDS[family]}:{sum(mate.family == family for mate in spread.chosen)}"
                for family in HEURISTIC_FAMILIES
            ),
            "least_distance": min((mate.separation for mate in spread.chosen), default=None),
            "least_to_tests": min((min(mate.distance, mate.other_distance) for mate in spread.chosen), default=None),
        }
        for spread in spreads
    ]


def spread_candidates() -> list[dict[str, Any]]:
    """Return all candidates as teammate entries, grouped by family.

    Each family has presets, specialists, teammates with random parameters, and mixtures of these with random actions.
    """
    return [entry for family in HEURISTIC_FAMILIES for entry in _family_candidates(family)]


def _family_candidates(family: str) -> Iterator[dict[str, Any]]:
    heuristic = HEURISTIC_FAMILIES[family]
    shapes = [*heuristic.presets.values(), *_SPECIALISTS[family]]
    fixed = [heuristic.defaults | shape for shape in shapes]
    drawn = [sample_teammate(family, number, "diverse", SPREAD_SEED)["theta"] for number in range(_DRAWS)]
    mixed = [
        theta | {RANDOM_ACTIONS: _CHANCES[number % len(_CHANCES)]}
        for number, theta in enumerate([*fixed, *drawn[:_MIXED_DRAWS]])
        if RANDOM_ACTIONS not in theta
    ]
    for first, thetas in ((0, fixed), (_FIRST_DRAW, drawn), (_FIRST_MIXTURE, mixed)):
        for number, theta in enumerate(thetas, start=first):
            yield heuristic_entry(family, number, SPREAD_SEED, theta)


def choose_spread(distances: np.ndarray, least: float, most: int) -> tuple[list[int], list[float]]:
    """Choose items by farthest-point selection (greedy max-min).

    The first item has the largest distance to any other item. Each next item has the largest distance to its nearest
    chosen item. Ties go to the smaller index.

    Args:
        distances: symmetric matrix of distances, float64 (N, N).
        least: minimum distance between any two chosen items.
        most: maximum number of items.

    Returns:
        Indices of the chosen items in order, and each item's distance to the nearest item chosen earlier, 1 for the
        first item.
    """
    chosen: list[int] = []
    separations: list[float] = []
    nearest = distances.max(axis=1, initial=0.0)
    while len(chosen) < min(most, len(distances)):
        best = int(nearest.argmax())
        if chosen and nearest[best] < least:
            break
        separations.append(float(nearest[best]) if chosen else 1.0)
        nearest = np.minimum(nearest, distances[best]) if chosen else distances[best].copy()
        chosen.append(best)
        nearest[chosen] = -1.0
    return chosen, separations
