"""One task of the source `noise` -> the files of its artefact, without a learner.

Episodes are independent, so a piece of the task is a pure function of its number. What a killed task has written up to
its last save stays, the rest is made again, and the artefact has the bits of an uninterrupted run.

The artefact has the arrays of `task_folder`, and

  metrics.jsonl       one line for each history: its mean returns at the start and at the end
  oracle_actions.npy  int8 (N, T), the oracle's action at every step, which the ego took unless it acted at random
  noise.npy           float32 (N, E), every episode's chance of a random action
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import jax
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.schema import curve_ends
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.collection.noise_rollout import (
    EPISODES_AT_ONCE,
    NoisyEpisodes,
    noise_schedules,
    play_noisy_episodes,
)
from icrl4aht_generation.collection.record import NOISE_ARRAYS, array_shapes
from icrl4aht_generation.collection.task import (
    TEAMMATE_NOISE,
    UpdateCallback,
    pipelined,
    readable_disk_errors,
    saved_progress,
)
from icrl4aht_generation.collection.task_folder import (
    LEARNER,
    ArrayWriter,
    artefact_settings,
    check_room,
    finish_artefact,
)
from icrl4aht_generation.learners.resume import (
    SaveInterval,
    StateFile,
    software_versions,
)
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.registry import build_teammate

_LINE_BYTES = 200  # field of a history's number, in metrics and timing


def noise_array_shapes(layout: Layout, histories: int, episodes: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shapes and dtypes of an artefact's arrays: the fields of `NoisyEpisodes` by history, and `noise`."""
    labels, chances = NOISE_ARRAYS
    return array_shapes(layout, histories, episodes) | {
        labels: ((histories, episodes * KEPT_STEPS), "int8"),
        chances: ((histories, episodes), "float32"),
    }


def noise_bytes(layout: Layout, config: NoiseConfig) -> int:
    """Return the size of an artefact."""
    shapes = noise_array_shapes(layout, config.histories, config.episodes).values()
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes) + config.histories * _LINE_BYTES


def play_histories(
    work: Work, profile: Profile, partial: Path, on_update: UpdateCallback, suite: Path | None, save_seconds: float
) -> None:
    """Play the noise histories of a task into a partial artefact, see `collection.job.run_task`.

    `on_update` gets the number of the last complete history, when there is another one.
    """
    task, config = work.task, profile.noise
    layout = None if task.teammate["kind"] == "heuristic" else task.layout
    teammate = build_teammate(layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    schedules = noise_schedules(config, task.seed)
    saved = StateFile(partial / LEARNER, artefact_settings(work, profile) | software_versions())
    first, pieces = saved_progress(saved), -(-schedules.size // EPISODES_AT_ONCE)
    needed = noise_bytes(task.layout, config)

    def play(number: int) -> NoisyEpisodes:
        # The last piece repeats its last episode: equal sizes share one compilation.
        episodes = np.minimum(number * EPISODES_AT_ONCE + np.arange(EPISODES_AT_ONCE), schedules.size - 1)
        history, episode = np.divmod(episodes, config.episodes)
        return play_noisy_episodes(task.layout, teammate, task.seed, history, episode, schedules[history, episode])

    def save(number: int) -> None:
        writer.sync(lambda: saved.save({"pieces": np.int32(number)}, number))

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
        finish_artefact(partial, work, profile)


class NoiseWriter(ArrayWriter):
    """Fills the arrays of an artefact and its log, some episodes at a time.

    Args:
        partial: an existing folder.
        layout: the layout.
        schedules: float32 (N, E), see `noise_schedules`.
        first: the first episode to write, counted over all histories; 0 creates the files, otherwise the log is cut.

    Raises:
        OSError: if the disk is full.
    """

    def __init__(self, partial: Path, layout: Layout, schedules: np.ndarray, first: int) -> None:
        self._shape, self._complete = schedules.shape, first // schedules.shape[1]
        super().__init__(partial, noise_array_shapes(layout, *schedules.shape), not first, self._complete)
        self._arrays["noise"][:] = schedules

    def write(self, first: int, played: NoisyEpisodes) -> dict[str, float] | None:
        """Write episodes from number `first` on, and ignore those after the task's last episode.

        Returns:
            The timing, with the number of the last complete history as `update`; None if no further one is complete.
        """
        jax.block_until_ready(played)
        began, (histories, episodes) = time.perf_counter(), self._shape
        last = min(first + len(played.state), histories * episodes)
        for name, values in played._asdict().items():
            kept = np.asarray(values)[: last - first]
            self._arrays[name].reshape(-1, *kept.shape[1:])[first:last] = kept
        timing, complete = self._timing((last - first) * KEPT_STEPS, began), range(self._complete, last // episodes)
        if not complete:
            return None
        self._complete = complete.stop
        line = {"update": complete[-1]} | timing
        self._log.write(*map(self._metrics, complete), timing=line)
        return line

    def _metrics(self, history: int) -> dict[str, float]:
        """Return the log line of a complete history: its mean returns at the start and at the end."""
        returns = self._arrays["rewards"][history].reshape(1, -1, KEPT_STEPS).sum(axis=-1, dtype=np.float64)
        start, end = (round(float(values.mean()), 3) for values in curve_ends(returns))
        return {"update": history, "return_start": start, "return_end": end}
