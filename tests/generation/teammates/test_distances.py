"""Test the distances from teammates to test teammates, groups of equal behaviour, and returns of reference egos."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners.rollout import Rollout
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates import references
from icrl4aht_generation.teammates.distances import (
    common_states,
    distances_to_tests,
    group_behaviours,
    measure_draws,
    nearest_test,
    split_distances,
)
from icrl4aht_generation.teammates.draws import read_draws
from icrl4aht_generation.teammates.instances import INSTANCES, published_teammates
from icrl4aht_generation.teammates.references import reference_returns
from icrl4aht_generation.teammates.registry import build_teammate
from msgspec.structs import replace

from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.errors import UnknownNameError
from icrl4aht_data.format.provenance import Provenance, ProvenanceByTask
from icrl4aht_data.overcooked.layouts import get_layout

LAYOUT = get_layout("cramped_up")


def test_distance_is_measured_on_states_of_the_test_teammates_family():
    """The example has two families with five test teammates each, and one episode of two steps for each family."""
    tested = np.zeros((10, 2, 2), np.int8)
    tested[3, :, 0], tested[7, :, 1] = 1, [2, 4]
    actions = np.array([[[1, 2], [1, 3]], [[0, 0], [1, 4]]], np.int8)  # shape (teammates, T, episodes)
    distances = distances_to_tests(tested, actions)
    np.testing.assert_array_equal(distances[0], [1, 1, 1, 0, 1, 1, 1, 0.5, 1, 1])
    np.testing.assert_array_equal(distances[1], [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])


def test_teammates_are_grouped_into_numbered_behaviours():
    """Teammates that differ in 1 of 100 states count as one behaviour; those that differ in 2 count as two."""
    actions = np.zeros((5, 10, 10), np.int8)
    actions[1, 0, :2] = 1
    actions[2, 0, 0] = 1
    actions[3, 0, :3] = 1
    actions[4, 9] = 3
    assert group_behaviours(actions) == [0, 1, 0, 1, 2]
    assert group_behaviours(actions[[1, 0]]) == [0, 1]
    assert group_behaviours(actions[:0]) == []


def test_common_states_of_unsupported_layout_raise_error():
    with pytest.raises(UnknownNameError, match="unknown layout 'asymm_both_plain'"):
        common_states(get_layout("asymm_both_plain"))


def start_steps(params, key) -> jax.Array:
    return jnp.int32(0)


def return_parameter(params, steps, view, key):
    """Return the parameter as the action."""
    return params, steps + 1


def return_parameter_too(params, steps, view, key):
    """Return the parameter as the action: a copy of `return_parameter`, since equal functions are compiled together."""
    return params, steps + 1


def test_reference_returns_are_in_the_order_of_the_teammates(monkeypatch):
    """The test replaces the reward by the number of the ego's action, plus 100 if the teammate's action is 2."""

    def with_fake_rewards(*arguments, **options) -> tuple[object, Rollout]:
        carry, played = roll_out(*arguments, **options)
        actions = played.actions.astype(jnp.float32)
        return carry, played._replace(reward=actions[..., 0] + 100 * (actions[..., 1] == 2))

    roll_out = references.roll_out
    other = Policy((), start_steps, lambda params, steps, view, key: (jnp.int32(1), steps), "state")
    monkeypatch.setattr(references, "roll_out", with_fake_rewards)
    monkeypatch.setitem(references.REFERENCE_EGOS, "oracle", other)
    monkeypatch.setattr(references, "KEPT_STEPS", 3)
    actions = {0: return_parameter, 2: return_parameter_too, 5: return_parameter}
    mates = [Policy(jnp.int32(action), start_steps, act, "state") for action, act in actions.items()]
    found = reference_returns(LAYOUT, mates, episodes=2)
    stay, random, oracle = found.T
    np.testing.assert_array_equal(stay, [12, 312, 12])
    np.testing.assert_array_equal(oracle, [3, 303, 3])
    assert found.dtype == np.float64
    # The random ego takes the same actions with every teammate.
    np.testing.assert_array_equal(random - random[0], [0, 300, 0])
    assert 0 < random[0] < 15
    np.testing.assert_array_equal(reference_returns(LAYOUT, mates[1:], episodes=2), found[1:])


# Tests of the shipped table are slow, since they compile all families and the scripted ego.

NAME = "demo_wide"
SHIPPED = get_layout(NAME)


@pytest.mark.slow
@pytest.mark.usefixtures("optimized_actions")
def test_test_teammate_has_distance_0_to_itself():
    """The distance is 0 also for random actions, since the noise depends on the episode and not on the teammate."""
    entries = [entry for family in ("assembly_line", "utility_greedy") for entry in published_teammates(NAME, family)]
    found = nearest_test(SHIPPED, [build_teammate(None, entry) for entry in entries])
    assert [near.distance for near in found] == [0.0] * len(entries)
    assert (found[0].teammate, found[INSTANCES].teammate) == ("H3/t0", "H4/t0")


@pytest.mark.slow
@pytest.mark.usefixtures("optimized_actions")
def test_split_distances_find_the_nearest_training_teammate():
    """The second of two validation teammates also trains; layouts with one split are left out."""
    mates = published_teammates(NAME, "assembly_line")
    chosen = [("train", 0), ("train", 1), ("validation", 2), ("validation", 1)]
    tasks = [make_task("teammate", split, NAME, mates[number], seed) for seed, (split, number) in enumerate(chosen)]
    tasks.append(make_task("layout", "train", LAYOUT.name, mates[0], 9))
    made = ProvenanceByTask({task.task_id: Provenance() for task in tasks})
    origin = SimpleNamespace(fetch_folder=lambda name: None)
    shown: list[tuple[int, int, str]] = []
    for number, least in ((3, None), (4, 0.0)):
        own = {task.task_id: task for task in (*tasks[:number], tasks[-1])}
        dataset: Any = SimpleNamespace(tasks=own, provenance=made, origin=origin)
        found = split_distances(dataset, lambda *progress: shown.append(progress))
        assert [*found] == [NAME]
        assert (found[NAME].train, found[NAME].validation) == (2, number - 2)
        assert found[NAME].least == least if number == 4 else 0.02 < found[NAME].least < 1
    assert shown[:2] == [(0, 1, NAME), (1, 1, "")]


@pytest.mark.slow
@pytest.mark.usefixtures("optimized_actions")
def test_measured_draws_equal_the_stored_table():
    """A new measurement gives the stored values, except the index of the behaviour, which depends on earlier draws."""
    numbers = [("assembly_line", 0, 0), ("assembly_line", 0, 31), ("assembly_line", 1, 5)]
    for found, (family, base_seed, theta_id) in zip(measure_draws(SHIPPED, numbers), numbers, strict=True):
        expected = read_draws(SHIPPED.name, family, base_seed)[theta_id]
        assert replace(found, behaviour=0) == replace(expected, behaviour=0)
