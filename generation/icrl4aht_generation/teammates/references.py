"""Mean returns of reference egos with a teammate, which show how much an ego can raise the return."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

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
    starts = jax.random.split(jax.random.key(_SEED), episodes)
    pairs = [(ego, mate) for ego in REFERENCE_EGOS for mate in range(len(teammates)) for _ in range(episodes)]
    played = play_reference_egos(layout, teammates, pairs, jnp.tile(starts, len(pairs) // episodes), "reward")
    earned = np.asarray(played, np.float64).sum(axis=0)
    return earned.reshape(len(REFERENCE_EGOS), len(teammates), episodes).mean(axis=-1).T


def reference_egos(returns: np.ndarray, self_play: float | None = None) -> ReferenceEgos:
    """Return the record of the reference egos' returns with one teammate.

    Args:
        returns: float64 (egos,), the teammate's row of `reference_returns`.
        self_play: mean return of a learned teammate with its training partner; None for other teammates.
    """
    stay, random, oracle = returns.tolist()  # in the order of `REFERENCE_EGOS`
    return ReferenceEgos(stay, random, oracle, REFERENCE_EPISODES, self_play)


def play_reference_egos(
    layout: Layout,
    teammates: Sequence[Policy],
    pairs: Sequence[tuple[str, int]],
    keys: Key[Array, " N"],
    field: Literal["record", "reward"],
) -> Array:
    """Play reference egos with teammates in episodes of 100 steps.

    Args:
        layout: layout of the episodes.
        teammates: policies that play agent 1; at least one.
        pairs: for each of N episodes, a name from `REFERENCE_EGOS` and the index of a teammate.
        keys: key of each episode.
        field: field of `Rollout` to return.

    Returns:
        State records before each step, uint8 (100, N, S), or rewards, float32 (100, N). Records are those of
        `padded_layout` if all teammates see a `Situation`.
    """
    families = list(stacked_policy_groups(teammates))
    # Policies that see observations or state records of one layout need the layout without padding.
    every = all(family.sees == "situation" for _, family in families)
    tables, expert, _ = (padded_layout if every else unpadded_layout)(layout)
    play = _compiled_play(
        tuple((tuple(numbers), family._replace(params=())) for numbers, family in families), tuple(pairs), field
    )
    return play(tables, expert, [family.params for _, family in families], keys)


@lru_cache(maxsize=16)
def _compiled_play(
    families: tuple[tuple[tuple[int, ...], Policy], ...], pairs: tuple[tuple[str, int], ...], field: str
) -> Callable[..., Array]:
    """Return a compiled function that plays the pairs and returns a field of the rollout.

    The function's arguments are the layout's tables, the oracle's parameters, each family's parameters, and the keys.
    """
    ego_of, mate_of = (np.array(column) for column in zip(*pairs, strict=True))

    @jax.jit
    def play(tables: Tables, expert: Any, params: Sequence[Any], keys: Key[Array, " N"]) -> Array:
        env = Environment(tables, KEPT_STEPS)
        players = []
        for name in np.unique(ego_of):
            own = expert if name == "oracle" else ()
            envs = np.flatnonzero(ego_of == name)
            players.append(policy_player(env, REFERENCE_EGOS[name], own, EGO, len(pairs), only=envs))
        for (numbers, family), all_params in zip(families, params, strict=True):
            envs = np.flatnonzero(np.isin(mate_of, numbers))
            rows = np.searchsorted(numbers, mate_of[envs])
            own = jax.tree.map(lambda leaf, rows=rows: leaf[rows], all_params)
            players.append(policy_player(env, family, own, TEAMMATE, len(pairs), own_params=True, only=envs))
        carry = init_rollout(env, players, keys)
        return getattr(roll_out(env, players, carry, env.max_steps, keys[0])[1], field)

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


def stacked_policy_groups(policies: Sequence[Policy]) -> Iterator[tuple[list[int], Policy]]:
    """Yield groups of policies with equal functions: their indices, and one policy with stacked parameters."""
    groups = grouped(range(len(policies)), lambda number: policies[number]._replace(params=()))
    for numbers in groups.values():
        yield numbers, policies[numbers[0]]._replace(params=stacked(policies[n].params for n in numbers))
