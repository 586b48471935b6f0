"""One task of the source `ppo` -> the files of its artefact.

The learner's state is saved at intervals, always after the histories that it led to. A killed task resumes from there,
and since an update is a pure function of the state, the artefact has the bits of an uninterrupted run.
"""

from __future__ import annotations

import shutil
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
    artefact_settings,
    check_room,
    disk_full,
    finish_artefact,
    needed_bytes,
)
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.resume import OtherSettingsError, SaveInterval, StateFile, software_versions
from icrl4aht_generation.policy import Noise
from icrl4aht_generation.profiles import Profile, Work
from icrl4aht_generation.teammates.registry import build_teammate

TEAMMATE_NOISE: Noise = "seeded"
"""Heuristic teammates of training histories draw from each episode's own key."""

TASK_SAVE_SECONDS = 30.0
"""Interval of saves: the work that a kill can cost."""

UpdateCallback = Callable[[int, dict[str, float]], None]
"""Called after each update with its number and metrics."""


def make_learner(task: Task, profile: Profile, suite: Path | None = None) -> Learner:
    """Return the untrained ego of a task. `suite` is the folder of learned teammates."""
    teammate = build_teammate(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    return Learner(Environment(task.layout), teammate, profile.ego_on(task.layout.name))


def learn_histories(
    work: Work, profile: Profile, partial: Path, on_update: UpdateCallback, suite: Path | None, save_seconds: float
) -> None:
    """Train the ego of a task and record its histories into a partial artefact, see `collection.job.run_task`."""
    task, saved = work.task, StateFile(partial / LEARNER, artefact_settings(work, profile) | software_versions())
    learner = make_learner(task, profile, suite)
    first, init, key = saved_progress(saved), jax.jit(learner.init), learner_key(work)
    state = saved.load(jax.eval_shape(init, key)) if first else init(key)
    needed, update = needed_bytes(task, learner.config, state), compiled_update(learner)

    def play(number: int) -> Any:
        nonlocal state
        state, rollout, metrics = update(state)
        writer.write_checkpoint(number + 1, learner.network, state.params)
        return rollout, metrics

    def save(updates: int) -> None:
        writer.sync(lambda: saved.save(state, updates))

    with readable_disk_errors(partial, needed):
        if not first:
            check_room(partial, needed)
        writer = ArtefactWriter(partial, task, learner.config, first)
        try:
            interval = SaveInterval(learner.config.updates, seconds=save_seconds)
            for number, played in pipelined(range(first, learner.config.updates), play, interval, save):
                on_update(number, writer.write(number, *played))
        finally:
            writer.close()
        finish_artefact(partial, work, profile)


def pipelined(
    numbers: range, play: Callable[[int], Any], interval: SaveInterval, save: Callable[[int], None]
) -> Iterator[tuple[int, Any]]:
    """Yield each number and what was played, to be written while the device plays the next one.

    Args:
        numbers: numbers of the pieces.
        play: starts a piece on the device.
        interval: when to save.
        save: called with the number of the pieces so far, when all of them were written.
    """
    pending: Any = None
    for number in numbers:
        played = play(number)
        if pending is not None:
            yield pending
        pending = number, played
        if interval.due(number + 1):
            yield pending
            pending = None
            save(number + 1)


def saved_progress(saved: StateFile) -> int:
    """Return the number of pieces saved under the same settings; if there are none, empty the folder and return 0."""
    try:
        done = saved.progress
    except OtherSettingsError:  # made by another profile or version, so it cannot be resumed
        done = None
    if done is None:
        shutil.rmtree(saved.path.parent, ignore_errors=True)
        saved.path.parent.mkdir(parents=True)
    return done or 0


@contextmanager
def readable_disk_errors(partial: Path, needed: int) -> Iterator[None]:
    """Turn errors of a full disk into a `DiskFullError` that names the folder and the needed space.

    An artefact without a saved state to resume from is removed.

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
    """Return the typed key of a learner: the task's seed decides the first one's, the others' are independent of it."""
    key = jax.random.key(work.task.seed)
    return jax.random.fold_in(key, work.learner) if work.learner else key
