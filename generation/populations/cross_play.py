"""What policies earn together: learned policies in both seats, whole training episodes, by one compiled roll-out."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from generation.env import Environment
from generation.learners.network import ActorCritic, Widths
from generation.learners.rollout import Player, init_rollout, network_player, roll_out
from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout

EPISODES = 20
"""Episodes of each pair (paper, App. B.1)."""


def matrix(
    layout: Layout, network: ActorCritic, left: Any, right: Any, seed: int = 0, episodes: int = EPISODES, greedy=False
) -> np.ndarray:
    """Mean returns of all pairs over episodes of 400 steps.

    Args:
        layout: the kitchen.
        network: of all policies.
        left: parameters of A policies for seat 0, stacked on a leading axis.
        right: of B policies for seat 1.
        seed: of the episodes and the draws.
        episodes: of each pair.
        greedy: whether the policy in seat 1 takes its likeliest actions, as teammates do. All others draw theirs, as in
            training; two greedy players can stand in each other's way for ever.

    Returns:
        float64 (A, B).
    """
    a, b = (jax.tree.leaves(params)[0].shape[0] for params in (left, right))
    first, second = np.divmod(np.arange(a * b), b)
    returns = _play(layout, network.widths, network.partners, tuple(first), tuple(second), episodes, greedy)(
        left, right, jax.random.key(seed)
    )
    return np.asarray(returns, np.float64).reshape(a, b)


def together(
    layout: Layout, network: ActorCritic, left: Any, right: Any, seed: int = 0, episodes: int = EPISODES, greedy=False
) -> np.ndarray:
    """Mean returns float64 (A,) of left policy i with right policy i; arguments as in `matrix`."""
    pairs = tuple(range(jax.tree.leaves(left)[0].shape[0]))
    returns = _play(layout, network.widths, network.partners, pairs, pairs, episodes, greedy)(
        left, right, jax.random.key(seed)
    )
    return np.asarray(returns, np.float64)


@lru_cache(maxsize=32)
def _play(
    layout: Layout, widths: Widths, partners: int, first: tuple, second: tuple, episodes: int, greedy: bool
) -> Callable[[Any, Any, jax.Array], jax.Array]:
    """A function of both stacks and a key that gives the mean return of each pair (first[k], second[k])."""
    env, network = Environment(layout), ActorCritic(widths, partners)
    n = len(first) * episodes
    sides = [np.repeat(np.array(side), episodes) for side in (first, second)]

    def player(params: Any, seat: int, greedy: bool) -> Player:
        policies = range(max(sides[seat]) + 1)
        places = np.stack([(sides[seat] == policy).nonzero()[0] for policy in policies]) + seat * n
        return network_player(env, network, params, places, jnp.zeros(places.shape, jnp.int32), greedy)

    @jax.jit
    def play(left, right, key):
        players = [player(left, EGO, False), player(right, TEAMMATE, greedy)]
        seats = init_rollout(env, players, jax.random.split(jax.random.fold_in(key, 0), n))
        _, rollout = roll_out(env, players, seats, EPISODE_STEPS, jax.random.fold_in(key, 1))
        return rollout.reward.sum(axis=0).reshape(len(first), episodes).mean(axis=1)

    return play
