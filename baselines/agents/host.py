"""Adapter for egos outside JAX: NumPy, PyTorch, or anything else that maps a batch of percepts to actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout


class Percept(NamedTuple):
    """Input of an ego with memory (`sees = "percept"`): its observation and the outcome of its last step.

    As in training, the last step before an episode's first is the previous episode's last. Before a task's first step
    all of `prev_*` is zero. Arrays have a leading axis (B,) for host agents.

    Attributes:
        obs: uint8 (5, 5, C), the ego's observation.
        prev_action: int32 (), the ego's last action.
        prev_reward: float32 (), the team's last reward.
        prev_teammate_action: int32 (), the teammate's last action.
        prev_done: bool (), whether the last step ended an episode.
    """

    obs: Any
    prev_action: Any
    prev_reward: Any
    prev_teammate_action: Any
    prev_done: Any


class HostPolicy(NamedTuple):
    """A `generation.policy.Policy` whose functions take a complete batch, for agents that cannot be vmapped.

    Attributes:
        params: pytree of parameters.
        init: (params, keys (B,)) -> carry of the batch.
        act: (params, carry, views of the batch, keys (B,)) -> (int32 (B,) actions, carry).
        sees: what `act` is given.
    """

    params: Any
    init: Callable[[Any, Any], Any]
    act: Callable[[Any, Any, Any, Any], tuple[Any, Any]]
    sees: Literal["state", "observation", "percept"]


class HostAgent(Protocol):
    """An ego outside JAX. It plays B tasks at once and keeps its own memory."""

    def reset(self, batch: int) -> None:
        """Forget everything: a new set of `batch` tasks begins."""
        ...

    def act(self, percept: Percept) -> np.ndarray:
        """Returns integers (B,) in 0..5 for a `Percept` of arrays with leading axis B: obs uint8 (B, 5, 5, C), ..."""
        ...


def from_host(agent: HostAgent) -> Callable[[Layout], HostPolicy]:
    """Returns the evaluator's ego of a `HostAgent`.

    The agent's `act` is called once per step, in order, with all tasks of one layout and teammate family.

    Raises:
        OptionError: during evaluation, if `act` does not return B integers.
    """

    def make(layout: Layout) -> HostPolicy:
        def init(params, keys):
            agent.reset(keys.shape[0])
            return ()

        def call(*percept) -> np.ndarray:
            batch = len(percept[1])
            actions = np.asarray(agent.act(Percept(*(np.asarray(part) for part in percept))))
            if actions.shape != (batch,) or not np.issubdtype(actions.dtype, np.integer):
                raise OptionError(
                    f"the agent's act returned {actions.dtype} of shape {actions.shape}, expected integers ({batch},)"
                )
            return actions.astype(np.int32)

        def act(params, carry, percept: Percept, keys):
            shape = jax.ShapeDtypeStruct(keys.shape, jnp.int32)
            return io_callback(call, shape, *percept, ordered=True), carry

        return HostPolicy((), init, act, "percept")

    return make
