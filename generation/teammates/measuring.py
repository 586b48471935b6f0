"""Measurement of the draws of `generation.teammates.draws`: distances to the test instances, behaviours, returns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from generation.teammates.distances import (
    CommonStates,
    act_along,
    common_states,
    distances_to_tests,
    group_behaviours,
)
from generation.teammates.draws import DRAWS_PER_SEED, Draw
from generation.teammates.references import reference_returns
from generation.teammates.registry import HEURISTIC_FAMILIES, build_teammate, sample_teammate
from icrl4aht_data.overcooked.layouts import Layout

_DIGITS = 4
"""Decimal places of stored numbers: all digits of shares of 2,000 states, and of means of 20 returns."""


def measure_layout(layout: Layout, per_seed: Mapping[int, int] = DRAWS_PER_SEED) -> Iterator[list[Draw]]:
    """Measures the draws of a training layout.

    Args:
        layout: the layout.
        per_seed: base_seed -> number of draws of each family.

    Yields:
        The draws of one family after the other.
    """
    common = common_states(layout)
    for family in HEURISTIC_FAMILIES:
        yield measure_family(layout, family, common, per_seed)


def measure_family(
    layout: Layout, family: str, common: CommonStates, per_seed: Mapping[int, int] = DRAWS_PER_SEED
) -> list[Draw]:
    """Measures the draws of one family on a training layout, see `measure_layout`."""
    numbers = [(seed, theta_id) for seed, count in per_seed.items() for theta_id in range(count)]
    policies = [build_teammate(layout, sample_teammate(family, theta_id, "train", seed)) for seed, theta_id in numbers]
    actions = act_along(layout, policies, common.records)
    distances = distances_to_tests(common, actions)
    nearest = distances.argmin(axis=1)
    behaviours = group_behaviours(actions)
    returns = reference_returns(layout, policies)
    return [
        Draw(
            layout.name,
            family,
            seed,
            theta_id,
            common.instances[nearest[k]],
            round(float(distances[k, nearest[k]]), _DIGITS),
            behaviours[k],
            *(round(float(returns[ego][k]), _DIGITS) for ego in ("stay", "random", "oracle")),
        )
        for k, (seed, theta_id) in enumerate(numbers)
    ]
