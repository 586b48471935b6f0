"""The JAX environment: random keys, resets and automatic restarts around the rules of `icrl4aht_data.overcooked`.

One `EnvState` is a batch of N environments. Every random draw depends only on an environment's key, the number of the
episode and the step, so an episode does not depend on the other environments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8, UInt32

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe, observe_both
from icrl4aht_data.overcooked.state import initial_record
from icrl4aht_data.overcooked.tables import Tables, stack_tables
from icrl4aht_generation.policy import Policy, Situation


class EnvState(NamedTuple):
    """States of N environments.

    Attributes:
        key: typed JAX keys (N,), one per environment, constant.
        episode: int32 (N,), number of the running episode, from 0.
        clock: int32 (N,), steps taken in the running episode.
        record: uint8 (N, S), state records; see `icrl4aht_data.overcooked.state`.
        layout: int32 (N,), number of the layout of each environment; None if all have one layout.
    """

    key: Key[Array, " N"]
    episode: Int[Array, " N"]
    clock: Int[Array, " N"]
    record: UInt8[Array, "N S"]
    layout: Int[Array, " N"] | None = None


class EnvStep(NamedTuple):
    """Result of one step of N environments.

    Attributes:
        state: the states after the step; an environment that is `done` has already started its next episode.
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
    """The benchmark's version of OvercookedV2 (paper, Sec. 3.1 and App. A), in batches of N environments.

    Observations: uint8 (N, 2, 5, 5, C) from `observe(state)`; `icrl4aht_data.overcooked.observe` lists the channels.
    Actions: int (N, 2), of ego and teammate, 0..5 (up, down, left, right, stay, interact).
    Rewards: float32 (N,), the team's rewards; shaped rewards of each agent are separate. Episodes end after `max_steps`
    steps; the next episode starts automatically.

    With several layouts, `EnvState.layout` is the number of the layout that each environment plays. All state records
    are padded to common columns, see `stack_tables`. Canonical observation channels mean the same on all layouts; a
    layout's own channels mean the same only if all layouts have equal channel names.

    Args:
        layout: one layout or several; or their tables, if a compiled function takes the tables as an argument.
        max_steps: steps of an episode: 400 in training, 100 in evaluation.
        redraws: whether every episode starts on a layout that is drawn at random from all layouts.
    """

    layout: Layout | Sequence[Layout] | Tables
    max_steps: int = EPISODE_STEPS
    redraws: bool = False

    @cached_property
    def tables(self) -> Tables:
        """Tables of the environment's layout, or stacked tables of all its layouts."""
        if isinstance(self.layout, Tables):
            return self.layout
        return self.layout.tables if isinstance(self.layout, Layout) else stack_tables(self.layout)

    @property
    def only_layout(self) -> Layout:
        """The layout of an environment with exactly one layout.

        Raises:
            TypeError: if the environment has several layouts, or only tables.
        """
        if not isinstance(self.layout, Layout):
            raise TypeError("expected an environment of one layout, found several layouts or only a layout's tables")
        return self.layout

    def init(self, keys: Key[Array, " N"], layout: Int[Array, " N"] | None = None) -> EnvState:
        """Return the states at the start of the first episode of each environment.

        Args:
            keys: typed JAX keys (N,), or raw keys, uint32 (N, 2).
            layout: index of each environment's layout; by default all layouts in turn. Ignored with only one layout,
                and if layouts are redrawn.
        """
        if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
            keys = jax.random.wrap_key_data(keys)
        zero = jnp.zeros(keys.shape, jnp.int32)
        if np.ndim(self.tables.kinds) == 1:
            layout = None
        elif self.redraws:
            layout = self._random_layout(keys, zero)
        elif layout is None:
            layout = jnp.arange(len(keys)) % len(self.tables.kinds)
        return EnvState(keys, zero, zero, self.first_record(keys, zero, layout), layout)

    def step(self, state: EnvState, actions: Int[Array, "N 2"]) -> EnvStep:
        """Play one step in every environment; environments with a finished episode start their next episode."""
        clock = state.clock + 1
        outcome: rules.StepResult = self.call_with_tables(
            rules.step, state.layout, state.record, actions, self.next_recipe(state)
        )
        done = clock >= self.max_steps
        episode = state.episode + done

        def restart_ended() -> tuple[Array, Array | None]:
            layout = state.layout
            if self.redraws and layout is not None:
                layout = jnp.where(done, self._random_layout(state.key, episode), layout)
            first = self.first_record(state.key, episode, layout)
            return jnp.where(done[:, None], first, outcome.state), layout

        # In most steps no episode ends, so one condition for the whole batch saves the cost of resets.
        record, layout = jax.lax.cond(jnp.any(done), restart_ended, lambda: (outcome.state, state.layout))
        after = EnvState(state.key, episode, jnp.where(done, 0, clock), record, layout)
        return EnvStep(after, outcome.reward, outcome.shaped, done, outcome.state)

    def call_with_tables(self, function: Callable[..., Any], layout: Int[Array, " N"] | None, *arguments: Array) -> Any:
        """Call a function for every environment, with the tables of the environment's layout and further arrays.

        Args:
            function: function of the tables of one layout, and of arrays with or without a leading axis (N,).
            layout: number of each environment's layout, `EnvState.layout`.
            arguments: further arguments of the function, arrays (N, ...).
        """
        if layout is None:
            return function(self.tables, *arguments)
        return jax.vmap(lambda number, *own: function(self.tables_of(number), *own))(layout, *arguments)

    def tables_of(self, layout: Int[Array, ""] | None) -> Tables:
        """Return the tables of the layout with a given number; the number may be None if there is only one layout."""
        # The compiler fuses this gather with later gathers, so no environment has its own copy of the tables.
        return self.tables if layout is None else jax.tree.map(lambda leaf: jnp.asarray(leaf)[layout], self.tables)

    def act(
        self,
        policy: Policy,
        params: Any,
        memories: Any,
        state: EnvState,
        agent: int,
        keys: Key[Array, " N"],
        *,
        own: bool,
    ) -> tuple[Int[Array, " N"], Any]:
        """Return a policy's actions for one agent of every environment, and the policy's memories after the step.

        Args:
            policy: policy that chooses the actions.
            params: parameters of the policy, stacked on a leading axis of length N if `own` is true.
            memories: memories of the policy, with leaves (N, ...).
            state: the environments' states.
            agent: 0 for the ego, 1 for the teammate.
            keys: one JAX key for each environment.
            own: whether every environment has separate parameters.
        """
        axis = 0 if own else None
        if policy.sees == "situation":
            numbers = jnp.zeros(len(keys), jnp.int32) if state.layout is None else state.layout

            def act(params: Any, memory: Any, number: Array, record: Array, key: Array) -> Any:
                tables = self.tables_of(None if state.layout is None else number)
                return policy.act(params, memory, Situation(tables, record, number), key)

            return jax.vmap(act, in_axes=(axis, 0, 0, 0, 0))(params, memories, numbers, state.record, keys)
        view = state.record if policy.sees == "state" else self.observe_one(state, agent)
        return jax.vmap(policy.act, in_axes=(axis, 0, 0, 0))(params, memories, view, keys)

    def observe(self, state: EnvState, canonical: bool = False) -> UInt8[Array, "N 2 5 5 C"]:
        """Return the observations of both agents, ego first.

        Args:
            state: the environments' states.
            canonical: whether to return the canonical channels, which mean the same on all layouts.
        """
        return self.call_with_tables(partial(observe_both, canonical=canonical), state.layout, state.record)

    def observe_one(self, state: EnvState, agent: int, canonical: bool = False) -> UInt8[Array, "N 5 5 C"]:
        """Return the observations of one agent: 0 for the ego, 1 for the teammate."""
        return self.call_with_tables(partial(observe, agent=agent, canonical=canonical), state.layout, state.record)

    def next_recipe(self, state: EnvState) -> UInt8[Array, " N"]:
        """Return the item byte of the recipe that becomes current if this step makes a correct delivery."""
        keys = _fold_in(self.episode_key(state), state.clock + 1)
        return self.call_with_tables(_random_recipe, state.layout, keys)

    def episode_key(self, state: EnvState) -> Key[Array, " N"]:
        """Return the key of each running episode, which depends only on the environment's key and the episode's number.

        The environment folds a number into this key for each draw: 0 for the start of the episode, `_LAYOUT_DRAW` for a
        layout, and the number of a step (counted from 1) for the recipe after a delivery in this step. No soup is
        delivered before step 22, because a pot cooks for 20 steps, so policies may fold in 1..20 for their own draws.

        `policy_player` gives the policy of agent 0 the key with 0 folded in, from which the start is also drawn.
        """
        return _fold_in(state.key, state.episode)

    def first_record(
        self, keys: Key[Array, " N"], episode: Int[Array, " N"], layout: Int[Array, " N"] | None = None
    ) -> UInt8[Array, "N S"]:
        """Return state records at the start of episodes.

        Recipe and facings are uniformly random. The ego starts on a random cell of its room, and the teammate on a
        random free cell of its room.
        """
        draw = jax.vmap(lambda key: jax.random.split(key, 5))(
            _fold_in(_fold_in(keys, episode), jnp.zeros_like(episode))
        )
        return self.call_with_tables(_first_record, layout, draw)

    def _random_layout(self, keys: Key[Array, " N"], episode: Int[Array, " N"]) -> Int[Array, " N"]:
        """Return a random layout number for the given episode of each environment."""
        return _random_below(
            _fold_in(_fold_in(keys, episode), jnp.full_like(episode, _LAYOUT_DRAW)), np.uint32(len(self.tables.kinds))
        )


