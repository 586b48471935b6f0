"""Diversity of policies: pairwise Hamming distances of their actions on common states (paper, App. "Teammate Policy
Diversity Analysis")."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from generation.env import Environment
from generation.learners.rollout import init_rollout, policy_player, random_player, roll_out
from generation.policy import Policy, stacked
from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe

_EPISODES = 2


def actions_on_common_states(
    layout: Layout, policies: Sequence[Policy], seed: int = 0, steps: int = EPISODE_STEPS
) -> np.ndarray:
    """Actions of every policy, as the teammate, on the same states.

    The states are those of roll-outs with a uniformly random ego and each policy in turn as the teammate, two episodes
    each. Every policy acts on every state; its memory follows the episode that it observes.

    Returns:
        int8 (policies, states), states = policies x 2 x steps.
    """
    env, key = Environment(layout, steps), jax.random.key(seed)
    played = [_play(env, *family, key) for family in _families(policies)]
    records = jnp.concatenate(played, axis=1)  # (T, episodes, S)
    actions = np.zeros((len(policies), records.shape[0] * records.shape[1]), np.int8)
    for numbers, policy in _families(policies):
        actions[numbers] = np.asarray(_act_along(env, policy, records, key)).reshape(len(numbers), -1)
    return actions


def hamming_distances(actions: np.ndarray) -> np.ndarray:
    """Share of states on which two policies act differently: int (P, N) -> float64 (P, P)."""
    return (actions[:, None] != actions[None]).mean(axis=-1)


def family_distances(distances: np.ndarray, families: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Mean distances of families, over all pairs of their policies: (P, P) -> float64 (F, F).

    Within a family, pairs of a policy with itself count too, as in the paper's formula.
    """
    return np.array([[distances[np.ix_(a, b)].mean() for b in families.values()] for a in families.values()])


def _families(policies: Sequence[Policy]) -> Iterator[tuple[list[int], Policy]]:
    """Yields policies that share their functions: their numbers, and one policy with stacked parameters."""
    groups: dict[tuple[Callable, Callable, str], list[int]] = defaultdict(list)
    for number, policy in enumerate(policies):
        groups[policy.init, policy.act, policy.sees].append(number)
    for numbers in groups.values():
        yield numbers, policies[numbers[0]]._replace(params=stacked(policies[n].params for n in numbers))


def _play(env: Environment, numbers: list[int], family: Policy, key: Any) -> jax.Array:
    """Records uint8 (T, policies x 2, S) of a random ego with each policy of the family."""
    n = len(numbers) * _EPISODES

    @jax.jit
    def play(params, key):
        own = jax.tree.map(lambda leaf: jnp.repeat(leaf, _EPISODES, axis=0), params)
        players = [random_player(EGO, n), policy_player(env, family, own, TEAMMATE, n, own_params=True)]
        carry = init_rollout(env, players, jax.random.split(key, n))
        return roll_out(env, players, carry, env.max_steps, key)[1].record

    return play(family.params, jax.random.fold_in(key, numbers[0]))


def _act_along(env: Environment, family: Policy, records: jax.Array, key: Any) -> jax.Array:
    """Actions int8 (policies, T, episodes) of each policy of the family along recorded episodes."""
    keys = jax.random.split(key, records.shape[1])

    @jax.jit
    def act_along(params):
        def one(params):
            memories = jax.vmap(family.init, in_axes=(None, 0))(params, keys)

            def step(memories, record):
                view = record if family.sees == "state" else observe(env.layout, record, TEAMMATE)
                actions, memories = jax.vmap(family.act, in_axes=(None, 0, 0, 0))(params, memories, view, keys)
                return memories, actions.astype(jnp.int8)

            return jax.lax.scan(step, memories, records)[1]

        return jax.lax.map(one, params)

    return act_along(family.params)
