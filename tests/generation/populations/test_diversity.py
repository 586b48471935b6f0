"""Test Hamming distances between policies, and between families, by their actions on the same states."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.populations import build
from icrl4aht_generation.populations.build import actions_on_common_states, family_distances
from icrl4aht_generation.teammates.distances import hamming_distances

from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.states import random_records

LAYOUT = get_layout("cramped_up")
STEPS = 6


def start_steps(params, key) -> jax.Array:
    return jnp.int32(0)


def act_by_view(params, steps, view, key):
    """Return an action that depends on the parameter, the number of steps and the observation."""
    return (params["turn"] + steps + view.sum(dtype=jnp.int32)) % 6, steps + 1


def act_by_state(params, steps, view, key):
    """Return an action that depends on the parameter and the position of agent 1."""
    return (view[1].astype(jnp.int32) + params["turn"]) % 6, steps


def policy(turn: int, act: Any = act_by_view) -> Policy:
    return Policy({"turn": jnp.int32(turn)}, start_steps, act, "state" if act is act_by_state else "observation")


POLICIES = [policy(0), policy(1, act_by_state), policy(0), policy(1)]


@pytest.fixture(scope="module", autouse=True)
def cache_all_programs() -> Iterator[None]:
    """Cache all compiled programs, since these tests spend most of their time on compiling small programs."""
    least = jax.config.jax_persistent_cache_min_compile_time_secs  # type: ignore[attr-defined]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    yield
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


@pytest.fixture(scope="module")
def actions(cache_all_programs) -> np.ndarray:
    return actions_on_common_states(LAYOUT, POLICIES, seed=3, steps=STEPS)


def test_hamming_distances_equal_a_loop_over_states():
    actions = np.random.default_rng(0).integers(0, 6, (4, 50)).astype(np.int8)
    found = hamming_distances(actions)
    for a in range(4):
        for b in range(4):
            assert found[a, b] == sum(x != y for x, y in zip(actions[a], actions[b], strict=True)) / 50


def test_family_distance_is_the_mean_over_pairs_of_policies():
    """As in the paper's formula, the mean within a family includes distances of policies to themselves."""
    distances = np.array([[0, 0.5, 1, 0.2], [0.5, 0, 0.6, 0.4], [1, 0.6, 0, 0.8], [0.2, 0.4, 0.8, 0]])
    found = family_distances(distances, {"A": [0, 2], "B": [1], "C": range(1, 4)})
    expected = [
        [(0 + 1 + 1 + 0) / 4, (0.5 + 0.6) / 2, (0.5 + 1 + 0.2 + 0.6 + 0 + 0.8) / 6],
        [(0.5 + 0.6) / 2, 0, (0 + 0.6 + 0.4) / 3],
        [(0.5 + 1 + 0.2 + 0.6 + 0 + 0.8) / 6, (0 + 0.6 + 0.4) / 3, 2 * (0.6 + 0.4 + 0.8) / 9],
    ]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_only_identical_policies_have_distance_0(actions):
    distances = hamming_distances(actions)
    assert distances[0, 2] == 0
    assert distances[0, 3] == 1  # actions of policies 0 and 3 always differ
    assert 0 < distances[0, 1] < 1


@pytest.mark.slow
def test_actions_on_common_states_use_teammate_observations_and_memory(monkeypatch):
    """Memory is reset at each episode, and policies that see observations receive the teammate's observation."""
    records = random_records(LAYOUT, 3 * STEPS, np.random.default_rng(0)).reshape(STEPS, 3, -1)
    monkeypatch.setattr(build, "_visited_records", lambda env, numbers, family, key: records)
    found = actions_on_common_states(LAYOUT, [policy(2), policy(1, act_by_state)], steps=STEPS)
    repeated = np.concatenate([records, records], axis=1)  # one copy for each of the two families
    seen = observe(LAYOUT, repeated, TEAMMATE).sum(axis=(2, 3, 4))
    expected = (2 + np.arange(STEPS)[:, None] + seen) % 6
    np.testing.assert_array_equal(found[0].reshape(seen.shape), expected)
    np.testing.assert_array_equal(found[1].reshape(seen.shape), (repeated[..., 1] + 1) % 6)
