"""Mean returns of reference egos with a teammate, which show how much an ego can raise the return."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.provenance import ReferenceEgos
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, STAY, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Tables
from icrl4aht_data.utils.groups import grouped
from icrl4aht_generation.env import Environment
from icrl4aht_generation.experts.oracle import SITUATION_ORACLE
from icrl4aht_generation.experts.padded import padded_layout, unpadded_layout
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy, stacked

REFERENCE_EPISODES = 20
"""Number of episodes over which the mean return of a reference ego is measured."""

_SEED = 11


def reference_returns(layout: Layout, teammates: Sequence[Policy], episodes: int = REFERENCE_EPISODES) -> np.ndarray:
    """Measure the returns of the reference egos with teammates in episodes of 100 steps.

    All pairs play from equal first states, and a teammate's returns do not depend on the other teammates. All pairs
    share one compilation.

    Args:
        layout: layout of the episodes.
        teammates: policies that play agent 1; at least one.
        episodes: number of episodes of each ego with each teammate.

    Returns:
        Mean return of each of `REFERENCE_EGOS` with each teammate, float64 (teammates, egos).
    """
    families = list(stacked_families(teammates))
    # Policies that see observations or state records of one layout need the layout without padding.
    every = all(family.sees == "situation" for _, family in families)
    tables, expert, _ = (padded_layout if every else unpadded_layout)(layout)
    play = _compile(
        tuple((tuple(numbers), family._replace(params=())) for numbers, family in families), len(teammates), episodes
    )
    earned = np.asarray(play(tables, expert, [family.params for _, family in families]), np.float64)
    return earned.reshape(len(REFERENCE_EGOS), len(teammates), episodes).mean(axis=-1).T


def reference_egos(returns: np.ndarray, self_play: float | None = None) -> ReferenceEgos:
    """Return the record of one teammate's measurements.

    Args:
        returns: float64 (egos,), the teammate's row of `reference_returns`.
        self_play: mean return of a learned teammate with its training partner; None for other teammates.
    """
    stay, random, oracle = returns.tolist()  # in the order of `REFERENCE_EGOS`
    return ReferenceEgos(stay, random, oracle, REFERENCE_EPISODES, self_play)


@lru_cache(maxsize=16)
def _compile(families: tuple[tuple[tuple[int, ...], Policy], ...], teammates: int, episodes: int) -> Callable[..., Any]:
    """Return a compiled function that plays all pairs and returns the episodes' returns.

    Its arguments are the layout's tables, and the parameters of the oracle and of each family.
    """
    each = teammates * episodes
    total = len(REFERENCE_EGOS) * each  # environments are ordered by ego, teammate and episode
    mate_of = np.arange(total) // episodes % teammates
    starts = jax.random.split(jax.random.key(_SEED), episodes)

    @jax.jit
    def play(tables: Tables, expert: Any, params: Sequence[Any]) -> Array:
        env = Environment(tables, KEPT_STEPS)
        players = [
            policy_player(env, ego, expert if name == "oracle" else (), EGO, total, only=k * each + np.arange(each))
            for k, (name, ego) in enumerate(REFERENCE_EGOS.items())
        ]
        for (numbers, family), all_params in zip(families, params, strict=True):
            envs = np.flatnonzero(np.isin(mate_of, numbers))
            rows = np.searchsorted(numbers, mate_of[envs])
            own = jax.tree.map(lambda leaf, rows=rows: leaf[rows], all_params)
            players.append(policy_player(env, family, own, TEAMMATE, total, own_params=True, only=envs))
        carry = init_rollout(env, players, jnp.tile(starts, total // episodes))
        return roll_out(env, players, carry, env.max_steps, starts[0])[1].reward.sum(axis=0)

    return play


def _act_randomly(params: Any, key: Any, view: Any, _: Any) -> tuple[Any, Any]:
    key, own = jax.random.split(key)
    return jax.random.randint(own, (), 0, len(ACTIONS)), key


def _stay(params: Any, memory: Any, view: Any, key: Any) -> tuple[Any, Any]:
    return jnp.int32(STAY), memory


REFERENCE_EGOS = {
    "stay": Policy((), lambda params, key: (), _stay, "situation"),
    "random": Policy((), lambda params, key: key, _act_randomly, "situation"),
    "oracle": SITUATION_ORACLE,
}
"""Policies of the egos "stay", "random" (uniform over the six actions) and "oracle" by name."""


def stacked_families(policies: Sequence[Policy]) -> Iterator[tuple[list[int], Policy]]:
    """Yield groups of policies with equal functions: their indices, and one policy with stacked parameters."""
    groups = grouped(range(len(policies)), lambda number: policies[number]._replace(params=()))
    for numbers in groups.values():
        yield numbers, policies[numbers[0]]._replace(params=stacked(policies[n].params for n in numbers))
