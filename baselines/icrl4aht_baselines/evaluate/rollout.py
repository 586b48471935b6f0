"""Evaluation episodes of an ego and its teammates, as pure JAX functions and as compiled programs.

Shapes: `B` tasks (times seeds) of one teammate family, `T` steps of an episode, `S` bytes of a state record.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.policy import Policy, stacked
from jaxtyping import Array, Float, Int, UInt8

from icrl4aht_baselines.agents.host import EgoInput, HostPolicy
from icrl4aht_baselines.evaluate.protocols import Protocol
from icrl4aht_data.benchmark.facts import FOUR_RECIPES, TRACKS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, with_recipes

EGO_STEPS, TEAMMATE_STEPS = 2, 3  # numbers to fold into random keys; 0 and 1 are for the agents' memories


class RolloutState(NamedTuple):
    """State of B tasks between two steps.

    Attributes:
        env: states of the B environments.
        ego: memories of the egos, a pytree of arrays (B, ...).
        before: outcome of the previous step, arrays of shape (B,); the field `obs` is not used.
    """

    env: EnvState
    ego: Any
    before: EgoInput


class EpisodeBatch(NamedTuple):
    """One episode of B tasks.

    Attributes:
        record: uint8 (B, T, S), state record before each step.
        actions: int32 (B, T, 2), actions of ego and teammate, 0..5.
        reward: float32 (B, T), reward of the team.
        end: uint8 (B, S), state record after the last step.
    """

    record: UInt8[Array, "B T S"]
    actions: Int[Array, "B T 2"]
    reward: Float[Array, "B T"]
    end: UInt8[Array, "B S"]


@dataclass(frozen=True, eq=False)
class EvaluationRollout:
    """Rollout of B tasks that share a teammate family, on one layout or on several.

    On several layouts, every policy must take an input of the same form on all of them: a `Situation`, observations
    with the canonical channels, or observations with the layouts' own channels if these are equal.

    Attributes:
        layout: the layout of all tasks, or a sequence of layouts.
        ego: the ego, which plays all tasks.
        teammates: the B teammates, policies of one family.
        protocol: rules of the evaluation.
        numbers: int (B,), index of each task's layout in `layout`; None for one layout.
    """

    layout: Layout | Sequence[Layout]
    ego: Policy | HostPolicy
    teammates: Sequence[Policy]
    protocol: Protocol
    numbers: np.ndarray | None = None

    @cached_property
    def env(self) -> Environment:
        """Environment of all layouts, with the recipes and the episode length of the protocol."""
        if isinstance(self.layout, Layout):
            return Environment(_protocol_layout(self.layout, self.protocol), self.protocol.steps)
        return Environment([_protocol_layout(one, self.protocol) for one in self.layout], self.protocol.steps)

    @cached_property
    def teammate_params(self) -> Any:
        """Parameters of all teammates, with a leading axis (B,)."""
        return stacked(mate.params for mate in self.teammates)

    def start(self, keys: jax.Array) -> RolloutState:
        """Return the state before the first episode; `keys` are the random keys of the B tasks."""
        return RolloutState(
            self.env.init(keys, self._layout_numbers()), self._initial_memories(keys), no_outcome(keys.shape[0])
        )

    def clear_memory(self, state: RolloutState) -> RolloutState:
        """Return a copy of a state between two episodes, with the egos' memories reset as for a new task."""
        return state._replace(ego=self._initial_memories(state.env.key), before=no_outcome(state.env.key.shape[0]))

    def move_to_layouts(self, state: RolloutState) -> RolloutState:
        """Convert the state of another rollout of the same tasks: its next episode is played on this rollout's layouts.

        Args:
            state: state of the other rollout, between two episodes. Its random keys, episode number and the egos'
                memories are kept.
        """
        numbers = self._layout_numbers()
        record = self.env.first_record(state.env.key, state.env.episode, numbers)
        return state._replace(env=state.env._replace(record=record, layout=numbers))

    def _initial_memories(self, keys: jax.Array) -> Any:
        """Return the egos' memories before the first episode."""
        ego_keys = _fold_keys(keys, EGO)
        if isinstance(self.ego, HostPolicy):
            return self.ego.init(self.ego.params, ego_keys)
        return jax.vmap(self.ego.init, in_axes=(None, 0))(self.ego.params, ego_keys)

    def _layout_numbers(self) -> jax.Array | None:
        return None if self.numbers is None else jnp.asarray(self.numbers, jnp.int32)

    def ego_actions(self, params: Any, state: RolloutState, keys: jax.Array) -> tuple[Int[Array, " B"], Any]:
        """Return the egos' actions in the next step, and their memories after the step."""
        if self.ego.sees not in ("ego_input", "canonical_input"):
            return self.env.act(self.ego, params, state.ego, state.env, EGO, keys, own=False)
        view = state.before._replace(obs=self.env.observe_one(state.env, EGO, self.ego.sees == "canonical_input"))
        if isinstance(self.ego, HostPolicy):
            return self.ego.act(params, state.ego, view, keys)
        return jax.vmap(self.ego.act, in_axes=(None, 0, 0, 0))(params, state.ego, view, keys)

    def episode(self, ego_params: Any, mate_params: Any, state: RolloutState) -> tuple[RolloutState, EpisodeBatch]:
        """Play one episode of every task. Return the next state and the episode. Callers compile this method."""
        mate = self.teammates[0]
        # In each episode teammates start with a new memory, while egos keep theirs.
        keys = self.env.episode_key(state.env)
        memories = jax.vmap(mate.init)(mate_params, _fold_keys(keys, TEAMMATE))
        ego_keys, mate_keys = _fold_keys(keys, EGO_STEPS), _fold_keys(keys, TEAMMATE_STEPS)

        def step(carry: Any, t: Array) -> tuple[Any, Any]:
            state, memories, _ = carry
            now = state.env
            mine, egos = self.ego_actions(ego_params, state, _fold_keys(ego_keys, t))
            theirs, memories = self.env.act(
                mate, mate_params, memories, now, TEAMMATE, _fold_keys(mate_keys, t), own=True
            )
            after = self.env.step(now, jnp.stack([mine, theirs], axis=-1))
            before = state.before._replace(
                prev_action=mine, prev_reward=after.reward, prev_teammate_action=theirs, prev_done=after.done
            )
            played = now.record, jnp.stack([mine, theirs], axis=-1), after.reward
            return (RolloutState(after.state, egos, before), memories, after.final), played

        start = (state, memories, state.env.record)
        (state, _, end), played = jax.lax.scan(step, start, jnp.arange(self.protocol.steps))
        record, actions, reward = (jnp.swapaxes(leaf, 0, 1) for leaf in played)
        return state, EpisodeBatch(record, actions, reward, end)


