"""Adapter for egos outside JAX: NumPy, PyTorch, or anything else that maps a batch of observations to actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.policy import Policy
from jax.experimental import io_callback

from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.overcooked.channels import CHANNELS, Channels, to_canonical
from icrl4aht_data.overcooked.layouts import Layout


class EgoInput(NamedTuple):
    """Input of an ego with memory: the ego's observation, and the outcome of the previous step.

    At the first step of an episode, the `prev_*` fields describe the last step of the previous episode, as in training.
    At the first step of a task they are zero. A `HostAgent` receives arrays of B tasks, with a leading axis (B,).

    Attributes:
        obs: uint8 (5, 5, C), the ego's observation.
        prev_action: int32 (), the ego's action in the previous step, 0..5.
        prev_reward: float32 (), the team's reward in the previous step.
        prev_teammate_action: int32 (), the teammate's action in the previous step, 0..5.
        prev_done: bool (), whether the previous step ended an episode.
    """

    obs: Any
    prev_action: Any
    prev_reward: Any
    prev_teammate_action: Any
    prev_done: Any


class HostPolicy(Policy):
    """Policy for agents that JAX cannot batch. Its functions take the keys and `EgoInput`s of B tasks at once."""


class HostAgent(Protocol):
    """Interface of an ego outside JAX, which plays B tasks in parallel and stores its memory itself."""

    def reset(self, batch: int) -> None:
        """Clear the memory and prepare to play `batch` tasks in parallel.

        Called before the first step of the tasks, and before each episode if the evaluation clears the ego's memory.
        """
        ...

    def act(self, ego_input: EgoInput) -> np.ndarray:
        """Return the actions in B tasks: integers in 0..5, as an array of shape (B,).

        The arrays of `ego_input` have a leading axis of length B: `obs` is uint8 of shape (B, 5, 5, C). The arrays are
        copies, which the agent may keep and change.
        """
        ...


def from_host(agent: HostAgent, channels: Channels = "own") -> Callable[[Layout], HostPolicy]:
    """Return the `make_ego` argument of `icrl4aht_baselines.evaluate.evaluate` for a `HostAgent`.

    For each layout and teammate family, `reset` is called before the first step, and `act` once per step for all tasks.
    If the evaluation clears the ego's memory, `reset` is called before each episode.

    Args:
        agent: the ego.
        channels: channels of the observations that the agent takes: "own" for those of each layout, or "canonical" for
            those that all layouts share.

    Raises:
        UnknownNameError: if `channels` has another value.
        OptionError: if the agent has no `reset` or `act`; during evaluation, if `act` does not return B integers.
    """
    for name in ("reset", "act"):
        if not callable(getattr(agent, name, None)):
            raise OptionError(f"agent = {agent!r:.100}: expected an object with the methods reset and act")
    check_choice("channels", channels, CHANNELS)

    def make_policy(layout: Layout) -> HostPolicy:
        def init(params, keys):
            agent.reset(keys.shape[0])
            return ()

        def call_agent(*ego_input) -> np.ndarray:
            batch = len(ego_input[1])
            actions = np.asarray(agent.act(EgoInput(*map(np.array, ego_input))))
            if actions.shape != (batch,) or not np.issubdtype(actions.dtype, np.integer):
                raise OptionError(
                    f"the agent's method act returned {actions.dtype} of shape {actions.shape}, "
                    f"expected integers of shape ({batch},)"
                )
            return actions.astype(np.int32)

        def act(params, carry, ego_input: EgoInput, keys):
            if channels == "canonical":
                ego_input = ego_input._replace(obs=to_canonical(layout, ego_input.obs))
            shape = jax.ShapeDtypeStruct(keys.shape, jnp.int32)
            return io_callback(call_agent, shape, *ego_input, ordered=True), carry

        return HostPolicy((), init, act, "ego_input")

    return make_policy
