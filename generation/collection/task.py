"""One task -> one finished artefact, whatever happens on the way.

The learner's state is saved every so often, after the histories it has led to; a killed task goes on from there, and
since an update is a pure function of that state, the artefact is bit for bit that of an uninterrupted run.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from generation.collection.task_folder import (
    LEARNER,
    Writer,
    finish,
    is_finished,
    partial_folder,
    publish,
    resumable_settings,
)
from generation.env import Environment
from generation.learners.checkpoint import write_policy
from generation.learners.ego import Learner, compiled_update
from generation.learners.resume import OtherSettingsError, SaveInterval, StateFile, run_lock
from generation.policy import Noise
from generation.profiles import Profile
from generation.teammates.registry import build
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.overcooked.actions import TEAMMATE

TEAMMATE_NOISE: Noise = "seeded"
"""Heuristic teammates of training histories draw from each episode's own key."""

SAVE_SECONDS = 30.0
"""Between two saves: what a kill can cost."""

Report = Callable[[int, dict[str, float]], None]
"""Called after each update with its number and metrics."""


def make_learner(task: Task, profile: Profile, suite: Path | None = None) -> Learner:
    """The ego of a task, untrained. `suite` is the folder of learned teammates."""
    mate = build(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    return Learner(Environment(task.layout), mate, profile.ego)


def run_task(
    task: Task,
    profile: Profile,
    folder: Path,
    report: Report = lambda update, metrics: None,
    *,
    suite: Path | None = None,
    wait: bool = False,
    save_seconds: float = SAVE_SECONDS,
) -> bool:
    """Train the ego of a task and record its histories into `folder`, from the last saved update if there is one.

    Args:
        suite: the folder of learned teammates, where the task's is one.
        wait: for another process that is at this task, rather than leaving it to that.
        save_seconds: least time between two saves of the learner's state.

    Returns:
        Whether there was anything to do; False if the artefact was finished before.

    Raises:
        BusyError: if another process is at this task.
    """
    with run_lock(folder, wait=wait):
        if is_finished(folder, task, profile):
            return False
        _run(task, profile, folder, report, suite, save_seconds)
        return True


def _run(task: Task, profile: Profile, folder: Path, report: Report, suite: Path | None, save_seconds: float) -> None:
    partial = partial_folder(folder)
    if not is_finished(partial, task, profile):  # else it was killed just before it got its name
        _learn(task, profile, partial, report, suite, save_seconds)
        finish(partial, task, profile)
    publish(partial, folder)


def _learn(
    task: Task, profile: Profile, partial: Path, report: Report, suite: Path | None, save_seconds: float
) -> None:
    learner, saved = make_learner(task, profile, suite), StateFile(partial / LEARNER, resumable_settings(task, profile))
    state, first = _state(learner, task, saved)
    update = compiled_update(learner)
    writer = Writer(partial, task, profile.ego, first)
    waiting: Any = None  # the last roll-out is written while the next one runs
    interval = SaveInterval(profile.ego.updates, seconds=save_seconds)

    def write(number: int, rollout: Any, metrics: Any) -> None:
        report(number, writer.write(number, rollout, metrics))

    try:
        for number in range(first, profile.ego.updates):
            state, rollout, metrics = update(state)
            if waiting is not None:
                write(*waiting)
            waiting = number, rollout, metrics
            if interval.due(number + 1):
                write(*waiting)
                waiting = None
                writer.sync()
                began = time.perf_counter()
                saved.save(state, number + 1)
                writer.count(time.perf_counter() - began)
    finally:
        writer.close()
    steps = profile.ego.updates * profile.ego.steps_per_update
    write_policy(partial, learner.network, state.params, {"task_id": task.task_id, "steps": steps})


def _state(learner: Learner, task: Task, saved: StateFile) -> tuple[Any, int]:
    """The learner's state and the number of updates it has had: as saved under the same settings, or new."""
    init, key = jax.jit(learner.init), jax.random.key(task.seed)
    try:
        updates = saved.progress
    except OtherSettingsError:  # nothing is published under these: start again
        updates = None
    if updates is not None:
        return saved.load(jax.eval_shape(init, key)), updates
    shutil.rmtree(saved.path.parent, ignore_errors=True)
    saved.path.parent.mkdir(parents=True)
    return init(key), 0
