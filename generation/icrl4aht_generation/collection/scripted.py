"""Generate the artefact of a task of source `noise` or `search`, in which a script plays the ego instead of a learner.

A task takes seconds, so a killed task restarts from the beginning; the result is identical.

Besides the arrays that `task_folder` describes, the artefact contains:

  metrics.jsonl       one line for each history: its mean returns at the start and at the end
  script_actions.npy  int8 (N, T), the script's action at every step, which the ego took unless it acted at random
  noise.npy           float32 (N, E), the chance of a random action in every episode
"""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import jax

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.schema import curve_ends
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.collection.curate import stream_returns
from icrl4aht_generation.collection.scripted_rollout import (
    noise_schedules,
    play_scripted_histories,
    scripted_batches,
)
from icrl4aht_generation.collection.task import TEAMMATE_NOISE
from icrl4aht_generation.collection.task_folder import (
    SCRIPT_ARRAYS,
    ArrayWriter,
    array_shapes,
    arrays_bytes,
    finish_artefact,
    guard_disk_space,
)
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.profiles import Profile, WorkUnit
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.teammates.registry import build_teammate

_LINE_BYTES = 100  # maximum size of a line in the files of metrics or timing


def _array_shapes(layout: Layout, config: NoiseConfig) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return name -> shape and dtype of each array in an artefact of a scripted source."""
    actions, chances = SCRIPT_ARRAYS
    return array_shapes(layout, config.histories, config.episodes) | {
        actions: ((config.histories, config.episodes * KEPT_STEPS), "int8"),
        chances: ((config.histories, config.episodes), "float32"),
    }


def scripted_bytes(layout: Layout, config: NoiseConfig) -> int:
    """Return the maximum size in bytes of an artefact of a scripted source."""
    return arrays_bytes(_array_shapes(layout, config)) + (config.histories + config.episodes) * _LINE_BYTES


def play_histories(
    work: WorkUnit, profile: Profile, partial: Path, on_update: OnUpdate, suite: Path | None, save_seconds: float
) -> None:
    """Play the histories of a task with a script, and write them to a partial artefact."""
    task, config = work.task, profile.scripted_config(work.task.layout.name, work.source)
    layout = None if task.teammate["kind"] == "heuristic" else task.layout
    teammate = build_teammate(layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    schedules, batches = noise_schedules(config, task.seed), scripted_batches(work.source, config)
    needed = scripted_bytes(task.layout, config)
    shutil.rmtree(partial, ignore_errors=True)  # left by a killed run
    partial.mkdir(parents=True)
    with guard_disk_space(partial, needed):
        with closing(ArrayWriter(partial, _array_shapes(task.layout, config))) as writer:
            writer.arrays["noise"][:] = schedules
            played = play_scripted_histories(task.layout, teammate, task.seed, work.source, batches, schedules)
            for number, (batch, episodes) in enumerate(played):
                jax.block_until_ready(episodes)
                with writer.recording():
                    for name, values in episodes.items():
                        writer.arrays[name].reshape(*schedules.shape, *values.shape[1:])[batch] = values
                timing = writer.timing(len(batch[0]) * KEPT_STEPS)
                writer.log.write(timing={"update": number} | timing)
                on_update(number + 1, timing["steps_per_second"])
            ends = zip(*curve_ends(stream_returns(writer.arrays["rewards"])), strict=True)
            for history, (start, end) in enumerate(ends):
                line = {"return_start": round(float(start), 3), "return_end": round(float(end), 3)}
                writer.log.write({"update": history} | line)
            writer.sync()
        finish_artefact(partial, work, profile)