@lru_cache(maxsize=64)
def _protocol_layout(layout: Layout, protocol: Protocol) -> Layout:
    """Return a layout, with four recipes if the protocol requires them and the layout has its published recipes."""
    published = LAYOUTS.get(layout.name)
    four = protocol.four_recipes and any(layout.name in names for names in TRACKS["layout"].values())
    if not four or published is None or layout.recipes != published.recipes:
        return layout
    return with_recipes(layout, FOUR_RECIPES)


def no_outcome(batch: int) -> EgoInput:
    """Return the input of B egos at the first step of a task: all `prev_*` fields are 0, and `obs` is empty."""
    zero = jnp.zeros(batch, jnp.int32)
    return EgoInput(jnp.zeros((batch, 0)), zero, jnp.zeros(batch), zero, jnp.zeros(batch, bool))


def _fold_keys(keys: jax.Array, data: Any) -> jax.Array:
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, data)


def task_key(seed: int, task_id: str) -> jax.Array:
    """Return the random key of a task, from which the keys of all of its episodes are derived."""
    digest = hashlib.sha256(task_id.encode()).digest()
    return jax.random.fold_in(jax.random.key(seed), int.from_bytes(digest[:4], "big"))


EpisodeProgram = Callable[..., tuple[RolloutState, EpisodeBatch]]
"""Type of a compiled `EvaluationRollout.episode`."""


class ProgramCache:
    """Cache of compiled episodes that several evaluations of an ego can share; `len` is the number of programs.

    The cache is thread-safe: each program is compiled once.
    """

    def __init__(self) -> None:
        self._found: dict[Any, EpisodeProgram] = {}
        self._locks, self._lock = dict[Any, Lock](), Lock()

    def __len__(self) -> int:
        return len(self._found)

    def episode(self, rollout: EvaluationRollout, state: RolloutState) -> EpisodeProgram:
        """Return the compiled program for an episode of a rollout, from the cache if possible.

        Args:
            rollout: the rollout.
            state: a state of the rollout between two episodes.

        Raises:
            OptionError: if the ego's action is not one integer for each observation.
        """
        arguments = rollout.ego.params, rollout.teammate_params, state
        leaves, structure = jax.tree.flatten(arguments)
        policies = [(policy.init, policy.act, policy.sees) for policy in (rollout.ego, rollout.teammates[0])]
        layouts = rollout.layout if isinstance(rollout.layout, Layout) else tuple(rollout.layout)
        shapes = tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)
        # The protocol's other fields change states and policies, but not the program.
        rules = rollout.protocol.steps, rollout.protocol.four_recipes
        key = layouts, rules, *policies, structure, shapes
        with self._lock:
            lock = self._locks.setdefault(key, Lock())
        with lock:  # one lock per program, so that other programs compile at the same time
            if key not in self._found:
                self._found[key] = _compile(rollout, arguments)
            return self._found[key]


def _compile(rollout: EvaluationRollout, arguments: tuple[Any, Any, RolloutState]) -> EpisodeProgram:
    """Compile an episode. The dtype and shape of the egos' actions are checked first, by tracing one step."""
    state = arguments[-1]
    keys = state.env.key
    actions, _ = jax.eval_shape(rollout.ego_actions, rollout.ego.params, state, keys)
    if actions.shape != keys.shape or not jnp.issubdtype(actions.dtype, jnp.integer):
        raise OptionError(
            f"the ego's actions are {actions.dtype} of shape {actions.shape} for {keys.shape[0]} observations, "
            f"expected one integer 0..5 for each"
        )
    episode = jax.jit(rollout.episode)
    return episode if isinstance(rollout.ego, HostPolicy) else episode.lower(*arguments).compile()
