"""The JAX environment: keys, reset draws and auto-reset around the rules of `icrl4aht_data.overcooked`.

Batch first: one `EnvState` holds N environments. Everything random is a function of an environment's own key, the
number of its episode and the step in it, so an episode does not depend on the other environments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe, observe_both
from icrl4aht_data.overcooked.state import start


class EnvState(NamedTuple):
    """States of N environments.

    Attributes:
        key: typed JAX keys (N,), one per environment, constant.
        episode: int32 (N,), number of the running episode, from 0.
        clock: int32 (N,), steps taken in the running episode.
        record: uint8 (N, S), state records; see `icrl4aht_data.overcooked.state`.
    """

    key: Key[Array, " N"]
    episode: Int[Array, " N"]
    clock: Int[Array, " N"]
    record: UInt8[Array, "N S"]


class EnvStep(NamedTuple):
    """Result of one step of N environments.

    Attributes:
        state: the states after the step; where `done`, the start of the next episode.
        reward: float32 (N,), the team's reward.
        shaped: float32 (N, 2), each agent's shaped reward, not part of `reward`.
        done: bool (N,), whether the step ended an episode.
        final: uint8 (N, S), state records after the step, before any reset.
    """

    state: EnvState
    reward: Float[Array, " N"]
    shaped: Float[Array, "N 2"]
    done: Bool[Array, " N"]
    final: UInt8[Array, "N S"]


@dataclass(frozen=True, eq=False)
class Environment:
    """OvercookedV2 as the benchmark uses it (paper, Sec. 3.1 and App. A).

    Observations: uint8 (N, 2, 5, 5, C) from `observe(state)`; `icrl4aht_data.overcooked.observe` lists the channels.
    Actions: int (N, 2), of ego and teammate, 0..5 (up, down, left, right, stay, interact).
    Rewards: float32 (N,), the team's; shaped rewards per agent are separate. Episodes end after `max_steps` steps; the
    next one starts automatically.

    Args:
        layout: the map and its recipes.
        max_steps: steps of an episode: 400 in training, 100 in evaluation.
        recipes: uint8 (R,), items of the recipes to draw from; by default those of the layout.
    """

    layout: Layout
    max_steps: int = EPISODE_STEPS
    recipes: np.ndarray | None = None

    @property
    def recipe_items(self) -> np.ndarray:
        """uint8 (R,): items of the recipes that the environment draws from."""
        return self.layout.recipe_items if self.recipes is None else self.recipes

    def init(self, keys: Key[Array, " N"]) -> EnvState:
        """Return the start of the first episode of each environment.

        Args:
            keys: typed JAX keys (N,), or raw ones, uint32 (N, 2).
        """
        if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
            keys = jax.random.wrap_key_data(keys)
        zero = jnp.zeros(keys.shape, jnp.int32)
        return EnvState(keys, zero, zero, self.first_record(keys, zero))

    def step(self, state: EnvState, actions: Int[Array, "N 2"]) -> EnvStep:
        """Return the result of one step of every environment; finished ones start their next episode."""
        clock = state.clock + 1
        outcome = rules.step(self.layout, state.record, actions, self.next_recipe(state))
        done = clock >= self.max_steps
        episode = state.episode + done
        # Environments that were initialized together finish together, so one condition for the batch avoids the cost of
        # the reset in all other steps.
        record = jax.lax.cond(
            jnp.any(done),
            lambda: jnp.where(done[:, None], self.first_record(state.key, episode), outcome.state),
            lambda: outcome.state,
        )
        after = EnvState(state.key, episode, jnp.where(done, 0, clock), record)
        return EnvStep(after, outcome.reward, outcome.shaped, done, outcome.state)

    def observe(self, state: EnvState) -> UInt8[Array, "N 2 5 5 C"]:
        """Return the observations of both agents, ego first."""
        return observe_both(self.layout, state.record)

    def observe_one(self, state: EnvState, agent: int) -> UInt8[Array, "N 5 5 C"]:
        """Return the observations of one agent: 0 for the ego, 1 for the teammate."""
        return observe(self.layout, state.record, agent)

    def next_recipe(self, state: EnvState) -> UInt8[Array, " N"]:
        """Return the item of the recipe that becomes current if this step makes a correct delivery."""
        return self._recipe(_fold(self.episode_key(state), state.clock + 1))

    def episode_key(self, state: EnvState) -> Key[Array, " N"]:
        """Return the key of each running episode: a function of the environment's key and the episode's number.

        Policies may fold in 1..20. Those are the recipe draws of an episode's first steps, which are never used, since
        no soup is done before step 20.
        """
        return _fold(state.key, state.episode)

    def first_record(self, keys: Key[Array, " N"], episode: Int[Array, " N"]) -> UInt8[Array, "N S"]:
        """Return state records at the start of episodes.

        Recipe and facings are uniform; first the ego, then the teammate is put on a uniformly drawn free cell of its
        own room.
        """
        draw = jax.vmap(lambda key: jax.random.split(key, 5))(_fold(_fold(keys, episode), jnp.zeros_like(episode)))
        ego_room, mate_room = self.layout.rooms
        ego_number = _below(draw[:, 0], len(ego_room))
        ego = jnp.asarray(ego_room)[ego_number]
        if np.array_equal(ego_room, mate_room):
            mate_number = _below(draw[:, 1], len(mate_room) - 1)
            mate_number += mate_number >= ego_number
        else:
            mate_number = _below(draw[:, 1], len(mate_room))
        positions = jnp.stack([ego, jnp.asarray(mate_room)[mate_number]], axis=-1)
        facings = jnp.stack([_below(draw[:, 2], 4), _below(draw[:, 3], 4)], axis=-1).astype(jnp.uint8)
        return start(self.layout, positions, facings, self._recipe(draw[:, 4]))

    def _recipe(self, keys: Key[Array, " N"]) -> UInt8[Array, " N"]:
        return jnp.asarray(self.recipe_items)[_below(keys, len(self.recipe_items))]


def _fold(keys: Key[Array, " N"], data: Int[Array, " N"]) -> Key[Array, " N"]:
    return jax.vmap(jax.random.fold_in)(keys, data)


def _below(keys: Key[Array, " N"], n: int) -> Int[Array, " N"]:
    """Return an integer in 0..n-1 per key: the high half of 32 random bits times n (bias below n / 2**32)."""
    bits = jax.vmap(lambda key: jax.random.bits(key, (), jnp.uint32))(keys)
    high = (bits >> 16) * n + ((bits & 0xFFFF) * n >> 16)
    return (high >> 16).astype(jnp.int32)
