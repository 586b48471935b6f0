"""Training teammates that do not always follow their script, so that a model learns to act without their help.

In each episode, a teammate has one of four behaviours: it follows its script, does nothing, acts at random, or follows
its script except for some random actions. The behaviour is sampled from the teammate's probabilities at the start of
the episode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.policy import Policy, randomize_action

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import STAY
from icrl4aht_data.overcooked.layouts import Layout

BEHAVIOURS = ("script", "stay", "random", "noisy")
"""Behaviours of a teammate, in the order of its probabilities."""

NOISY_SHARE = 0.3
"""Probability of a random action in the behaviour "noisy"."""

MIXTURE: tuple[tuple[float, tuple[float, ...]], ...] = (
    (0.60, (1.0, 0.0, 0.0, 0.0)),
    (0.12, (0.0, 1.0, 0.0, 0.0)),
    (0.08, (0.0, 0.0, 1.0, 0.0)),
    (0.10, (0.0, 0.0, 0.0, 1.0)),
    (0.10, (0.25, 0.25, 0.25, 0.25)),
)
"""Pairs of a share of the tasks and the probabilities of `BEHAVIOURS` of their teammates."""


def tasks_on_layouts(tasks: Sequence[Task], layouts: Sequence[Layout]) -> list[Task]:
    """Return the tasks of a manifest that are on one of the layouts.

    Raises:
        OptionError: if a task has a learned teammate (the message names the task), or no task is on one of the layouts.
    """
    for task in tasks:
        if task.teammate["kind"] != "heuristic":
            raise OptionError(
                f"task {task.task_id}: its teammate is learned; expected heuristics, which need no checkpoints: leave "
                f"these tasks out of the manifest"
            )
    names = {layout.name for layout in layouts}
    found = [task for task in tasks if task.layout.name in names]
    if tasks and not found:
        on = ", ".join(sorted({task.layout.name for task in tasks}))
        raise OptionError(
            f"expected tasks on {', '.join(sorted(names))}, found {len(tasks)} on {on}: leave out the manifest, or "
            f"choose other layouts"
        )
    return found


def mixed_chances(tasks: int) -> np.ndarray:
    """Return the probabilities of the teammates' behaviours according to `MIXTURE`, of shape (tasks, 4)."""
    shares = np.cumsum([share for share, _ in MIXTURE])
    kind = np.searchsorted(shares, (np.arange(tasks) + 0.5) / tasks * shares[-1])
    return np.array([chances for _, chances in MIXTURE], np.float32)[kind]


def with_behaviours(teammates: Sequence[Policy], chances: np.ndarray) -> list[Policy]:
    """Return teammates that show one of `BEHAVIOURS` in each episode.

    Args:
        teammates: scripted policies of one family, which share their functions.
        chances: probabilities of `BEHAVIOURS`, float32, of shape (len(teammates), 4).
    """
    init, act = _behaviour_functions(teammates[0].init, teammates[0].act)
    return [
        Policy(
            params={"script": mate.params, "chances": jnp.asarray(of_mate)},
            init=init,
            act=act,
            sees=mate.sees,
        )
        for mate, of_mate in zip(teammates, chances, strict=True)
    ]


@lru_cache(maxsize=64)
def _behaviour_functions(script_init: Callable[..., Any], script_act: Callable[..., Any]) -> tuple[Any, Any]:
    """Return the functions `init` and `act` of teammates with behaviours, made from the script's functions."""
    noise = jnp.array([0.0, 0.0, 1.0, NOISY_SHARE])  # probability of a random action in each behaviour

    def init(params: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        behaviour = jax.random.categorical(jax.random.fold_in(key, 1), jnp.log(params["chances"]))
        return behaviour, script_init(params["script"], key)

    def act(params: Any, memory: tuple[jax.Array, Any], view: jax.Array, key: jax.Array) -> tuple[jax.Array, Any]:
        behaviour, script = memory
        action, script = script_act(params["script"], script, view, key)
        action = randomize_action(jax.random.fold_in(key, 1), noise[behaviour], action)
        return jnp.where(behaviour == BEHAVIOURS.index("stay"), STAY, action).astype(jnp.int32), (behaviour, script)

    return init, act
