"""The JAX environment: keys, reset draws and auto-reset around the rules of `icrl4aht_data.overcooked`.

Batch first: one `EnvState` holds N environments. Everything random is a function of an environment's own key, the
number of its episode and the step in it, so an episode is the same whatever ran beside it.
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
    """N environments."""

    key: Key[Array, " N"]  # one per environment, constant; a batch of typed keys
    episode: Int[Array, " N"]  # number of the running episode, from 0
    clock: Int[Array, " N"]  # steps taken in it
    record: UInt8[Array, "N S"]


class EnvStep(NamedTuple):
    """What a step gives. `state` is that of the next episode where `done`; `final` is never reset."""

    state: EnvState
    reward: Float[Array, " N"]  # the team's
    shaped: Float[Array, "N 2"]  # each agent's own
    done: Bool[Array, " N"]  # the episode ended with this step
    final: UInt8[Array, "N S"]  # the record that the step led to


@dataclass(frozen=True, eq=False)
class Environment:
    """OvercookedV2 as the benchmark uses it (paper, Sec. 3.1 and App. A).

    Observation: `observe(state)` is uint8 (N, 2, 5, 5, C) with values 0..19; see `overcooked.observe` for the channels.
    Action: integers (N, 2), ego and teammate, ids 0..5 (up, down, left, right, stay, interact).
    Reward: the team's; shaped rewards per agent are apart. Termination: after `max_steps` steps, then auto-reset.

    Args:
        layout: the kitchen.
        max_steps: 400 in training, 100 in evaluation.
        recipes: uint8 item bytes to draw from; the layout's own by default.
    """

    layout: Layout
    max_steps: int = EPISODE_STEPS
    recipes: np.ndarray | None = None

    @property
    def recipe_items(self) -> np.ndarray:
        return self.layout.recipe_items if self.recipes is None else self.recipes

    def init(self, keys: Key[Array, " N"]) -> EnvState:
        """The first episode of each environment; keys also as raw uint32 (N, 2)."""
        if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
            keys = jax.random.wrap_key_data(keys)
        zero = jnp.zeros(keys.shape, jnp.int32)
        return EnvState(keys, zero, zero, self.first_record(keys, zero))

    def step(self, state: EnvState, actions: Int[Array, "N 2"]) -> EnvStep:
        """One step of every environment; finished ones start their next episode.

        Environments that were initialised together finish together, so the reset runs under one condition on the
        whole batch and costs nothing in the other steps.
        """
        clock = state.clock + 1
        outcome = rules.step(self.layout, state.record, actions, self.next_recipe(state))
        done = clock >= self.max_steps
        episode = state.episode + done
        record = jax.lax.cond(
            jnp.any(done),
            lambda: jnp.where(done[:, None], self.first_record(state.key, episode), outcome.state),
            lambda: outcome.state,
        )
        after = EnvState(state.key, episode, jnp.where(done, 0, clock), record)
        return EnvStep(after, outcome.reward, outcome.shaped, done, outcome.state)

    def observe(self, state: EnvState) -> UInt8[Array, "N 2 5 5 C"]:
        """What both agents see."""
        return observe_both(self.layout, state.record)

    def observe_one(self, state: EnvState, agent: int) -> UInt8[Array, "N 5 5 C"]:
        """What one agent sees: 0 the ego, 1 the teammate."""
        return observe(self.layout, state.record, agent)

    def next_recipe(self, state: EnvState) -> UInt8[Array, " N"]:
        """The recipe that a correct delivery in this step would bring."""
        return self._recipe(_fold(self.episode_key(state), state.clock + 1))

    def episode_key(self, state: EnvState) -> Key[Array, " N"]:
        """The key of each running episode: a function of the environment's key and the episode's number.

        Players may fold in 1..20: those are the recipe draws of an episode's first steps, which nothing uses, since no
        soup is done before step 20.
        """
        return _fold(state.key, state.episode)

    def first_record(self, keys: Key[Array, " N"], episode: Int[Array, " N"]) -> UInt8[Array, "N S"]:
        """Start records: recipe and facings uniform; agents placed one after the other, each uniformly on a free
        cell of its own room."""
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
    """One integer in 0..n-1 per key: the high half of 32 random bits times n (bias below n / 2**32)."""
    bits = jax.vmap(lambda key: jax.random.bits(key, (), jnp.uint32))(keys)
    high = (bits >> 16) * n + ((bits & 0xFFFF) * n >> 16)
    return (high >> 16).astype(jnp.int32)
