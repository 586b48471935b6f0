"""Files of a task's artefact on disk, and functions that write and validate them.

<task_id>/            finished artefact: all hashes match; the name of a second learner's artefact ends in -l1
  metadata.json       task, settings, versions, SHA-256 of the files below
  state.npy actions.npy teammate_actions.npy rewards.npy episode_end_state.npy
  metrics.jsonl       one line per update, or per history of a script
  checkpoints/c<k>/   policy.safetensors policy.json, the ego after evenly spaced updates; the last is the final ego
  timing.jsonl        seconds and steps per second, not hashed
  labeller_returns.json   added by packing, not hashed
<task_id>.partial/    the same files while the task runs, and the last saved state, `learner.safetensors`
.<task_id>.lock       lock of the process that generates the artefact
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, SCRIPTED_SOURCES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import DiskFullError, IndexFormatError
from icrl4aht_data.format.cached_arrays import new_mapped_array
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.utils.files import NO_ROOM, file_hash, hashes_match, json_hash, read_json, write_json
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, checkpoint_updates, save_policy
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.resume import METRICS, TIMING, RunLog, last_line, xla_threads
from icrl4aht_generation.learners.rollout import Rollout
from icrl4aht_generation.profiles import Profile, WorkUnit

METADATA, LEARNER = "metadata.json", "learner.safetensors"
LABELLER_RETURNS = "labeller_returns.json"
"""File with the mean returns of the ego's checkpoints, which packing adds to choose the labeller."""

_LINE_BYTES = 600  # maximum size of an update's lines in the files of metrics and timing


HISTORY_ARRAYS = ("state", "actions", "teammate_actions", "rewards", "episode_end_state")
"""Arrays of N histories with E episodes and T = 100 E steps, in every artefact:

    state               uint8 (N, T, S), state records before each step
    actions             int8 (N, T), the ego's actions
    teammate_actions    int8 (N, T), the teammate's actions
    rewards             int8 (N, T), the team's rewards without shaping
    episode_end_state   uint8 (N, E, S), state records after the last stored step of each episode
"""

SCRIPT_ARRAYS = ("script_actions", "noise")
"""Further arrays in artefacts of scripted sources, see `collection.scripted`."""


