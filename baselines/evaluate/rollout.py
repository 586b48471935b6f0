"""TODO."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from baselines.agents.host import HostPolicy, Percept
from baselines.evaluate.protocols import Protocol
from generation.env import Environment, EnvState
from generation.policy import Policy, stacked
from icrl4aht_data.benchmark.facts import track_of
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout

_FOUR_RECIPES = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))


class RolloutState(NamedTuple):
    """What a step carries into the next. B tasks of one layout and family."""

    env: EnvState
    ego: Any  # memories, batched
    before: Percept  # what preceded the coming step, but for `obs`


class Episode(NamedTuple):
    """One episode of T steps of B tasks."""

    record: UInt8[Array, "B T S"]  # before each step
    actions: Int[Array, "B T 2"]
    reward: Float[Array, "B T"]  # the team's


@dataclass(frozen=True, eq=False)
class EvaluationRollout:
    """Episodes of B tasks that share a layout and a teammate family, compiled once."""

    layout: Layout
    ego: Policy | HostPolicy
    teammates: Sequence[Policy]
    protocol: Protocol

    @cached_property
    def env(self) -> Environment:
        four = self.protocol.four_recipes and track_of(self.layout.name) == "layout"
        recipes = np.array([self.layout.recipe_item(r) for r in _FOUR_RECIPES], np.uint8) if four else None
        return Environment(self.layout, self.protocol.steps, recipes)

    @property
    def teammate_params(self) -> Any:
        """Of all tasks, stacked on a leading axis."""
        return stacked(mate.params for mate in self.teammates)

    def start(self, keys: jax.Array) -> RolloutState:
        """Task keys (B,) -> tables before the first episode; nothing precedes a task's first step."""
        batch = keys.shape[0]
        egos = self._ego.init(self.ego.params, _fold_all(keys, EGO))
        zero = jnp.zeros(batch, jnp.int32)
        nothing = Percept(jnp.zeros((batch, 0)), zero, jnp.zeros(batch), zero, jnp.zeros(batch, bool))
        return RolloutState(self.env.init(keys), egos, nothing)

    @cached_property
    def _ego(self) -> HostPolicy:
        """The ego as batched functions."""
        if isinstance(self.ego, HostPolicy):
            return self.ego
        init, act = jax.vmap(self.ego.init, in_axes=(None, 0)), jax.vmap(self.ego.act, in_axes=(None, 0, 0, 0))
        return HostPolicy(self.ego.params, init, act, self.ego.sees)

    def episode(self, ego_params: Any, mate_params: Any, tables: RolloutState) -> tuple[RolloutState, Episode]:
        """One episode of every task. Jit it once."""
        mate = self.teammates[0]
        keys = self.env.episode_key(tables.env)
        memories = jax.vmap(mate.init)(mate_params, _fold_all(keys, TEAMMATE))
        ego_keys, mate_keys = _fold_all(keys, 2), _fold_all(keys, 3)

        def step(carry, t):
            tables, memories = carry
            now = tables.env
            mine, egos = self._ego.act(ego_params, tables.ego, self.ego_view(tables), _fold_all(ego_keys, t))
            theirs, memories = jax.vmap(mate.act)(
                mate_params, memories, self._view(mate.sees, now, TEAMMATE), _fold_all(mate_keys, t)
            )
            after = self.env.step(now, jnp.stack([mine, theirs], axis=-1))
            before = tables.before._replace(
                prev_action=mine, prev_reward=after.reward, prev_teammate_action=theirs, prev_done=after.done
            )
            played = Episode(now.record, jnp.stack([mine, theirs], axis=-1), after.reward)
            return (RolloutState(after.state, egos, before), memories), played

        (tables, _), played = jax.lax.scan(step, (tables, memories), jnp.arange(self.protocol.steps))
        return tables, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), played)

    def ego_view(self, tables: RolloutState) -> Any:
        """What the egos are given now, batched."""
        if self.ego.sees == "percept":
            return tables.before._replace(obs=self._view("observation", tables.env, EGO))
        return self._view(self.ego.sees, tables.env, EGO)

    def _view(self, sees: str, state: EnvState, seat: int) -> jax.Array:
        return state.record if sees == "state" else self.env.observe_one(state, seat)


def _fold_all(keys: jax.Array, data: Any) -> jax.Array:
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, data)


def task_key(seed: int, task_id: str) -> jax.Array:
    """The key that all of a task's episodes come from."""
    digest = hashlib.sha256(task_id.encode()).digest()
    return jax.random.fold_in(jax.random.key(seed), int.from_bytes(digest[:4], "big"))
