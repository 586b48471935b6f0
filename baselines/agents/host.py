"""TODO."""

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
    """What an ego with memory is given (`sees = "percept"`): what it sees, and what its last step brought.

    As in training, the last step before an episode's first is the previous episode's last; nothing precedes a task's
    first step, there all are zero.
    """

    obs: Any  # uint8 (5, 5, C)
    prev_action: Any  # int32
    prev_reward: Any  # float32, the team's
    prev_teammate_action: Any  # int32
    prev_done: Any  # bool: the last step ended an episode


class HostPolicy(NamedTuple):
    """A `Policy` whose functions take a whole batch: for agents that cannot be vmapped, see `from_host`."""

    params: Any
    init: Callable[[Any, Any], Any]
    act: Callable[[Any, Any, Any, Any], tuple[Any, Any]]
    sees: Literal["state", "observation", "percept"]


class HostAgent(Protocol):
    """An ego in NumPy, PyTorch or anything else. B tasks are played at once; the agent keeps its own memory."""

    def reset(self, batch: int) -> None:
        """A new set of B tasks begins: forget everything."""
        ...

    def act(self, percept: Percept) -> np.ndarray:
        """Integers (B,) in 0..5 for a `Percept` of arrays with leading axis B: obs uint8 (B, 5, 5, C), ..."""
        ...


def from_host(agent: HostAgent) -> Callable[[Layout], HostPolicy]:
    """The evaluator's ego of a `HostAgent`; its `act` is called once a step, in order, with all tasks of a group.

    Raises:
        OptionError: during evaluation, if `act` returns other than B integers.
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
