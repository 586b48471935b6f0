"""One task of the sources `noise` and `search` -> one finished artefact, without a learner.

A task takes seconds, so a killed one is made again from its start, with the same bits.

The artefact has the arrays of `task_folder`, and

  metrics.jsonl       one line for each history: its mean returns at the start and at the end
  script_actions.npy  int8 (N, T), the script's action at every step, which the ego took unless it acted at random
  noise.npy           float32 (N, E), every episode's chance of a random action
"""

from __future__ import annotations

import json
import math
import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.cached_arrays import new_mapped_array
from icrl4aht_data.format.schema import curve_ends
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.collection.curate import stream_returns
from icrl4aht_generation.collection.record import array_shapes
from icrl4aht_generation.collection.scripted_rollout import noise_schedules, play_scripted_histories, scripted_pieces
from icrl4aht_generation.collection.task import TEAMMATE_NOISE, UpdateCallback, make_artefact, readable_disk_errors
from icrl4aht_generation.collection.task_folder import (
    check_room,
    common_settings,
    is_artefact_finished,
    write_metadata,
)
from icrl4aht_generation.learners.resume import METRICS, RunLog
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.registry import build_teammate

NOISE, SCRIPT = "noise", "script_actions"
"""Names of the arrays of chances, and of actions without noise, in an artefact."""

_LINE_BYTES = 100  # line of a history in metrics, and of a piece in timing


def _array_shapes(layout: Layout, config: NoiseConfig) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shapes and dtypes of an artefact's arrays: fields of `ScriptedEpisodes` by history, and chances."""
    histories, episodes = config.histories, config.episodes
    return array_shapes(layout, histories, episodes) | {
        SCRIPT: ((histories, episodes * KEPT_STEPS), "int8"),
        NOISE: ((histories, episodes), "float32"),
    }


def scripted_bytes(layout: Layout, config: NoiseConfig) -> int:
    """Return the size of an artefact."""
    shapes = _array_shapes(layout, config).values()
    arrays = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes)
    return arrays + (config.histories + config.episodes) * _LINE_BYTES


def _settings(work: Work, profile: Profile) -> dict[str, Any]:
    """Return the settings that an artefact depends on; if any of them changes, it is made again."""
    config = profile.scripted[work.source]
    return common_settings(work) | {"noise": json.loads(json.dumps(asdict(config)))}


def is_scripted_finished(folder: Path, work: Work, profile: Profile) -> bool:
    """Return whether a folder has this task's artefact under these settings, with all its files unchanged."""
    return is_artefact_finished(folder, _settings(work, profile), _hashed_files(work, profile))


def _hashed_files(work: Work, profile: Profile) -> list[str]:
    shapes = _array_shapes(work.task.layout, profile.scripted[work.source])
    return sorted([METRICS, *(f"{name}.npy" for name in shapes)])


def run_scripted(
    work: Work,
    profile: Profile,
    folder: Path,
    on_update: UpdateCallback = lambda update, metrics: None,
    *,
    suite: Path | None = None,
    wait: bool = False,
) -> bool:
    """Record the histories of a task into `folder`.

    Args:
        work: the task, and the source of its histories.
        profile: sizes and schedules.
        folder: the artefact.
        on_update: called after each piece with its number.
        suite: folder of the learned teammates, if the task's is one.
        wait: whether to wait for another process that works on this task.

    Returns:
        False if the artefact was already finished, otherwise True.

    Raises:
        BusyError: if another process works on this task.
        DiskFullError: if the disk has no room.
    """
    return make_artefact(
        folder,
        wait,
        lambda found: is_scripted_finished(found, work, profile),
        lambda partial: _record(work, profile, partial, on_update, suite),
    )


def _record(work: Work, profile: Profile, partial: Path, on_update: UpdateCallback, suite: Path | None) -> None:
    task, config = work.task, profile.scripted[work.source]
    layout = None if task.teammate["kind"] == "heuristic" else task.layout
    teammate = build_teammate(layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    schedules = noise_schedules(config, task.seed)
    needed = scripted_bytes(task.layout, config)
    shutil.rmtree(partial, ignore_errors=True)  # left by a killed run
    partial.mkdir(parents=True)
    with readable_disk_errors(partial, needed):
        check_room(partial, needed)
        arrays = {
            name: new_mapped_array(partial / f"{name}.npy", shape, np.dtype(dtype))
            for name, (shape, dtype) in _array_shapes(task.layout, config).items()
        }
        arrays[NOISE][:] = schedules
        log, recording, started = RunLog(partial, keep=lambda line: False), 0.0, math.nan
        try:
            pieces = scripted_pieces(work.source, config)
            played = play_scripted_histories(task.layout, teammate, task.seed, work.source, pieces, schedules)
            for number, (history, episode, episodes) in enumerate(played):
                jax.block_until_ready(episodes)
                began = time.perf_counter()
                started = began if math.isnan(started) else started  # the first piece has been compiled
                for name, values in episodes._asdict().items():
                    array = arrays[name].reshape(*schedules.shape, *values.shape[1:])
                    array[history, episode] = values
                recording += time.perf_counter() - began
                timing = _timing(number, len(pieces), schedules.size, time.perf_counter() - started, recording)
                log.write(timing=timing)
                on_update(number, timing)
            returns = stream_returns(arrays["rewards"])
            for history, (start, end) in enumerate(zip(*curve_ends(returns), strict=True)):
                line = {"update": history, "return_start": round(float(start), 3), "return_end": round(float(end), 3)}
                log.write(line)
            for array in arrays.values():
                array.flush()
            log.sync()
        finally:
            log.close()
            arrays.clear()
        files = _hashed_files(work, profile)
        write_metadata(partial, _settings(work, profile) | {"profile": profile.name}, files)


def _timing(number: int, pieces: int, episodes: int, seconds: float, recording: float) -> dict[str, float]:
    """Return the line of a piece, with the steps per second since the first one was played."""
    steps = number * episodes * KEPT_STEPS / pieces
    return {
        "update": number,
        "steps_per_second": round(steps / seconds, 1) if steps else 0.0,
        "seconds": round(seconds, 6),
        "recording": round(recording, 6),
    }
