"""Diversity of policies: pairwise Hamming distances of their actions on common states (paper, App. "Teammate Policy
Diversity Analysis")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, random_player, roll_out
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.distances import act_along
from icrl4aht_generation.teammates.references import stacked_families

_EPISODES = 2


def actions_on_common_states(
    layout: Layout, policies: Sequence[Policy], seed: int = 0, steps: int = EPISODE_STEPS
) -> np.ndarray:
    """Return actions of every policy, as the teammate, on the same states.

    The states are those of roll-outs with a uniformly random ego and each policy in turn as the teammate, two episodes
    each. Every policy acts on every state; its memory follows the episode that it observes.

    Returns:
        int8 (policies, states), states = policies x 2 x steps.
    """
    env, key = Environment(layout, steps), jax.random.key(seed)
    played = [_play(env, *family, key) for family in stacked_families(policies)]
    records = jnp.concatenate(played, axis=1)  # (T, episodes, S)
    return act_along(layout, policies, records, seed).reshape(len(policies), -1)


def family_distances(distances: np.ndarray, families: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Return mean distances of families, over all pairs of their policies: (P, P) -> float64 (F, F).

    Within a family, pairs of a policy with itself count too, as in the paper's formula.
    """
    return np.array([[distances[np.ix_(a, b)].mean() for b in families.values()] for a in families.values()])


def _play(env: Environment, numbers: list[int], family: Policy, key: Any) -> jax.Array:
    """Return records uint8 (T, policies x 2, S) of a random ego with each policy of the family."""
    n = len(numbers) * _EPISODES

    @jax.jit
    def play(params, key):
        own = jax.tree.map(lambda leaf: jnp.repeat(leaf, _EPISODES, axis=0), params)
        players = [random_player(EGO, n), policy_player(env, family, own, TEAMMATE, n, own_params=True)]
        carry = init_rollout(env, players, jax.random.split(key, n))
        return roll_out(env, players, carry, env.max_steps, key)[1].record

    return play(family.params, jax.random.fold_in(key, numbers[0]))
