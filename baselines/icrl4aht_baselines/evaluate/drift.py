"""Difference between `cached` and `exact` acting (see `agents.egos.ACTING`), on episodes that the cached ego plays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.policy import Policy
from jaxtyping import Bool, Float, Int

from icrl4aht_baselines.agents.egos import with_view
from icrl4aht_baselines.evaluate.evaluator import prepare_rollout
from icrl4aht_baselines.evaluate.protocols import Protocol
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.tokens import input_step
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.overcooked.channels import Channels


class Drift(NamedTuple):
    """Comparison of `cached` and `exact` acting in one episode of T steps of B tasks.

    Attributes:
        distance: float32 (B, T), total variation between both policies, 0..1.
        same: bool (B, T), whether both choose the same action.
    """

    distance: Float[np.ndarray, "B T"]
    same: Bool[np.ndarray, "B T"]


class _BothMemories(NamedTuple):
    """Memories of both ways of acting, and the running episode's comparison, (T,)."""

    cached: Any
    exact: Any
    steps: Int[jax.Array, ""]
    distance: Float[jax.Array, " T"]
    same: Bool[jax.Array, " T"]


def measure_drift(
    method: Method,
    params: Any,
    context: int,
    tasks: Sequence[Task],
    protocol: Protocol,
    channels: Channels = "own",
) -> Iterator[Drift]:
    """Compare both ways of acting on tasks that share a layout and a teammate family.

    Args:
        method, params, context: the model, see `agents.egos.learned`.
        tasks: the B tasks.
        protocol: also sets the number of episodes.
        channels: channels of the observations that the model takes.

    Yields:
        One `Drift` per episode.
    """
    length = protocol.steps

    def init(params: Any, key: Any) -> _BothMemories:
        cached, exact = (method.start(context, way) for way in (True, False))
        return _BothMemories(cached, exact, jnp.int32(0), jnp.zeros(length), jnp.zeros(length, bool))

    def act(params: Any, both: _BothMemories, ego_input: Any, key: Any) -> tuple[Any, _BothMemories]:
        (one, cached), (two, exact) = (
            method.act(params, input_step(ego_input), ego_input.prev_done, memory)
            for memory in (both.cached, both.exact)
        )
        distance, same = jnp.abs(jax.nn.softmax(one) - jax.nn.softmax(two)).sum() / 2, one.argmax() == two.argmax()
        t = both.steps % length
        compared = both.distance.at[t].set(distance), both.same.at[t].set(same)
        return one.argmax().astype(jnp.int32), _BothMemories(cached, exact, both.steps + 1, *compared)

    ego = Policy(params, init, act, "ego_input")
    rollout, state, episode = prepare_rollout(lambda layout: with_view(ego, channels), tasks, protocol)
    for _ in range(protocol.episodes):
        state, _ = episode(params, rollout.teammate_params, state)
        yield Drift(np.asarray(state.ego.distance), np.asarray(state.ego.same))
