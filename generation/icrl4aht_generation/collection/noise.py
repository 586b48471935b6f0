"""One task of the source `noise` -> one finished artefact, without a learner.

Episodes are independent, so a piece of the task is a pure function of its number. What a killed task has written up to
its last save stays, the rest is made again, and the artefact has the bits of an uninterrupted run.

The artefact has the arrays of `task_folder`, and

  metrics.jsonl       one line for each history: its mean returns at the start and at the end
  oracle_actions.npy  int8 (N, T), the oracle's action at every step, which the ego took unless it acted at random
  noise.npy           float32 (N, E), every episode's chance of a random action
"""

from __future__ import annotations

import json
import math
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
from icrl4aht_generation.collection.noise_rollout import (
    EPISODES_AT_ONCE,
    NoisyEpisodes,
    noise_schedules,
    play_noisy_episodes,
)
from icrl4aht_generation.collection.record import array_shapes
from icrl4aht_generation.collection.task import (
    TASK_SAVE_SECONDS,
    TEAMMATE_NOISE,
    UpdateCallback,
    make_artefact,
    pipelined,
    readable_disk_errors,
    saved_progress,
)
from icrl4aht_generation.collection.task_folder import (
    LEARNER,
    check_room,
    common_settings,
    is_artefact_finished,
    write_metadata,
)
from icrl4aht_generation.learners.resume import (
    METRICS,
    RunLog,
    SaveInterval,
    StateFile,
    software_versions,
)
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.registry import build_teammate

NOISE = "noise"
"""Name of the array of chances in an artefact."""

_LINE_BYTES = 200  # field of a history's number, in metrics and timing


def noise_array_shapes(layout: Layout, histories: int, episodes: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shapes and dtypes of an artefact's arrays: the fields of `NoisyEpisodes` by history, and `noise`."""
    return array_shapes(layout, histories, episodes) | {
        "oracle_actions": ((histories, episodes * KEPT_STEPS), "int8"),
        NOISE: ((histories, episodes), "float32"),
    }


def noise_bytes(layout: Layout, config: NoiseConfig) -> int:
    """Return the size of an artefact."""
    shapes = noise_array_shapes(layout, config.histories, config.episodes).values()
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes) + config.histories * _LINE_BYTES


def noise_settings(work: Work, profile: Profile) -> dict[str, Any]:
    """Return the settings that an artefact depends on; if any of them changes, it is made again."""
    return common_settings(work) | {"noise": json.loads(json.dumps(asdict(profile.noise)))}


def is_noise_finished(folder: Path, work: Work, profile: Profile) -> bool:
    """Return whether a folder has this task's artefact under these settings, with all its files unchanged."""
    return is_artefact_finished(folder, noise_settings(work, profile), _hashed_files(work, profile))


def _hashed_files(work: Work, profile: Profile) -> list[str]:
    shapes = noise_array_shapes(work.task.layout, profile.noise.histories, profile.noise.episodes)
    return sorted([METRICS, *(f"{name}.npy" for name in shapes)])


def run_noise(
    work: Work,
    profile: Profile,
    folder: Path,
    on_update: UpdateCallback = lambda update, metrics: None,
    *,
    suite: Path | None = None,
    wait: bool = False,
    save_seconds: float = TASK_SAVE_SECONDS,
) -> bool:
    """Record the noise histories of a task into `folder`, resuming from the last saved piece.

    Args:
        work: the task.
        profile: sizes and schedules.
        folder: the artefact.
        on_update: called with the number of the last complete history, when there is another one.
        suite: folder of the learned teammates, if the task's is one.
        wait: whether to wait for another process that works on this task.
        save_seconds: least time between two saves.

    Returns:
        False if the artefact was already finished, otherwise True.

    Raises:
        BusyError: if another process works on this task.
        DiskFullError: if the disk has no room.
    """
    return make_artefact(
        folder,
        wait,
        lambda found: is_noise_finished(found, work, profile),
        lambda partial: _record(work, profile, partial, on_update, suite, save_seconds),
    )


