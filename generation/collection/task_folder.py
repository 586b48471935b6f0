"""A task's artefact on disk: what is in the folder, when it counts as finished, and how it fills.

<task_id>/            finished: its hashes hold
  metadata.json       task, settings, versions, SHA-256 of the files below
  state.npy actions.npy teammate_actions.npy rewards.npy episode_end_state.npy
  metrics.jsonl       one line per update
  policy.safetensors policy.json   the final ego
  timing.jsonl        wall-clock figures, and therefore no part of what is hashed
<task_id>.partial/    the same while it fills, and `learner.safetensors`: the state after its last saved update
.<task_id>.lock       held by the collector that is at it
"""

from __future__ import annotations

import json
import os
import shutil
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from generation.collection import record
from generation.learners.ppo import PPOConfig
from generation.learners.resume import METRICS, TIMING, RunLog, software_versions
from generation.profiles import Profile
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.utils.files import atomic_write, parse_json, read_text, write_json
from icrl4aht_data.utils.hashes import file_hash, hashes_hold

METADATA, LEARNER = "metadata.json", "learner.safetensors"
FILTER_CURVES = "filter.png"

_HASHED = {f"{name}.npy" for name in record.Histories._fields} | {METRICS, "policy.safetensors", "policy.json"}


def partial_folder(folder: Path) -> Path:
    """Where an unfinished artefact is."""
    return folder.with_name(f"{folder.name}.partial")


def settings(task: Task, profile: Profile) -> dict[str, Any]:
    """What an artefact is made of: a change of any of it makes the artefact anew."""
    return {"task": asdict(task), "ego_hash": profile.ego_hash, "code_version": version("icrl4aht-data")}


def resumable_settings(task: Task, profile: Profile) -> dict[str, Any]:
    """What must be the same for a resumed task to give the same bits as an uninterrupted one."""
    return settings(task, profile) | software_versions()


def is_finished(folder: Path, task: Task, profile: Profile) -> bool:
    """Whether the folder holds this task's artefact under these settings, every file as it was written."""
    try:
        metadata = parse_json(read_text(folder / METADATA))
        wanted = settings(task, profile)
        same = {name: metadata[name] for name in wanted} == wanted and set(metadata["files"]) == _HASHED
        return same and hashes_hold(folder, metadata["files"])
    except (IndexFormatError, OSError, KeyError, TypeError):
        return False


def finish(partial: Path, task: Task, profile: Profile) -> None:
    """Write the metadata: from here on the artefact only waits for its name."""
    metadata = settings(task, profile) | {
        "profile": profile.name,
        "ego": asdict(profile.ego),
        "jax_version": jax.__version__,
        "platform": jax.default_backend(),
        "files": {name: file_hash(partial / name) for name in sorted(_HASHED)},
    }
    with atomic_write(partial / METADATA) as unnamed:
        write_json(unnamed, metadata)


def publish(partial: Path, folder: Path) -> None:
    """Give a complete artefact its name."""
    (partial / LEARNER).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


class Writer:
    """Fills an artefact's histories, metrics and timing, update by update.

    The arrays are memory maps of files that have their full size from the start; `sync` writes them out and maps them
    anew, so that what is in memory is what came since the last `sync`.

    Args:
        partial: an existing folder.
        first: the update to go on with; 0 begins the files anew, otherwise whatever came after it is cut off.
    """

    def __init__(self, partial: Path, task: Task, config: PPOConfig, first: int) -> None:
        self._partial, self._config, self._first = partial, config, first
        self._started = time.perf_counter()
        self._busy = 0.0
        if not first:
            for name, (shape, dtype) in record.shapes(task.layout, config).items():
                np.lib.format.open_memmap(self._array(name), "w+", dtype, shape)
        self._log = RunLog(partial, keep=lambda line: line["update"] < first)
        self._histories = self._mapped()

    def _array(self, name: str) -> Path:
        return self._partial / f"{name}.npy"

    def _mapped(self) -> record.Histories:
        return record.Histories(
            **{name: np.lib.format.open_memmap(self._array(name), "r+") for name in record.Histories._fields}
        )

    def write(self, number: int, rollout: Any, metrics: dict[str, Any]) -> dict[str, float]:
        """Keep one update; returns its metrics and timing.

        Timing counts from the end of this writer's first update: `steps_per_second`, `seconds`, and how many of these
        went into `recording`.
        """
        jax.block_until_ready((rollout, metrics))
        began = time.perf_counter()
        record.keep(self._histories, number, rollout)
        line = {"update": number, "step": (number + 1) * self._config.steps_per_update} | _metrics(metrics)
        now = time.perf_counter()
        self._busy += now - began
        seconds = now - self._started
        speed = max(1, number - self._first) * self._config.steps_per_update / seconds
        if number == self._first:  # the time until here was spent on compiling
            self._started, self._busy = now, 0.0
        timing = {"steps_per_second": round(speed, 1), "seconds": round(seconds, 3), "recording": round(self._busy, 3)}
        self._log.write(line, timing={"update": number} | timing)
        return line | timing

    def sync(self) -> None:
        """Everything written so far is on the disk when this returns, and out of memory."""
        began = time.perf_counter()
        for array in self._histories:
            array.flush()  # type: ignore[attr-defined]
        self._histories = self._mapped()
        self._log.sync()
        self._busy += time.perf_counter() - began

    def count(self, seconds: float) -> None:
        """Add time to what `timing` calls recording."""
        self._busy += seconds

    def close(self) -> None:
        self._log.close()
        del self._histories


def last_timing(folder: Path) -> dict[str, float] | None:
    """The newest line of an artefact's timing, finished or not; None where there is none yet."""
    for place in (partial_folder(folder), folder):
        try:
            with (place / TIMING).open("rb") as stream:
                stream.seek(0, os.SEEK_END)
                stream.seek(max(0, stream.tell() - 1000))
                lines = [line for line in stream.read().split(b"\n")[:-1] if line.endswith(b"}")]
            return json.loads(lines[-1]) if lines else None
        except (OSError, ValueError):
            continue
    return None


def _metrics(metrics: dict[str, Any]) -> dict[str, float]:
    values = {name: float(value) for name, value in metrics.items()}
    if not values.get("episodes", 1):
        values.pop("return", None)  # no episode ended, so there is no mean of any
    return values
