"""Generate the artefact of a task with source `ppo`: train an ego and record its histories.

At intervals, the recorded histories are written to the disk, and then the learner's state is saved. A killed task
resumes from the last save. Every update is a pure function of the state, so the artefact is identical to that of an
uninterrupted run.
"""

from __future__ import annotations

import shutil
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import jax

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_generation.collection.task_folder import (
    LEARNER,
    ArtefactWriter,
    artefact_settings,
    finish_artefact,
    guard_disk_space,
    needed_bytes,
)
from icrl4aht_generation.env import Environment
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.resume import OtherSettingsError, SaveInterval, StateFile, software_versions
from icrl4aht_generation.policy import Noise
from icrl4aht_generation.profiles import Profile, WorkUnit
from icrl4aht_generation.teammates.registry import build_teammate

TEAMMATE_NOISE: Noise = "seeded"
"""Noise of heuristic teammates in training histories: a new key in every episode."""

TASK_SAVE_SECONDS = 30.0
"""Minimum number of seconds between two saves; a killed task resumes from the last save."""


def make_learner(task: Task, profile: Profile, suite: Path | None = None) -> Learner:
    """Return the untrained ego of a task. `suite` is the folder of learned teammates."""
    teammate = build_teammate(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    return Learner(Environment(task.layout), teammate, profile.ego_config(task.layout.name))


def train_and_record(
    work: WorkUnit, profile: Profile, partial: Path, on_update: OnUpdate, suite: Path | None, save_seconds: float
) -> None:
    """Train the ego of a task, and record its histories in a partial artefact."""
    task, saved = work.task, StateFile(partial / LEARNER, artefact_settings(work, profile) | software_versions())
    learner = make_learner(task, profile, suite)
    first, init, key = saved_progress(saved), jax.jit(learner.init), learner_key(work)
    state = saved.load(jax.eval_shape(init, key)) if first else init(key)
    needed, update = needed_bytes(task, learner.config, state), compiled_update(learner)

    with guard_disk_space(partial, needed):
        interval = SaveInterval(learner.config.updates, seconds=save_seconds)
        unwritten: Any = None  # the rollout to write while the device computes the next update
        with closing(ArtefactWriter(partial, task, learner.config, first)) as writer:
            for number in range(first, learner.config.updates):
                state, rollout, metrics = update(state)
                writer.write_checkpoint(number + 1, learner.network, state.params)
                if unwritten is not None:
                    on_update(number, writer.write(number - 1, *unwritten))
                unwritten = rollout, metrics
                if interval.due(number + 1):
                    on_update(number + 1, writer.write(number, *unwritten))
                    writer.sync()
                    with writer.recording():
                        saved.save(state, number + 1)
                    unwritten = None
        finish_artefact(partial, work, profile)


def saved_progress(saved: StateFile) -> int:
    """Return the number of finished updates in the saved state if its settings are the same.

    Otherwise, empty the folder and return 0.
    """
    with suppress(OtherSettingsError):  # another profile or version saved this state, so it cannot be resumed
        if done := saved.progress:
            return done
    shutil.rmtree(saved.path.parent, ignore_errors=True)
    saved.path.parent.mkdir(parents=True)
    return 0


def learner_key(work: WorkUnit) -> Any:
    """Return the typed JAX key of a learner; learners of a task have independent keys, derived from the task's seed."""
    key = jax.random.key(work.task.seed)
    return jax.random.fold_in(key, work.learner) if work.learner else key
