"""Check by play: whether the scripted expert, alone or with another one, delivers a soup."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from icrl4aht_data.overcooked.actions import EGO, STAY, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.rules import CORRECT
from icrl4aht_data.overcooked.state import swapped
from icrl4aht_generation.env import Environment
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy

_PAIRS = np.array([[True, True, False], [True, False, True]])  # which agents play in each environment


def layouts_delivered(layouts: Sequence[Layout]) -> Bool[np.ndarray, " layouts"]:
    """Return for each layout whether an oracle, or a pair of them, delivers at least once in an episode of 400 steps.

    There are three episodes on a layout: with a pair, and with each agent alone while the other stays.
    """
    return np.array([_delivers(layout) for layout in layouts], bool)


def _delivers(layout: Layout) -> bool:
    """Return whether oracles deliver on one layout; compiles a program for it, which takes seconds."""
    env = Environment(layout)
    egos = _if_playing(oracle(layout)), _if_playing(_as_teammate(oracle(_ExchangedLayout(*_arguments(layout)))))
    count = _PAIRS.shape[1]
    players = [
        policy_player(env, policy, jnp.array(_PAIRS[agent]), agent, count, own_params=True)
        for agent, policy in ((EGO, egos[0]), (TEAMMATE, egos[1]))
    ]

    @jax.jit
    def play(key):
        carry = init_rollout(env, players, jax.random.split(key, count))
        return roll_out(env, players, carry, env.max_steps, key)[1].reward.max()

    return bool(play(jax.random.key(0)) >= CORRECT)


def _if_playing(policy: Policy) -> Policy:
    """Return a policy whose parameter, bool (), decides whether it acts or always stays."""

    def act(playing, memory, record, key):
        action, memory = policy.act((), memory, record, key)
        return jnp.where(playing, action, STAY), memory

    return policy._replace(init=lambda playing, key: policy.init((), key), act=act)


def _as_teammate(policy: Policy) -> Policy:
    """Return a policy of the ego for the teammate."""
    return policy._replace(act=lambda params, memory, record, key: policy.act(params, memory, swapped(record), key))


class _ExchangedLayout(Layout):
    """Layout whose agents are exchanged, for policies that only play the ego."""

    @cached_property
    def agent_cells(self) -> tuple[int, ...]:
        return super().agent_cells[::-1]


def _arguments(layout: Layout) -> tuple:
    return layout.name, layout.alias, layout.rows, layout.recipes, layout.indicates_delivery