_LAYOUT_DRAW = 2**31 - 1
"""Number folded into an episode's key to draw a layout; larger than the number of any step."""


def _first_record(tables: Tables, draw: Key[Array, "*N 5"]) -> UInt8[Array, "*N S"]:
    (ego_room, mate_room), (ego_cells, mate_cells) = jnp.asarray(tables.rooms), jnp.asarray(tables.room_sizes)
    # In a shared room, the ego's cell is not free, so the teammate's random number skips this cell.
    one_room = jnp.all(ego_room == mate_room) & (ego_cells == mate_cells)
    ego_number = _random_below(draw[..., 0], ego_cells)
    mate_number = _random_below(draw[..., 1], mate_cells - one_room)
    mate_number += one_room & (mate_number >= ego_number)
    positions = jnp.stack([ego_room[ego_number], mate_room[mate_number]], axis=-1)
    facings = jnp.stack([_random_below(draw[..., k], np.uint32(4)) for k in (2, 3)], axis=-1).astype(jnp.uint8)
    return initial_record(tables, positions, facings, _random_recipe(tables, draw[..., 4]))


def _random_recipe(tables: Tables, keys: Key[Array, "*N"]) -> UInt8[Array, "*N"]:
    return jnp.asarray(tables.recipes)[_random_below(keys, jnp.asarray(tables.recipe_count))]


def _fold_in(keys: Key[Array, " N"], data: Int[Array, " N"]) -> Key[Array, " N"]:
    return jax.vmap(jax.random.fold_in)(keys, data)


def _random_below(keys: Key[Array, "*N"], n: UInt32[Array, ""] | np.uint32) -> Int[Array, "*N"]:
    """Return a random integer in 0..n-1 for each key, computed as 32 random bits * n >> 32 (bias below n / 2**32)."""
    draw = partial(jax.random.bits, shape=(), dtype=jnp.uint32)
    bits = (jax.vmap(draw) if keys.ndim else draw)(keys)
    # The product is computed in two halves, because JAX has no 64-bit integers by default.
    high = (bits >> 16) * n + ((bits & 0xFFFF) * n >> 16)
    return (high >> 16).astype(jnp.int32)