def array_shapes(layout: Layout, histories: int, episodes: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and dtype of each of `HISTORY_ARRAYS`."""
    n, size = histories, record_size(layout)
    steps = (n, episodes * KEPT_STEPS)
    return {
        "state": ((*steps, size), "uint8"),
        "actions": (steps, "int8"),
        "teammate_actions": (steps, "int8"),
        "rewards": (steps, "int8"),
        "episode_end_state": ((n, episodes, size), "uint8"),
    }


def arrays_bytes(shapes: Mapping[str, tuple[tuple[int, ...], str]]) -> int:
    """Return the uncompressed size in bytes of arrays, given their shapes and dtypes by name."""
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def record_rollout(histories: Mapping[str, np.ndarray], update: int, rollout: Rollout) -> None:
    """Copy the first 100 steps of each episode in a rollout, and the state after them, into the histories' arrays.

    All environments start episodes in the same steps, so a step's number determines its episode and its step in the
    episode. Writing a rollout twice changes nothing, so a resumed task may write it again.
    """
    length = rollout.record.shape[0]
    step = np.arange(update * length, (update + 1) * length)
    episode, clock = step // EPISODE_STEPS, step % EPISODE_STEPS
    complete = episode < histories["episode_end_state"].shape[1]
    kept = complete & (clock < KEPT_STEPS)
    after = complete & (clock == KEPT_STEPS)
    record = np.asarray(rollout.record).swapaxes(0, 1)
    actions = np.asarray(rollout.actions).swapaxes(0, 1)
    to = episode[kept] * KEPT_STEPS + clock[kept]
    histories["state"][:, to] = record[:, kept]
    histories["actions"][:, to] = actions[:, kept, EGO]
    histories["teammate_actions"][:, to] = actions[:, kept, TEAMMATE]
    histories["rewards"][:, to] = np.asarray(rollout.reward).swapaxes(0, 1)[:, kept]
    histories["episode_end_state"][:, episode[after]] = record[:, after]


def partial_folder(folder: Path) -> Path:
    """Return the folder of an unfinished artefact, given the folder of the finished artefact."""
    return folder.with_name(f"{folder.name}.partial")


def checkpoint_path(folder: Path, number: int) -> Path:
    """Return the folder of one of the ego's checkpoints in an artefact.

    Args:
        folder: the artefact's folder.
        number: number of the checkpoint, from 0.
    """
    return folder / "checkpoints" / f"c{number}"


def artefact_settings(work: WorkUnit, profile: Profile) -> dict[str, Any]:
    """Return all settings that an artefact depends on, as JSON values; any change makes the artefact outdated."""
    settings: dict[str, Any] = {
        "task": asdict(work.task),
        "source": work.source,
        "learner": work.learner,
        "code_version": version("icrl4aht-data"),
    }
    layout = work.task.layout.name
    if work.source in SCRIPTED_SOURCES:
        settings["noise"] = asdict(profile.scripted_config(layout, work.source))
    else:
        ego = profile.ego_config(layout)
        settings |= {"ego_hash": json_hash(asdict(ego)), "checkpoint_updates": checkpoint_updates(ego)}
    return json.loads(json.dumps(settings))  # turns tuples into lists, as in the stored file


def hashed_files(work: WorkUnit, profile: Profile) -> list[str]:
    """Return the names of the files that an artefact's metadata lists with their hashes, sorted."""
    files = {METRICS, *(f"{name}.npy" for name in HISTORY_ARRAYS)}
    if work.source in SCRIPTED_SOURCES:
        return sorted(files | {f"{name}.npy" for name in SCRIPT_ARRAYS})
    count = len(checkpoint_updates(profile.ego_config(work.task.layout.name)))
    checkpoints = [checkpoint_path(Path(), number) for number in range(count)]
    return sorted(files | {(path / name).as_posix() for path in checkpoints for name in (POLICY_WEIGHTS, POLICY_CARD)})


def is_task_finished(folder: Path, work: WorkUnit, profile: Profile) -> bool:
    """Return whether a folder contains the complete artefact of a unit of work, with the profile's settings."""
    settings = artefact_settings(work, profile)
    try:
        metadata = read_json(folder / METADATA)
        same = {name: metadata[name] for name in settings} == settings
        listed = sorted(metadata["files"]) == hashed_files(work, profile)
        return same and listed and hashes_match(folder, metadata["files"])
    except (IndexFormatError, OSError, KeyError, TypeError):
        return False


def needed_bytes(task: Task, config: PPOConfig, state: Any) -> int:
    """Return the bytes of disk space that an unfinished artefact needs, with two copies of the learner's state.

    Args:
        task: task of the artefact.
        config: the ego's hyper-parameters.
        state: the learner's state.
    """
    histories = arrays_bytes(array_shapes(task.layout, config.environments, config.episodes))
    saved, params = (sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) for tree in (state, state.params))
    return histories + 2 * saved + len(checkpoint_updates(config)) * params + config.updates * _LINE_BYTES


@contextmanager
def guard_disk_space(partial: Path, needed: int) -> Iterator[None]:
    """Check that the disk has space for an artefact, and convert errors of a full disk to `DiskFullError`.

    If the disk is full, an artefact without a saved state to resume from is removed.

    Args:
        partial: folder of the unfinished artefact.
        needed: disk space of the artefact in bytes.

    Raises:
        DiskFullError: if the disk is full; the message names the folder and the needed space.
    """
    try:
        if not (partial / LEARNER).exists() and needed > shutil.disk_usage(partial).free:
            raise OSError(NO_ROOM[0], os.strerror(NO_ROOM[0]))
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        free = shutil.disk_usage(partial).free
        if not (partial / LEARNER).exists():
            shutil.rmtree(partial, ignore_errors=True)
        raise DiskFullError(
            f"{partial.with_name(partial.name.removesuffix('.partial'))}: the disk is full: this task needs "
            f"{needed:,} bytes, but only {free:,} are free; free some space, or give another --out"
        ) from error


def finish_artefact(partial: Path, work: WorkUnit, profile: Profile) -> None:
    """Write the metadata file of an artefact, which completes its partial folder."""
    settings = artefact_settings(work, profile) | {"profile": profile.name}
    if work.source == "ppo":
        settings |= {"ego": asdict(profile.ego_config(work.task.layout.name))}
    metadata = settings | {
        "jax_version": jax.__version__,
        "platform": jax.default_backend(),
        "xla_threads": xla_threads(),
        "files": {name: file_hash(partial / name) for name in hashed_files(work, profile)},
    }
    write_json(partial / METADATA, metadata)


