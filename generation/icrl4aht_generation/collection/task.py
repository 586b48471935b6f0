"""One task -> one finished artefact.

The learner's state is saved at intervals, always after the histories that it led to. A killed task resumes from there,
and since an update is a pure function of the state, the artefact has the bits of an uninterrupted run.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import DiskFullError
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.utils.files import NO_ROOM
from icrl4aht_generation.collection.task_folder import (
    LEARNER,
    ArtefactWriter,
    check_room,
    disk_full,
    finish_artefact,
    is_task_finished,
    needed_bytes,
    partial_folder,
    publish_artefact,
    resumable_settings,
)
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.resume import OtherSettingsError, SaveInterval, StateFile, run_lock
from icrl4aht_generation.policy import Noise
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.registry import build_teammate

TEAMMATE_NOISE: Noise = "seeded"
"""Heuristic teammates of training histories draw from each episode's own key."""

TASK_SAVE_SECONDS = 30.0
"""Interval of saves: the work that a kill can cost."""

UpdateCallback = Callable[[int, dict[str, float]], None]
"""Called after each update with its number and metrics."""


def make_learner(task: Task, profile: Profile, suite: Path | None = None) -> Learner:
    """The untrained ego of a task. `suite` is the folder of learned teammates."""
    teammate = build_teammate(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    return Learner(Environment(task.layout), teammate, profile.ego_on(task.layout.name))


def run_task(
    work: Work,
    profile: Profile,
    folder: Path,
    on_update: UpdateCallback = lambda update, metrics: None,
    *,
    suite: Path | None = None,
    wait: bool = False,
    save_seconds: float = TASK_SAVE_SECONDS,
) -> bool:
    """Train the ego of a task and record its histories into `folder`, resuming from the last saved update.

    Args:
        work: the task, and which of its learners.
        profile: the ego's hyper-parameters.
        folder: the artefact.
        on_update: called after each update.
        suite: folder of the learned teammates, if the task's is one.
        wait: whether to wait for another process that works on this task.
        save_seconds: least time between two saves of the learner's state.

    Returns:
        Whether there was anything to do; False if the artefact was finished before.

    Raises:
        BusyError: if another process works on this task.
        DiskFullError: if the disk has no room.
    """
    return make_artefact(
        folder,
        wait,
        lambda found: is_task_finished(found, work, profile),
        lambda partial: _learn(work, profile, partial, on_update, suite, save_seconds),
    )


def make_artefact(folder: Path, wait: bool, is_finished: Callable[[Path], bool], make: Callable[[Path], None]) -> bool:
    """Make an artefact in its partial folder and rename it, unless it is finished.

    Args:
        folder: the artefact.
        wait: whether to wait for another process that works on it.
        is_finished: whether a folder has the complete artefact.
        make: makes it in a folder, or resumes it there.

    Returns:
        Whether there was anything to do.

    Raises:
        BusyError: if another process works on it.
    """
    with run_lock(folder, wait=wait):
        if is_finished(folder):
            return False
        partial = partial_folder(folder)
        if not is_finished(partial):  # else it was killed just before it was renamed
            make(partial)
        publish_artefact(partial, folder)
        return True


def _learn(
    work: Work, profile: Profile, partial: Path, on_update: UpdateCallback, suite: Path | None, save_seconds: float
) -> None:
    task, saved = work.task, StateFile(partial / LEARNER, resumable_settings(work, profile))
    learner = make_learner(task, profile, suite)
    state, first = _resume(learner, work, saved)
    needed = needed_bytes(task, learner.config, state)
    with readable_disk_errors(partial, needed):
        if not first:
            check_room(partial, needed)
        writer = ArtefactWriter(partial, task, learner.config, first)
        try:
            _update(learner, state, first, writer, saved, on_update, save_seconds)
        finally:
            writer.close()
        finish_artefact(partial, work, profile)


def _update(
    learner: Learner,
    state: Any,
    first: int,
    writer: ArtefactWriter,
    saved: StateFile,
    on_update: UpdateCallback,
    save_seconds: float,
) -> None:
    """Apply the updates from number `first`, write what they give, and save the state at intervals."""
    update, updates = compiled_update(learner), learner.config.updates
    interval = SaveInterval(updates, seconds=save_seconds)
    pending: Any = None  # the last roll-out: it is written while the device computes the next one

    def write(number: int, rollout: Any, metrics: Any) -> None:
        on_update(number, writer.write(number, rollout, metrics))

    for number in range(first, updates):
        state, rollout, metrics = update(state)
        if pending is not None:
            write(*pending)
        pending = number, rollout, metrics
        writer.write_checkpoint(number + 1, learner.network, state.params)
        if interval.due(number + 1):
            write(*pending)
            pending = None
            writer.sync()
            began = time.perf_counter()
            saved.save(state, number + 1)
            writer.add_recording_time(time.perf_counter() - began)


@contextmanager
def readable_disk_errors(partial: Path, needed: int) -> Iterator[None]:
    """Turn the errors of a full disk into one that names the folder and what it needs.

    An artefact that has no saved state to resume from is removed then.

    Raises:
        DiskFullError: if the disk is full.
    """
    try:
        yield
    except OSError as error:
        if not isinstance(error, DiskFullError) and error.errno not in NO_ROOM:
            raise
        shown = disk_full(partial, needed)
        if not (partial / LEARNER).exists():
            shutil.rmtree(partial, ignore_errors=True)
        raise shown from error


def learner_key(work: Work) -> Any:
    """The typed key of a learner: the task's seed decides the first one's, the others' are independent of it."""
    key = jax.random.key(work.task.seed)
    return jax.random.fold_in(key, work.learner) if work.learner else key


def _resume(learner: Learner, work: Work, saved: StateFile) -> tuple[Any, int]:
    """The learner's state and the number of updates it has had: as saved under the same settings, or new."""
    init, key = jax.jit(learner.init), learner_key(work)
    try:
        updates = saved.progress
    except OtherSettingsError:  # a changed profile or version: an unfinished artefact is no loss
        updates = None
    if updates is not None:
        return saved.load(jax.eval_shape(init, key)), updates
    shutil.rmtree(saved.path.parent, ignore_errors=True)
    saved.path.parent.mkdir(parents=True)
    return init(key), 0
