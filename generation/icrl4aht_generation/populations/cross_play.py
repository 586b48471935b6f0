"""Cross-play of learned policies: mean returns of pairs over episodes of 400 steps, in one compiled rollout."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.rollout import Player, init_rollout, network_player, roll_out

EPISODES_PER_PAIR = 20
"""Number of episodes for each pair of policies (paper, App. B.1)."""


def cross_play_returns(
    layout: Layout,
    network: ActorCritic,
    egos: Any,
    teammates: Any,
    seed: int = 0,
    episodes: int = EPISODES_PER_PAIR,
    greedy: bool = False,
    paired: bool = False,
) -> np.ndarray:
    """Return the mean returns of pairs of policies over episodes of 400 steps.

    Args:
        layout: layout on which the policies play.
        network: the network of all policies.
        egos: parameters of A policies, stacked on a leading axis.
        teammates: parameters of B policies, stacked on a leading axis.
        seed: seed of the episodes and the actions.
        episodes: number of episodes of each pair.
        greedy: whether teammates take their most probable actions, as in the dataset. All other policies sample their
            actions, as in training, because two greedy policies can block each other forever.
        paired: whether ego i only plays with teammate i.

    Returns:
        Mean returns of all pairs, float64 (A, B); with `paired`, float64 (A,).
    """
    a, b = (jax.tree.leaves(params)[0].shape[0] for params in (egos, teammates))
    first, second = np.divmod(np.arange(a * b), b)
    if paired:
        first = second = np.arange(a)
    play = _compiled_play(layout, network.widths, network.partners, tuple(first), tuple(second), episodes, greedy)
    returns = np.asarray(play(egos, teammates, jax.random.key(seed)), np.float64)
    return returns if paired else returns.reshape(a, b)


@lru_cache(maxsize=32)
def _compiled_play(
    layout: Layout, widths: Widths, partners: int, first: tuple, second: tuple, episodes: int, greedy: bool
) -> Callable[[Any, Any, jax.Array], jax.Array]:
    """Compile a function (egos, teammates, key) -> mean return of each pair.

    Pair i is ego `first[i]` with teammate `second[i]`.
    """
    env, network = Environment(layout), ActorCritic(widths, partners)
    n = len(first) * episodes
    policies = [np.repeat(np.array(side), episodes) for side in (first, second)]

    def player(params: Any, agent: int, greedy: bool) -> Player:
        numbers = range(max(policies[agent]) + 1)
        slots = np.stack([(policies[agent] == number).nonzero()[0] for number in numbers]) + agent * n
        return network_player(env, network, params, slots, jnp.zeros(slots.shape, jnp.int32), greedy)

    @jax.jit
    def play(egos, teammates, key):
        players = [player(egos, EGO, False), player(teammates, TEAMMATE, greedy)]
        carry = init_rollout(env, players, jax.random.split(jax.random.fold_in(key, 0), n))
        _, rollout = roll_out(env, players, carry, EPISODE_STEPS, jax.random.fold_in(key, 1))
        return rollout.reward.sum(axis=0).reshape(len(first), episodes).mean(axis=1)

    return play