def _record(
    work: Work, profile: Profile, partial: Path, on_update: UpdateCallback, suite: Path | None, save_seconds: float
) -> None:
    task, config = work.task, profile.noise
    layout = None if task.teammate["kind"] == "heuristic" else task.layout
    teammate = build_teammate(layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    schedules = noise_schedules(config, task.seed)
    saved = StateFile(partial / LEARNER, noise_settings(work, profile) | software_versions())
    first, pieces = saved_progress(saved), -(-schedules.size // EPISODES_AT_ONCE)
    needed = noise_bytes(task.layout, config)

    def play(number: int) -> NoisyEpisodes:
        # The last piece repeats its last episode: equal sizes share one compilation.
        episodes = np.minimum(number * EPISODES_AT_ONCE + np.arange(EPISODES_AT_ONCE), schedules.size - 1)
        history, episode = np.divmod(episodes, config.episodes)
        played = play_noisy_episodes(task.layout, teammate, task.seed, history, episode, schedules[history, episode])
        writer.start_clock()  # the first piece is compiled and started
        return played

    def save(number: int) -> None:
        writer.sync()
        saved.save({"pieces": np.int32(number)}, number)

    with readable_disk_errors(partial, needed):
        if not first:
            check_room(partial, needed)
        writer = NoiseWriter(partial, task.layout, schedules, first * EPISODES_AT_ONCE)
        try:
            for number, played in pipelined(
                range(first, pieces), play, SaveInterval(pieces, seconds=save_seconds), save
            ):
                if (timing := writer.write(number * EPISODES_AT_ONCE, played)) is not None:
                    on_update(int(timing["update"]), timing)
        finally:
            writer.close()
        settings = noise_settings(work, profile) | {"profile": profile.name}
        write_metadata(partial, settings, _hashed_files(work, profile))


class NoiseWriter:
    """Fills the arrays of an artefact and its log, some episodes at a time.

    The arrays are memory maps of files whose space on the disk is allocated at the start.

    Args:
        partial: an existing folder.
        layout: the layout.
        schedules: float32 (N, E), see `noise_schedules`.
        first: the first episode to write, counted over all histories; 0 creates the files, otherwise the log is cut.

    Raises:
        OSError: if the disk is full.
    """

    def __init__(self, partial: Path, layout: Layout, schedules: np.ndarray, first: int) -> None:
        self._histories, self._episodes = schedules.shape
        self._complete = first // self._episodes
        self._started, self._recording, self._steps = math.nan, 0.0, 0
        shapes = noise_array_shapes(layout, *schedules.shape)
        if not first:
            for name, (shape, dtype) in shapes.items():
                new_mapped_array(partial / f"{name}.npy", shape, np.dtype(dtype))
        self._log = RunLog(partial, keep=lambda line: line["update"] < self._complete)
        self._arrays: dict[str, Any] = {
            name: np.lib.format.open_memmap(partial / f"{name}.npy", "r+") for name in shapes
        }
        self._arrays[NOISE][:] = schedules

    def start_clock(self) -> None:
        """Count time from now, if this is the first call."""
        if math.isnan(self._started):
            self._started = time.perf_counter()

    def write(self, first: int, played: NoisyEpisodes) -> dict[str, float] | None:
        """Write episodes from number `first` on, and ignore those after the task's last episode.

        Returns:
            The timing, with the number of the last complete history as `update`; None if no further one is complete.
        """
        jax.block_until_ready(played)
        began = time.perf_counter()
        last = min(first + len(played.state), self._histories * self._episodes)
        for name, values in played._asdict().items():
            kept = np.asarray(values)[: last - first]
            self._arrays[name].reshape(-1, *kept.shape[1:])[first:last] = kept
        self._steps += (last - first) * KEPT_STEPS
        self._recording += time.perf_counter() - began
        complete = range(self._complete, last // self._episodes)
        if not complete:
            return None
        self._complete = complete.stop
        seconds = time.perf_counter() - self._started
        timing = {
            "update": complete[-1],
            "steps_per_second": round(self._steps / seconds, 1),
            "seconds": round(seconds, 6),
            "recording": round(self._recording, 6),
        }
        self._log.write(*map(self._metrics, complete), timing=timing)
        return timing

    def _metrics(self, history: int) -> dict[str, float]:
        """Return the log line of a complete history: its mean returns at the start and at the end."""
        returns = self._arrays["rewards"][history].reshape(1, -1, KEPT_STEPS).sum(axis=-1, dtype=np.float64)
        start, end = (round(float(values.mean()), 3) for values in curve_ends(returns))
        return {"update": history, "return_start": start, "return_end": end}

    def sync(self) -> None:
        """Force everything written so far to the disk."""
        began = time.perf_counter()
        for array in self._arrays.values():
            array.flush()
        self._log.sync()
        self._recording += time.perf_counter() - began

    def close(self) -> None:
        """Close the log and unmap the arrays."""
        self._log.close()
        self._arrays.clear()
