"""Find out by playing episodes whether an oracle, or a pair of oracles, delivers a soup on a layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from icrl4aht_data.overcooked.actions import EGO, STAY, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD
from icrl4aht_data.overcooked.state import swap_agents
from icrl4aht_data.overcooked.tables import Tables, stack_tables
from icrl4aht_generation.env import Environment
from icrl4aht_generation.experts.oracle import SITUATION_ORACLE, oracle_params
from icrl4aht_generation.experts.padded import largest_layouts
from icrl4aht_generation.learners.rollout import Player, RolloutCarry, init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Situation

_AT_ONCE = 512  # number of layouts in a batch; all batches share one compilation
_STEPS = 100

_BOTH, _EGO, _TEAMMATE = (True, True), (True, False), (False, True)
_QUICK = ((1, _BOTH, True), (1, _EGO, True), (1, _TEAMMATE, True))
_THOROUGH = ((4, _BOTH, True), (4, _EGO, True), (4, _TEAMMATE, True), (4, _BOTH, False))
"""Tries in order: hundreds of steps, which of the two agents play and do not just stay, and whether the agents start on
the map's start cells instead of random cells. Few layouts need the thorough tries."""


def are_playable(
    layouts: Sequence[Layout], checked: Callable[[int], None] = lambda count: None
) -> Bool[np.ndarray, " layouts"]:
    """Return for each layout whether one or two oracles deliver a soup in an episode of 400 steps.

    Args:
        layouts: layouts to test.
        checked: called with the number of layouts decided since the last call, to show progress.
    """
    found, largest = np.zeros(len(layouts), bool), largest_layouts(tuple(layouts))
    for tries in (_QUICK, _THOROUGH):
        missing = np.flatnonzero(~found)
        for start in range(0, len(missing), _AT_ONCE):
            numbers = missing[start : start + _AT_ONCE]
            found[numbers] = _can_deliver(layouts, largest, numbers, tries)
            checked(int(found[numbers].sum()))
    checked(int((~found).sum()))
    return found


def _can_deliver(
    layouts: Sequence[Layout],
    largest: list[Layout],
    numbers: np.ndarray,
    tries: Sequence[tuple[int, tuple[bool, bool], bool]],
) -> Bool[np.ndarray, " numbers"]:
    # Every batch includes the largest layouts, so arrays have equal shapes and all batches share one compilation.
    own = [layouts[number] for number in np.resize(numbers, _AT_ONCE)] + largest
    tables, keys = stack_tables(own), jax.random.split(jax.random.key(0), len(own))
    # Computing `LayoutFacts` takes longer than an episode, so all tries of a batch share the result.
    egos = oracle_params(own), oracle_params([_SwappedStartsLayout(*astuple(layout)) for layout in own])
    starts = np.array([layout.agent_cells for layout in own], np.uint8)
    earned = np.zeros(len(own), bool)
    for hundreds, playing, at_starts in tries:
        if earned[: len(numbers)].all():
            break
        carry = _start_episodes(tables, egos, keys, starts, at_starts)
        for _ in range(hundreds):
            carry, reward = _play(tables, egos, jnp.array(playing), carry)
            earned |= np.asarray(reward) >= DELIVERY_REWARD
    return earned[: len(numbers)]


def _players(env: Environment, egos: tuple[Any, Any], playing: Any, count: int) -> list[Player]:
    """Return a player for each agent of every environment: an oracle, or a player that never moves (`stay`)."""

    def act(agent: int) -> Callable[..., Any]:
        def act_if_playing(params: Any, memory: Any, view: Situation, key: Any) -> Any:
            record = view.record if agent == EGO else swap_agents(view.record)
            action, memory = SITUATION_ORACLE.act(params, memory, view._replace(record=record), key)
            return jnp.where(playing[agent], action, STAY), memory

        return act_if_playing

    return [
        policy_player(env, SITUATION_ORACLE._replace(act=act(agent)), egos[agent], agent, count)
        for agent in (EGO, TEAMMATE)
    ]


@jax.jit
def _start_episodes(tables: Tables, egos: tuple[Any, Any], keys: Any, starts: Any, at_starts: Any) -> RolloutCarry:
    """Return the `RolloutCarry` of new episodes, with agents on random cells or on the maps' start cells."""
    env = Environment(tables)
    carry = init_rollout(env, _players(env, egos, (True, True), len(keys)), keys)
    record = carry.env.record
    moved = jnp.where(at_starts, record.at[:, :2].set(starts), record)
    return carry._replace(env=carry.env._replace(record=moved))


@jax.jit
def _play(tables: Tables, egos: tuple[Any, Any], playing: Any, carry: RolloutCarry) -> tuple[RolloutCarry, Any]:
    env = Environment(tables)
    players = _players(env, egos, playing, len(carry.ended))
    carry, played = roll_out(env, players, carry, _STEPS, jax.random.key(0))
    return carry, played.reward.max(axis=0)


class _SwappedStartsLayout(Layout):
    """Layout with the agents' start cells swapped, for a policy that can only play the ego."""

    @cached_property
    def agent_cells(self) -> tuple[int, ...]:
        return super().agent_cells[::-1]
