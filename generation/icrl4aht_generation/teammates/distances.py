"""Hamming distances of policies: the share of common states on which two policies act differently (paper, App.
"Teammate Policy Diversity Analysis").

The common states of a heuristic family on a layout are from 20 episodes of 100 steps with each of its five test
instances, ten with a random ego and ten with the scripted ego `oracle`. A teammate's distance to a test instance is
measured on the states of the instance's family. The layouts asymm_both and cramped_up have no test tasks. On these
two layouts, the instances of asymm_right and cramped_down play (`TESTED_ON`).

`fill_table` measures the teammates of `teammates.draws`, or chooses and measures the teammates of `teammates.spread`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt8

from icrl4aht_data.benchmark.facts import (
    LAYOUT_NAMES,
    LEAST_HEADROOM,
    SAME_BEHAVIOUR,
    TESTED_ON,
)
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import check_choice
from icrl4aht_data.format.provenance import NearestTestTeammate
from icrl4aht_data.format.schema import TEAMMATES
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.overcooked.tables import Tables
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.writing.splits import SplitDistance, played_teammates
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.experts.padded import padded_layout
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.draws import (
    DIVERSE_DISTANCE,
    DRAWS_PER_SEED,
    Draw,
    ranges_of,
    read_measured,
    write_table,
)
from icrl4aht_generation.teammates.instances import INSTANCE_NAMES, INSTANCES, TESTED_FAMILIES, published_teammates
from icrl4aht_generation.teammates.references import (
    REFERENCE_EGOS,
    play_reference_egos,
    reference_returns,
    stacked_policy_groups,
)
from icrl4aht_generation.teammates.registry import (
    HEURISTIC_FAMILIES,
    build_teammate,
    sample_teammate,
    with_equal_parameter_names,
)
from icrl4aht_generation.teammates.spread import (
    MOST_CHOSEN,
    VALIDATES,
    LayoutSpread,
    SpreadTeammate,
    choose_spread,
    spread_candidates,
)

_EPISODES = 10
"""Number of episodes of each test instance with each of the two egos."""

_SEED = 5

_DIGITS = 4
"""Decimal places of stored numbers, which are exact for shares of 10,000 states and means of 20 returns."""

_SPREAD_EPISODES = 4
"""Number of episodes of each test instance with each of the two egos, for states to compare spread teammates on."""

DRAW_NUMBERS = [
    (family, base_seed, theta_id)
    for family in HEURISTIC_FAMILIES
    for base_seed, count in DRAWS_PER_SEED.items()
    for theta_id in range(count)
]
"""Family, base_seed and theta_id of each sampled teammate of a layout."""


def nearest_test(layout: Layout, policies: Sequence[Policy]) -> list[NearestTestTeammate]:
    """Return the test teammate of a layout that acts most like each of the given teammates.

    Each result also has the Hamming distance of the two teammates, and the number that `group_behaviours` gives to the
    teammate's behaviour. Policies with equal functions are compiled once.

    Raises:
        UnknownNameError: if the benchmark does not have the layout.
    """
    records, tested = common_states(layout)
    actions = act_on_records(layout, policies, records)
    distances = distances_to_tests(tested, actions)
    nearest = distances.argmin(axis=1)
    return [
        NearestTestTeammate(INSTANCE_NAMES[k], round(float(distances[number, k]), _DIGITS), behaviour)
        for number, (k, behaviour) in enumerate(zip(nearest, group_behaviours(actions), strict=True))
    ]


@lru_cache(maxsize=2)
def common_states(layout: Layout, episodes: int = _EPISODES) -> tuple[UInt8[Array, "T N S"], np.ndarray]:
    """Return the states on which a layout's teammates are compared, and the test teammates' actions in these states.

    Args:
        layout: layout of the states.
        episodes: number of episodes of each test instance with each of the egos `random` and `oracle`.

    Returns:
        State records, see `common_records`, and the actions of the test instances, int8 (instances, T, N).

    Raises:
        UnknownNameError: if the benchmark does not have the layout.
    """
    records = common_records(layout, episodes)
    return records, act_on_records(layout, instance_policies(layout), records)


def instance_policies(layout: Layout) -> list[Policy]:
    """Return the test instances for a layout, by family and number, as policies that see a `Situation`.

    A training layout without test tasks has the instances of the test layout that `TESTED_ON` assigns to it.
    """
    tested = TESTED_ON.get(layout.name, layout.name)
    entries = [entry for family in TESTED_FAMILIES for entry in published_teammates(tested, family)]
    return [build_teammate(None, entry) for entry in entries]


def common_records(layout: Layout, episodes: int = _EPISODES) -> UInt8[Array, "T N S"]:
    """Return state records of episodes of the test instances, by family and instance.

    Args:
        layout: layout of the episodes.
        episodes: number of episodes of each instance with each of the egos `random` and `oracle`.

    Raises:
        UnknownNameError: if the benchmark does not have the layout.
    """
    check_choice("layout", layout.name, LAYOUT_NAMES)
    mates = instance_policies(layout)
    # Teammates are compared both on unusual states with random egos and on states of good play with the oracle.
    pairs = [(ego, mate) for mate in range(len(mates)) for ego in ("random", "oracle") for _ in range(episodes)]
    keys = jax.random.split(jax.random.key(_SEED), len(pairs))
    return play_reference_egos(layout, mates, pairs, keys, "record")[..., padded_layout(layout).positions]


def act_on_records(layout: Layout, policies: Sequence[Policy], records: Array, seed: int = _SEED) -> np.ndarray:
    """Return the actions that policies would choose as the teammate in each step of recorded episodes.

    Args:
        layout: layout of the episodes.
        policies: policies to compare; policies with equal functions share one compilation.
        records: state records, uint8 (T, episodes, S).
        seed: seed of the policies' random draws, which depend on the episode's number.

    Returns:
        Actions, int8 (policies, T, episodes).
    """
    keys = jax.random.split(jax.random.key(seed), records.shape[1])
    actions = np.zeros((len(policies), *records.shape[:2]), np.int8)
    for numbers, family in stacked_policy_groups(policies):
        tables, seen = layout.tables, records
        if family.sees == "situation":  # padded, so all layouts share one compilation
            tables, _, positions = padded_layout(layout)
            seen = jnp.zeros((*records.shape[:-1], record_size(tables)), jnp.uint8).at[..., positions].set(records)
        actions[numbers] = _compiled_actions(family._replace(params=()))(family.params, seen, keys, tables)
    return actions


@lru_cache(maxsize=16)
def _compiled_actions(family: Policy) -> Callable[..., Array]:
    """Return a compiled function of stacked parameters, state records, keys and tables that returns actions.

    The function returns the actions of each policy on the records, int8 of shape (policies, T, episodes).
    """

    @jax.jit
    def act(params: Any, records: Array, keys: Array, tables: Tables) -> Array:
        env, zero = Environment(tables), jnp.zeros(len(keys), jnp.int32)

        def policy_actions(params: Any) -> Array:
            def step(memories: Any, record: Array) -> tuple[Any, Array]:
                state = EnvState(keys, zero, zero, record)
                actions, memories = env.act(family, params, memories, state, TEAMMATE, keys, own=False)
                return memories, actions.astype(jnp.int8)

            memories = jax.vmap(family.init, in_axes=(None, 0))(params, keys)
            return jax.lax.scan(step, memories, records)[1]

        return jax.lax.map(policy_actions, params)  # one policy at a time, which bounds the memory

    return act


def distances_to_tests(tested: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return distances of teammates to the test instances, measured on the states of each instance's family.

    Args:
        tested: actions of the test instances on the common states, int8 (instances, T, N).
        actions: actions of teammates on the same states, int8 (teammates, T, N).

    Returns:
        Distances, float64 (teammates, instances).
    """
    families = len(tested) // INSTANCES
    tested, actions = (array.reshape(*array.shape[:2], families, -1) for array in (tested, actions))
    pairs = [(own[:, number // INSTANCES], number // INSTANCES) for number, own in enumerate(tested)]
    return np.stack([(actions[:, :, family] != own).mean(axis=(1, 2)) for own, family in pairs], axis=1)


def hamming_distances(actions: np.ndarray) -> np.ndarray:
    """Return the share of N states on which two policies act differently, for all pairs, float64 of shape (P, P)."""
    # The matrix is computed row by row, because all pairs at once would take gigabytes.
    return np.array([(actions != own).mean(axis=1) for own in actions]).reshape(len(actions), len(actions))


def group_behaviours(actions: np.ndarray) -> list[int]:
    """Return a number for the behaviour of each policy, given all policies' actions, int8 of shape (policies, ...).

    Policies are compared with the first policy of each behaviour so far. If the distance is below `SAME_BEHAVIOUR`, the
    policy has this behaviour; else it starts a new behaviour.
    """
    first: list[np.ndarray] = []
    found: list[int] = []
    for own in actions:
        same = (k for k, other in enumerate(first) if (own != other).mean() < SAME_BEHAVIOUR)
        found.append(next(same, len(first)))
        if found[-1] == len(first):
            first.append(own)
    return found


def split_distances(dataset: Dataset, on_layout: Callable[[int, int, str], None]) -> dict[str, SplitDistance]:
    """Return how differently a release's validation teammates act from its training teammates, by training layout.

    Args:
        dataset: a complete release.
        on_layout: called with the number of finished layouts, the number of layouts, and the name of the next layout.

    Returns:
        Training layout of the benchmark with teammates in both splits -> distances.
    """
    suite, found = dataset.origin.fetch_folder(TEAMMATES), {}
    played = played_teammates(dataset.tasks.values(), dataset.provenance)
    by_layout = {
        name: grouped(own, lambda task: task.split)
        for name, own in grouped(played, lambda task: task.layout.name).items()
        if name in TESTED_ON and {"train", "validation"} <= {task.split for task in own}
    }
    for number, (name, splits) in enumerate(by_layout.items()):
        on_layout(number, len(by_layout), name)
        actions = {split: _teammate_actions(get_layout(name), splits[split], suite) for split in splits}
        train = actions["train"]
        nearest = [float((train != own).mean(axis=1).min()) for own in actions["validation"]]
        found[name] = SplitDistance(len(train), len(nearest), round(min(nearest), _DIGITS))
    on_layout(len(by_layout), len(by_layout), "")
    return found


def _teammate_actions(layout: Layout, tasks: Sequence[Task], suite: Path) -> np.ndarray:
    """Return the actions of teammates on the common states of a layout, int8 (teammates, T * N)."""
    records, _ = common_states(layout)
    learned = [task.teammate for task in tasks if task.teammate_family == "rl"]
    scripts = with_equal_parameter_names([task.teammate for task in tasks if task.teammate_family != "rl"])
    # Policies of one kind are compiled once.
    groups = [
        [build_teammate(None, one) for one in scripts],
        [build_teammate(layout, one, suite=suite) for one in learned],
    ]
    return np.concatenate([act_on_records(layout, group, records).reshape(len(group), -1) for group in groups if group])


def fill_table(
    path: Path, layouts: Sequence[str], on_layout: Callable[[int, str], None], overwrite: bool, *, spread: bool
) -> None:
    """Measure layouts that a table does not contain yet, and write the table after each layout.

    Args:
        path: path of the table; a missing table is created.
        layouts: short names of training layouts.
        on_layout: called with the number of finished layouts and the name of the next layout.
        overwrite: whether to also measure layouts that the table already contains.
        spread: True for a table of `teammates.spread`, False for a table of `teammates.draws`.
    """
    rows: list[Any] = read_measured(path, LayoutSpread if spread else Draw) if path.is_file() else []
    candidates = spread_candidates() if spread else []
    for number, name in enumerate(layouts):
        on_layout(number, name)
        own = [row for row in rows if row.layout == name]
        complete = len(own) == len(DRAW_NUMBERS)
        if spread:  # a list chosen from another number of candidates is outdated
            complete = [row.tried for row in own] == [len(candidates)]
        if overwrite or not complete:
            layout = get_layout(name)
            measured = [measure_spread(layout, candidates)] if spread else measure_draws(layout)
            rows = [row for row in rows if row.layout != name] + measured
            write_table(path, rows)
    on_layout(len(layouts), "")


def measure_draws(layout: Layout, numbers: Sequence[tuple[str, int, int]] = DRAW_NUMBERS) -> list[Draw]:
    """Measure sampled teammates on a training layout, and number their behaviours within each family.

    Args:
        layout: layout of the measurements.
        numbers: family, base_seed and theta_id of each sampled teammate.
    """
    drawn = [sample_teammate(family, theta_id, ranges_of(seed), seed) for family, seed, theta_id in numbers]
    actions, distances, returns = _measure(layout, drawn, _EPISODES)
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
            **_measured_fields(family, distances[k], returns[k]),
        )
        for k, (family, base_seed, theta_id) in enumerate(numbers)
    ]


def _measure(
    layout: Layout, entries: Sequence[dict[str, Any]], episodes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the actions of teammates on the common states, distances to the test instances, and reference returns.

    Args:
        layout: the training layout.
        entries: entries of heuristic teammates.
        episodes: number of episodes of the common states, see `common_states`.
    """
    records, tested = common_states(layout, episodes)
    policies = [build_teammate(None, entry) for entry in with_equal_parameter_names(entries)]
    actions = act_on_records(layout, policies, records)
    return actions, distances_to_tests(tested, actions), reference_returns(layout, policies)


def _measured_fields(family: str, to_tests: np.ndarray, returns: np.ndarray) -> dict[str, Any]:
    """Return the fields that `Draw` and `SpreadTeammate` share: nearest test instances, returns of reference egos.

    Args:
        family: kind of the teammate.
        to_tests: float64 (instances,), distances of the teammate to the test instances.
        returns: float64 (egos,), returns of the reference egos with the teammate.
    """
    own = np.repeat(TESTED_FAMILIES, INSTANCES) == family
    near, other = (int(np.where(mask, to_tests, np.inf).argmin()) for mask in (own, ~own))
    return {
        "nearest": INSTANCE_NAMES[near],
        "distance": round(float(to_tests[near]), _DIGITS),
        "other": INSTANCE_NAMES[other],
        "other_distance": round(float(to_tests[other]), _DIGITS),
        **{ego: round(float(value), _DIGITS) for ego, value in zip(REFERENCE_EGOS, returns, strict=True)},
    }


def measure_spread(layout: Layout, candidates: Sequence[dict[str, Any]]) -> LayoutSpread:
    """Choose teammates of a training layout that differ widely, and measure them.

    Args:
        layout: the training layout.
        candidates: entries of heuristic teammates.
    """
    actions, tests, returns = _measure(layout, candidates, _SPREAD_EPISODES)
    unlike = tests.min(axis=1) >= DIVERSE_DISTANCE
    headroom = unlike & (np.ptp(returns, axis=1) >= LEAST_HEADROOM)
    usable = np.flatnonzero(headroom if headroom.any() else unlike)
    distances = hamming_distances(actions[usable].reshape(len(usable), -1))
    order, separations = choose_spread(distances, DIVERSE_DISTANCE, MOST_CHOSEN)
    chosen = [
        SpreadTeammate(
            split="validation" if number % VALIDATES == VALIDATES - 1 else "train",
            family=candidates[place]["family"],
            theta_id=candidates[place]["theta_id"],
            theta=candidates[place]["theta"],
            separation=round(separation, _DIGITS),
            **_measured_fields(candidates[place]["family"], tests[place], returns[place]),
        )
        for number, (place, separation) in enumerate(zip(usable[order], separations, strict=True))
    ]
    return LayoutSpread(layout.name, len(candidates), int(unlike.sum()), int(headroom.sum()), tuple(chosen))
