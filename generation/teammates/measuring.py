"""Measurement of the draws of `generation.teammates.draws`: distances to the test instances, behaviours, returns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from generation.teammates.distances import act_along, common_states, distances_to_tests, group_behaviours
from generation.teammates.draws import DRAWS_PER_SEED, Draw, read_draws_table, write_draws_table
from generation.teammates.references import reference_returns
from generation.teammates.registry import HEURISTIC_FAMILIES, build_teammate, sample_teammate
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_DIGITS = 4
"""Decimal places of stored numbers: all digits of shares of 2,000 states, and of means of 20 returns."""


def fill_table(path: Path, layouts: Sequence[str], on_layout: Callable[[int, str], None], overwrite: bool) -> None:
    """Measure the layouts whose draws a table does not have yet, and write it after each of them.

    Args:
        path: the table; a missing one is started.
        layouts: short names of training layouts.
        on_layout: called with the number of finished layouts and the name of the next one.
        overwrite: also measure the layouts that the table has.
    """
    draws = read_draws_table(path) if path.is_file() else []
    measured = Counter(draw.layout for draw in draws)
    expected = len(HEURISTIC_FAMILIES) * sum(DRAWS_PER_SEED.values())
    for number, name in enumerate(layouts):
        on_layout(number, name)
        if overwrite or measured[name] != expected:
            draws = [draw for draw in draws if draw.layout != name]
            draws += measure_draws(get_layout(name))
            write_draws_table(path, draws)
    on_layout(len(layouts), "")


def measure_draws(layout: Layout, per_seed: Mapping[int, int] = DRAWS_PER_SEED) -> list[Draw]:
    """Measures the draws of every family on a training layout.

    Args:
        layout: the layout.
        per_seed: base_seed -> number of draws of each family.
    """
    numbers = [
        (family, seed, theta_id)
        for family in HEURISTIC_FAMILIES
        for seed, count in per_seed.items()
        for theta_id in range(count)
    ]
    policies = [
        build_teammate(layout, sample_teammate(family, theta_id, "train", seed)) for family, seed, theta_id in numbers
    ]
    common = common_states(layout)
    actions = act_along(layout, policies, common.records)
    distances = distances_to_tests(common, actions)
    nearest = distances.argmin(axis=1)
    behaviours = [
        behaviour
        for family in HEURISTIC_FAMILIES
        for behaviour in group_behaviours(actions[[own == family for own, _, _ in numbers]])
    ]
    returns = reference_returns(layout, policies)
    return [
        Draw(
            layout.name,
            *numbers[k],
            common.instances[nearest[k]],
            round(float(distances[k, nearest[k]]), _DIGITS),
            behaviours[k],
            *(round(float(returns[ego][k]), _DIGITS) for ego in ("stay", "random", "oracle")),
        )
        for k in range(len(numbers))
    ]
