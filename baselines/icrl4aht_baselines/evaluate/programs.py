"""Compiled episodes, shared by all groups of tasks that need equal ones."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_baselines.agents.host import HostPolicy
from icrl4aht_baselines.evaluate.rollout import EpisodeBatch, EvaluationRollout, RolloutState
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout

EpisodeProgram = Callable[..., tuple[RolloutState, EpisodeBatch]]
"""Compiled `EvaluationRollout.episode`."""


class Programs:
    """Compiled episodes of one or several evaluations of an ego; `len` is their number.

    Threads may share it: each program is compiled once.
    """

    def __init__(self) -> None:
        self._found: dict[Any, Future[EpisodeProgram]] = {}
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._found)

    def episode(self, rollout: EvaluationRollout, state: RolloutState) -> EpisodeProgram:
        """Return the compiled episode of a rollout.

        Args:
            rollout: the rollout.
            state: a state between two of its episodes.

        Raises:
            OptionError: if the ego's action is not one integer for each observation.
        """
        arguments = rollout.ego.params, rollout.teammate_params, state
        leaves, structure = jax.tree.flatten(arguments)
        policies = [(policy.init, policy.act, policy.sees) for policy in (rollout.ego, rollout.teammates[0])]
        layouts = rollout.layout if isinstance(rollout.layout, Layout) else tuple(rollout.layout)
        shapes = tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)
        rules = rollout.protocol.steps, rollout.protocol.four_recipes  # others are in states and policies
        key = layouts, rules, *policies, structure, shapes
        mine = Future[EpisodeProgram]()
        with self._lock:
            found = self._found.setdefault(key, mine)
        if found is mine:
            try:
                found.set_result(_compile(rollout, arguments))
            except BaseException as error:
                found.set_exception(error)
        return found.result()


def _compile(rollout: EvaluationRollout, arguments: tuple[Any, Any, RolloutState]) -> EpisodeProgram:
    _check_actions(rollout, arguments[-1])
    episode = jax.jit(rollout.episode)
    return episode if isinstance(rollout.ego, HostPolicy) else episode.lower(*arguments).compile()


def _check_actions(rollout: EvaluationRollout, state: RolloutState) -> None:
    """Trace one step of the egos, which yields shape and dtype of their actions without computing any."""
    keys = state.env.key
    actions, _ = jax.eval_shape(rollout.ego_actions, rollout.ego.params, state, keys)
    if actions.shape != keys.shape or not jnp.issubdtype(actions.dtype, jnp.integer):
        raise OptionError(
            f"the ego's actions are {actions.dtype} of shape {actions.shape} for {keys.shape[0]} observations, "
            f"expected one integer 0..5 for each"
        )
