"""Measurement of the teammates of `teammates.draws` and `teammates.spread`: distances to the test instances and to each
other, returns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_generation.teammates.distances import (
    act_along,
    common_records,
    common_states,
    distances_to_tests,
    group_behaviours,
    hamming_distances,
    instance_entries,
    join_states,
)
from icrl4aht_generation.teammates.draws import (
    DIVERSE_DISTANCE,
    DRAWS_PER_SEED,
    Draw,
    ranges_of,
    read_draws_table,
    write_draws_table,
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
    read_spread_table,
    spread_candidates,
    write_spread_table,
)

_DIGITS = 4
"""Decimal places of stored numbers: all digits of shares of 10,000 states, and of means of 20 returns."""

_SPREAD_EPISODES = 4
"""Episodes of the states on which spread teammates are compared, of each test instance with each of the two egos."""

DRAW_NUMBERS = [
    (family, base_seed, theta_id)
    for family in HEURISTIC_FAMILIES
    for base_seed, count in DRAWS_PER_SEED.items()
    for theta_id in range(count)
]
"""Family, base_seed and theta_id of each draw of a layout."""


def fill_draws_table(
    path: Path, layouts: Sequence[str], on_layout: Callable[[int, str], None], overwrite: bool
) -> None:
    """Measure the layouts whose draws a table does not have yet, and write it after each of them.

    Args:
        path: the table; a missing one is started.
        layouts: short names of training layouts.
        on_layout: called with the number of finished layouts and the name of the next one.
        overwrite: also measure the layouts that the table has.
    """
    draws = read_draws_table(path) if path.is_file() else []
    measured = Counter(draw.layout for draw in draws)
    for number, name in enumerate(layouts):
        on_layout(number, name)
        if overwrite or measured[name] != len(DRAW_NUMBERS):
            draws = [draw for draw in draws if draw.layout != name]
            draws += measure_draws(get_layout(name))
            write_draws_table(path, draws)
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
    common = common_states(layout)
    actions = act_along(layout, policies, common.records)
    distances = distances_to_tests(common, actions)
    families = np.array([family for family, _, _ in numbers])
    own = families[:, None] == np.repeat(TESTED_FAMILIES, INSTANCES)
    nearest, others = (np.where(mask, distances, np.inf).argmin(axis=1) for mask in (own, ~own))
    behaviours = np.zeros(len(numbers), int)
    for family in np.unique(families):
        behaviours[families == family] = group_behaviours(actions[families == family])
    returns = reference_returns(layout, policies)
    return [
        Draw(
            layout.name,
            family,
            base_seed,
            theta_id,
            common.instances[nearest[k]],
            round(float(distances[k, nearest[k]]), _DIGITS),
            int(behaviours[k]),
            *(round(float(returns[ego][k]), _DIGITS) for ego in ("stay", "random", "oracle")),
            other=common.instances[others[k]],
            other_distance=round(float(distances[k, others[k]]), _DIGITS),
        )
        for k, (family, base_seed, theta_id) in enumerate(numbers)
    ]


def fill_spread_table(
    path: Path, layouts: Sequence[str], on_layout: Callable[[int, str], None], overwrite: bool
) -> list[LayoutSpread]:
    """Choose the spread teammates of layouts that a table does not have yet, and write it after each of them.

    Args:
        path: the table; a missing one is started.
        layouts: short names of training layouts.
        on_layout: called with the number of finished layouts and the name of the next one.
        overwrite: also measure the layouts that the table has.

    Returns:
        The table.
    """
    spreads = {spread.layout: spread for spread in read_spread_table(path)} if path.is_file() else {}
    candidates = spread_candidates()
    for number, name in enumerate(layouts):
        on_layout(number, name)
        if overwrite or name not in spreads or spreads[name].tried != len(candidates):
            spreads[name] = measure_spread(get_layout(name), candidates)
            write_spread_table(path, spreads.values())
    on_layout(len(layouts), "")
    return list(spreads.values())


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
    common, actions = join_states(records, actions[: len(tested)]), actions[len(tested) :]
    tests = distances_to_tests(common, actions)
    egos = reference_returns(layout, policies)  # with all of them, so that layouts share one compilation
    returns = np.stack([egos[ego] for ego in ("stay", "random", "oracle")], axis=1)
    unlike = tests.min(axis=1) >= DIVERSE_DISTANCE
    headroom = unlike & (np.ptp(returns, axis=1) >= LEAST_HEADROOM)
    usable = np.flatnonzero(headroom if headroom.any() else unlike)
    distances = hamming_distances(actions[usable].reshape(len(usable), -1))
    order, separations = choose_spread(distances, DIVERSE_DISTANCE, most)
    families = np.repeat(TESTED_FAMILIES, INSTANCES)
    chosen = []
    for number, (place, separation) in enumerate(zip(usable[order], separations, strict=True)):
        entry, to_tests = candidates[place], tests[place]
        own = families == entry["family"]
        near, other = (int(np.where(mask, to_tests, np.inf).argmin()) for mask in (own, ~own))
        chosen.append(
            SpreadTeammate(
                "validation" if number % VALIDATES == VALIDATES - 1 else "train",
                entry["family"],
                entry["theta_id"],
                entry["theta"],
                common.instances[near],
                round(float(to_tests[near]), _DIGITS),
                common.instances[other],
                round(float(to_tests[other]), _DIGITS),
                round(separation, _DIGITS),
                *(round(float(value), _DIGITS) for value in returns[place]),
            )
        )
    return LayoutSpread(layout.name, len(candidates), int(unlike.sum()), int(headroom.sum()), tuple(chosen))
