"""The heuristic teammate H4 (utility_greedy): random waiting for the partner."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.teammates.heuristics import utility_greedy
from icrl4aht_generation.teammates.heuristics.utility_greedy import GreedyMemory
from icrl4aht_generation.teammates.registry import build_teammate, heuristic_teammate

from icrl4aht_data.overcooked.actions import STAY, UP
from icrl4aht_data.overcooked.layouts import LAYOUTS
from tests.helpers.states import state_record

ROLLS = [0, 1, 19, 20, 39, 40, 41, 99]


@lru_cache
def _act(slot: int):
    """Return a function that steps eight H4 agents on cramped_up: memory, records (8, S) -> actions (8,), memory."""
    policy = build_teammate(LAYOUTS["cramped_up"], heuristic_teammate("utility_greedy", "default", 0), slot)
    keys = jax.random.split(jax.random.key(0), 8)
    act = jax.jit(jax.vmap(policy.act, in_axes=(None, 0, 0, 0)))
    return lambda memory, records: act(policy.params, memory, records, keys)


def _memory(rolls: list[int], intent: int = -1, wait: int = 0) -> GreedyMemory:
    key = jax.random.wrap_key_data(jnp.array([[300 + roll, 7] for roll in rolls], jnp.uint32))
    return GreedyMemory(key, jnp.full(8, intent), jnp.full(8, wait))


def _moving_up(slot: int, partner: tuple[int, int, str]) -> np.ndarray:
    """Return eight equal records (8, S): H4 with empty hands at (1, 2) wants to move up, towards pile 0."""
    mover = (1, 2, "up")
    record = state_record(LAYOUTS["cramped_up"], *((mover, partner) if slot == 0 else (partner, mover)))
    return np.repeat(record, 8, axis=0)


@pytest.mark.parametrize("slot", [0, 1])
def test_h4_yields_only_if_its_next_cell_is_adjacent_to_the_partner(slot):
    actions, after = _act(slot)(_memory(ROLLS), _moving_up(slot, (2, 1, "down")))
    yields = [roll < (20, 40)[slot] for roll in ROLLS]
    assert actions.tolist() == [STAY if y else UP for y in yields]
    assert after.wait.tolist() == [1 + roll % 2 if y else 0 for y, roll in zip(yields, ROLLS, strict=True)]
    assert after.intent.tolist() == [utility_greedy.FETCH] * 8
    actions, after = _act(slot)(_memory(ROLLS), _moving_up(slot, (3, 2, "down")))
    assert (actions.tolist(), after.wait.tolist()) == ([UP] * 8, [0] * 8)


def test_waiting_h4_keeps_its_intent_and_advances_its_random_key():
    memory = _memory(ROLLS, intent=utility_greedy.PRESS, wait=2)
    keys = [memory.key]
    for wait in (1, 0):
        actions, memory = _act(1)(memory, _moving_up(1, (2, 1, "down")))
        keys.append(memory.key)
        assert actions.tolist() == [STAY] * 8
        assert memory.wait.tolist() == [wait] * 8
        assert memory.intent.tolist() == [utility_greedy.PRESS] * 8
    for before, after in pairwise(keys):
        links = jax.vmap(lambda key: jax.random.split(key, 3)[0])(before)
        np.testing.assert_array_equal(jax.random.key_data(after), jax.random.key_data(links))