def publish_artefact(partial: Path, folder: Path) -> None:
    """Rename a complete artefact from its partial folder to its final folder."""
    (partial / LEARNER).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


class ArrayWriter:
    """Writer of the arrays and the log of a partial artefact.

    The arrays are memory maps of files with disk space allocated at the start. `sync` flushes the arrays and maps them
    again, so memory only holds data written after the last `sync`.

    Args:
        partial: an existing folder.
        shapes: shape and dtype of each array by name.
        kept: number of updates to keep: 0 creates the files, a larger number removes later lines of the log.

    Attributes:
        arrays: memory map of each array by name.
        log: log of metrics and timing.

    Raises:
        OSError: if the disk is full.
    """

    def __init__(self, partial: Path, shapes: Mapping[str, tuple[tuple[int, ...], str]], kept: int = 0) -> None:
        self._partial, self._names = partial, tuple(shapes)
        self._started, self._steps, self._recording, self._has_written = time.perf_counter(), 0, 0.0, False
        if not kept:
            for name, (shape, dtype) in shapes.items():
                new_mapped_array(partial / f"{name}.npy", shape, np.dtype(dtype))
        self.log = RunLog(partial, keep=lambda line: line["update"] < kept)
        self.arrays = self._map_arrays()

    def _map_arrays(self) -> dict[str, Any]:
        return {name: np.lib.format.open_memmap(self._partial / f"{name}.npy", "r+") for name in self._names}

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Add the duration of the `with` block to the seconds spent on recording."""
        began = time.perf_counter()
        yield
        self._recording += time.perf_counter() - began

    def timing(self, steps: int) -> dict[str, float]:
        """Count `steps` more steps, and return steps per second, total seconds and seconds spent on recording.

        Measurement starts after the first batch, because that batch includes compilation.
        """
        now = time.perf_counter()
        self._steps, seconds = self._steps + steps, now - self._started
        timing = {
            "steps_per_second": round(self._steps / seconds, 1),
            "seconds": round(seconds, 6),
            "recording": round(self._recording, 6),
        }
        if not self._has_written:
            self._started, self._steps, self._recording, self._has_written = now, 0, 0.0, True
        return timing

    def sync(self) -> None:
        """Flush everything written so far to the disk, and release its memory."""
        with self.recording():
            for array in self.arrays.values():
                array.flush()
            self.arrays = self._map_arrays()
            self.log.sync()

    def close(self) -> None:
        """Close the log and unmap the arrays."""
        self.log.close()
        self.arrays.clear()


class ArtefactWriter(ArrayWriter):
    """Writer of an artefact's histories, metrics and timing after each update of the ego.

    Args:
        partial: an existing folder.
        task: task of the artefact.
        config: the ego's hyper-parameters.
        first: the first update to write; 0 creates the files, a larger number removes later lines of the log.

    Raises:
        OSError: if the disk is full.
    """

    def __init__(self, partial: Path, task: Task, config: PPOConfig, first: int) -> None:
        super().__init__(partial, array_shapes(task.layout, config.environments, config.episodes), first)
        self._task, self._config = task, config

    def write(self, number: int, rollout: Any, metrics: dict[str, Any]) -> float:
        """Record one update, and return the average steps per second so far."""
        jax.block_until_ready((rollout, metrics))
        with self.recording():
            record_rollout(self.arrays, number, rollout)
        line = {"update": number, "step": (number + 1) * self._config.steps_per_update}
        line |= {name: float(value) for name, value in metrics.items()}
        if not line.get("episodes", 1):
            line.pop("return", None)  # no episode ended, so there is no mean return
        timing = self.timing(self._config.steps_per_update)
        self.log.write(line, timing={"update": number} | timing)
        return timing["steps_per_second"]

    def write_checkpoint(self, updates: int, network: ActorCritic, params: Any) -> None:
        """Write and sync a checkpoint of the ego if this number of updates is among `checkpoint_updates`.

        Call this function before saving the learner's state, so that a resumed task has all checkpoints.
        """
        moments = checkpoint_updates(self._config)
        if updates in moments:
            card = {"task_id": self._task.task_id, "steps": updates * self._config.steps_per_update}
            with self.recording():
                save_policy(checkpoint_path(self._partial, moments.index(updates)), network, params, card)


def last_timing(folder: Path) -> dict[str, Any] | None:
    """Return the last timing line of an artefact, finished or not; None before the first line."""
    return last_line(partial_folder(folder) / TIMING) or last_line(folder / TIMING)
