"""How far `cached` acting drifts from `exact` (see `agents.ACTING`), measured on episodes that the cached ego plays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from baselines.evaluate.evaluator import prepare_rollout
from baselines.evaluate.protocols import Protocol
from baselines.methods.method import Method
from baselines.methods.tokens import step_of
from generation.policy import Policy
from icrl4aht_data.benchmark.tasks import Task


class Drift(NamedTuple):
    """One episode of T steps of B tasks."""

    distance: Float[np.ndarray, "B T"]  # total variation between the two policies, 0..1
    same: Bool[np.ndarray, "B T"]  # whether both would take the same action


class _Both(NamedTuple):
    """What the ego remembers either way, and the running episode's comparison."""

    kept: Any
    anew: Any
    steps: Int[jax.Array, ""]
    distance: Float[jax.Array, " T"]
    same: Bool[jax.Array, " T"]


def measure(method: Method, params: Any, context: int, tasks: Sequence[Task], protocol: Protocol) -> Iterator[Drift]:
    """Episode after episode of tasks that share a layout and a teammate family.

    Args:
        method, params, context: the model, see `agents.learned`.
        tasks: B of them.
        protocol: says how many episodes.
    """
    length = protocol.steps

    def init(params: Any, key: Any) -> _Both:
        kept, anew = (method.start(context, cached) for cached in (True, False))
        return _Both(kept, anew, jnp.int32(0), jnp.zeros(length), jnp.zeros(length, bool))

    def act(params: Any, both: _Both, percept: Any, key: Any) -> tuple[Any, _Both]:
        (one, kept), (two, anew) = (
            method.act(params, step_of(percept), percept.prev_done, memory) for memory in (both.kept, both.anew)
        )
        distance, same = jnp.abs(jax.nn.softmax(one) - jax.nn.softmax(two)).sum() / 2, one.argmax() == two.argmax()
        at = both.steps % length
        after = _Both(kept, anew, both.steps + 1, both.distance.at[at].set(distance), both.same.at[at].set(same))
        return one.argmax().astype(jnp.int32), after

    ego = Policy(params, init, act, "percept")
    rollout, tables, episode = prepare_rollout(lambda layout: ego, tasks, protocol)
    for _ in range(protocol.episodes):
        tables, _ = episode(params, rollout.teammate_params, tables)
        yield Drift(np.asarray(tables.ego.distance), np.asarray(tables.ego.same))
