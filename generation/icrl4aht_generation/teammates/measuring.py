"""Measurement of the teammates of `teammates.draws` and `teammates.spread`: distances to the test instances and to each
other, returns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.distances import (
    INSTANCE_NAMES,
    act_along,
    common_records,
    common_states,
    distances_to_tests,
    group_behaviours,
    hamming_distances,
    instance_entries,
)
from icrl4aht_generation.teammates.draws import (
    DIVERSE_DISTANCE,
    DRAWS_PER_SEED,
    Draw,
    ranges_of,
    read_measured,
    write_table,
)
from icrl4aht_generation.teammates.instances import INSTANCES, TESTED_FAMILIES
from icrl4aht_generation.teammates.references import reference_returns
from icrl4aht_generation.teammates.registry import (
    HEURISTIC_FAMILIES,
    build_teammate,
    sample_teammate,
    with_equal_parameters,
)
from icrl4aht_generation.teammates.spread import (
    MOST_CHOSEN,
    VALIDATES,
    LayoutSpread,
    SpreadTeammate,
    choose_spread,
    spread_candidates,
)

_DIGITS = 4
"""Decimal places of stored numbers: all digits of shares of 10,000 states, and of means of 20 returns."""

_EGOS = ("stay", "random", "oracle")
"""Reference egos. The tables list the return of each with every teammate."""

_SPREAD_EPISODES = 4
"""Episodes of the states on which spread teammates are compared, of each test instance with each of the two egos."""

DRAW_NUMBERS = [
    (family, base_seed, theta_id)
    for family in HEURISTIC_FAMILIES
    for base_seed, count in DRAWS_PER_SEED.items()
    for theta_id in range(count)
]
"""Family, base_seed and theta_id of each draw of a layout."""


def fill_table(
    path: Path, layouts: Sequence[str], on_layout: Callable[[int, str], None], overwrite: bool, *, spread: bool
) -> None:
    """Measure the layouts that a table does not have yet, and write it after each of them.

    Args:
        path: the table; a missing one is started.
        layouts: short names of training layouts.
        on_layout: called with the number of finished layouts and the name of the next one.
        overwrite: also measure the layouts that the table has.
        spread: whether it is a table of `teammates.spread`, or one of `teammates.draws`.
    """
    rows: list[Any] = read_measured(path, LayoutSpread if spread else Draw) if path.is_file() else []
    candidates = spread_candidates() if spread else []
    for number, name in enumerate(layouts):
        on_layout(number, name)
        own = [row for row in rows if row.layout == name]
        complete = len(own) == len(DRAW_NUMBERS)
        if spread:  # a list that was chosen from other candidates is chosen again
            complete = [row.tried for row in own] == [len(candidates)]
        if overwrite or not complete:
            layout = get_layout(name)
            measured = [measure_spread(layout, candidates)] if spread else measure_draws(layout)
            rows = [row for row in rows if row.layout != name] + measured
            write_table(path, rows)
    on_layout(len(layouts), "")


def measure_draws(layout: Layout, numbers: Sequence[tuple[str, int, int]] = DRAW_NUMBERS) -> list[Draw]:
    """Measure draws on a training layout. Behaviours are numbered within these draws.

    Args:
        layout: the layout.
        numbers: family, base_seed and theta_id of each draw.
    """
    policies = [
        build_teammate(layout, sample_teammate(family, theta_id, ranges_of(seed), seed))
        for family, seed, theta_id in numbers
    ]
    records, tested = common_states(layout)
    actions = act_along(layout, policies, records)
    distances, returns = distances_to_tests(tested, actions), _returns(layout, policies)
    families = np.array([family for family, _, _ in numbers])
    behaviours = np.zeros(len(numbers), int)
    for family in np.unique(families):
        behaviours[families == family] = group_behaviours(actions[families == family])
    return [
        Draw(
            layout.name,
            family,
            base_seed,
            theta_id,
            behaviour=int(behaviours[k]),
            **_measured(family, distances[k], returns[k]),
        )
        for k, (family, base_seed, theta_id) in enumerate(numbers)
    ]


def _returns(layout: Layout, policies: Sequence[Policy]) -> np.ndarray:
    """Return mean returns of the reference egos with each teammate, float64 (teammates, egos)."""
    returns = reference_returns(layout, policies)
    return np.stack([returns[ego] for ego in _EGOS], axis=1)


def _measured(family: str, to_tests: np.ndarray, returns: np.ndarray) -> dict[str, Any]:
    """Return the fields that lines of both tables have: the nearest test instances, and the egos' returns.

    Args:
        family: kind of the teammate.
        to_tests: float64 (instances,), its distances to the test instances.
        returns: float64 (egos,), returns of the reference egos with it.
    """
    own = np.repeat(TESTED_FAMILIES, INSTANCES) == family
    near, other = (int(np.where(mask, to_tests, np.inf).argmin()) for mask in (own, ~own))
    return {
        "nearest": INSTANCE_NAMES[near],
        "distance": round(float(to_tests[near]), _DIGITS),
        "other": INSTANCE_NAMES[other],
        "other_distance": round(float(to_tests[other]), _DIGITS),
        **{ego: round(float(value), _DIGITS) for ego, value in zip(_EGOS, returns, strict=True)},
    }


def measure_spread(layout: Layout, candidates: Sequence[dict[str, Any]], most: int = MOST_CHOSEN) -> LayoutSpread:
    """Choose teammates of a training layout that differ widely.

    Args:
        layout: the layout.
        candidates: entries of heuristic teammates.
        most: most teammates to choose.
    """
    # Together with the test instances, so that there is one compilation for each family.
    tested, records = instance_entries(layout), common_records(layout, _SPREAD_EPISODES)
    policies = [build_teammate(None, entry) for entry in with_equal_parameters([*tested, *candidates])]
    actions, policies = act_along(layout, policies, records), policies[len(tested) :]
    tests, actions = distances_to_tests(actions[: len(tested)], actions[len(tested) :]), actions[len(tested) :]
    returns = _returns(layout, policies)  # with all of them, so that layouts share one compilation
    unlike = tests.min(axis=1) >= DIVERSE_DISTANCE
    headroom = unlike & (np.ptp(returns, axis=1) >= LEAST_HEADROOM)
    usable = np.flatnonzero(headroom if headroom.any() else unlike)
    distances = hamming_distances(actions[usable].reshape(len(usable), -1))
    order, separations = choose_spread(distances, DIVERSE_DISTANCE, most)
    chosen = [
        SpreadTeammate(
            split="validation" if number % VALIDATES == VALIDATES - 1 else "train",
            family=candidates[place]["family"],
            theta_id=candidates[place]["theta_id"],
            theta=candidates[place]["theta"],
            separation=round(separation, _DIGITS),
            **_measured(candidates[place]["family"], tests[place], returns[place]),
        )
        for number, (place, separation) in enumerate(zip(usable[order], separations, strict=True))
    ]
    return LayoutSpread(layout.name, len(candidates), int(unlike.sum()), int(headroom.sum()), tuple(chosen))
