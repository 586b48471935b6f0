"""Hamming distances: by hand, between families, and of policies that watch the same episodes."""

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

LAYOUT = get_layout("cramped_up")
STEPS = 6


def count(params, key) -> jax.Array:
    return jnp.int32(0)


def turning(params, steps, view, key):
    """Acts by the steps it has watched and what it sees."""
    return (params["turn"] + steps + view.sum(dtype=jnp.int32)) % 6, steps + 1


def by_state(params, steps, view, key):
    """Chooses an action by its parameter and the position of agent 1."""
    return (view[1].astype(jnp.int32) + params["turn"]) % 6, steps


def policy(turn: int, act: Any = turning) -> Policy:
    return Policy({"turn": jnp.int32(turn)}, count, act, "state" if act is by_state else "observation")


POLICIES = [policy(0), policy(1, by_state), policy(0), policy(1)]


@pytest.fixture(scope="module", autouse=True)
def every_program_is_kept() -> Iterator[None]:
    """Every call compiles small programs, so compiling is their cost."""
    least = jax.config.jax_persistent_cache_min_compile_time_secs  # type: ignore[attr-defined]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    yield
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


@pytest.fixture(scope="module")
def actions(every_program_is_kept) -> np.ndarray:
    return actions_on_common_states(LAYOUT, POLICIES, seed=3, steps=STEPS)


@pytest.fixture(scope="module")
def records(every_program_is_kept) -> jax.Array:
    """(T, episodes, S) of random agents."""
    env = build.Environment(LAYOUT, STEPS)
    players = [build.policy_player(env, build.REFERENCE_EGOS["random"], (), agent, 3) for agent in (0, 1)]
    carry = build.init_rollout(env, players, jax.random.split(jax.random.key(0), 3))
    play = jax.jit(lambda carry: build.roll_out(env, players, carry, STEPS, jax.random.key(1))[1].record)
    return play(carry)


# By hand.


def test_hamming_against_a_loop():
    actions = np.random.default_rng(0).integers(0, 6, (4, 50)).astype(np.int8)
    found = hamming_distances(actions)
    for a in range(4):
        for b in range(4):
            assert found[a, b] == sum(x != y for x, y in zip(actions[a], actions[b], strict=True)) / 50


def test_families_are_as_far_as_their_policies_on_average():
    """Within a family a policy's distance to itself counts, as in the paper's formula."""
    distances = np.array([[0, 0.5, 1, 0.2], [0.5, 0, 0.6, 0.4], [1, 0.6, 0, 0.8], [0.2, 0.4, 0.8, 0]])
    found = family_distances(distances, {"A": [0, 2], "B": [1], "C": range(1, 4)})
    expected = [
        [(0 + 1 + 1 + 0) / 4, (0.5 + 0.6) / 2, (0.5 + 1 + 0.2 + 0.6 + 0 + 0.8) / 6],
        [(0.5 + 0.6) / 2, 0, (0 + 0.6 + 0.4) / 3],
        [(0.5 + 1 + 0.2 + 0.6 + 0 + 0.8) / 6, (0 + 0.6 + 0.4) / 3, 2 * (0.6 + 0.4 + 0.8) / 9],
    ]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


# On common states.


def test_identical_policies_have_distance_0_and_others_do_not(actions):
    distances = hamming_distances(actions)
    assert distances[0, 2] == 0
    assert distances[0, 3] == 1  # always one action further
    assert 0 < distances[0, 1] < 1


@pytest.mark.slow
def test_policies_observe_as_the_teammate_with_a_memory(records, monkeypatch):
    """Against a loop over the same states: counted from each episode's start, seen as the teammate sees it."""
    monkeypatch.setattr(build, "_visited_records", lambda env, numbers, family, key: records)
    found = actions_on_common_states(LAYOUT, [policy(2), policy(1, by_state)], steps=STEPS)
    repeated = np.concatenate([records, records], axis=1)  # once for either family
    seen = observe(LAYOUT, repeated, TEAMMATE).sum(axis=(2, 3, 4))
    expected = (2 + np.arange(STEPS)[:, None] + seen) % 6
    np.testing.assert_array_equal(found[0].reshape(seen.shape), expected)
    np.testing.assert_array_equal(found[1].reshape(seen.shape), (repeated[..., 1] + 1) % 6)
