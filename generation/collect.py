"""One task -> one finished artefact folder: histories, final ego, metrics, metadata.

The folder appears under its name only when it is complete, and is taken for finished only if its hashes hold.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from filelock import FileLock, Timeout

from generation import record
from generation.env import Environment
from generation.learners.checkpoint import save_policy
from generation.learners.ego import Learner, compiled_update
from generation.profiles import Profile
from generation.teammates.base import Noise
from generation.teammates.registry import build
from icrl4aht_data.benchmark import TEAMMATE
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.files import parse_json, read_text
from icrl4aht_data.release import file_hash
from icrl4aht_data.tasks import Task

METADATA = "metadata.json"

TEAMMATE_NOISE: Noise = "seeded"
"""Heuristic teammates of training histories draw from each episode's own key."""

_FILES = {f"{name}.npy" for name in record.Histories._fields} | {"metrics.jsonl", "policy.safetensors", "policy.json"}

Report = Callable[[int, dict[str, float]], None]
"""Called after each update with its number and metrics."""


def make_learner(task: Task, profile: Profile) -> Learner:
    """The ego of a task, untrained."""
    mate = build(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE)
    return Learner(Environment(task.layout), mate, profile.ego)


def is_finished(folder: Path, task: Task, profile: Profile) -> bool:
    """Whether the folder holds this task's artefact under these settings, every file as it was written."""
    try:
        metadata = parse_json(read_text(folder / METADATA))
        same = (
            metadata["task"] == asdict(task)
            and metadata["ego_hash"] == profile.ego_hash
            and metadata["code_version"] == version("icrl4aht-data")
            and set(metadata["files"]) == _FILES
        )
        return same and all(file_hash(folder / name) == digest for name, digest in metadata["files"].items())
    except (IndexFormatError, OSError, KeyError, TypeError):
        return False


def run_task(task: Task, profile: Profile, folder: Path, report: Report = lambda update, metrics: None) -> None:
    """Train the ego of a task from scratch and record its histories into `folder`.

    Raises:
        OptionError: if another process is at this task.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder.with_name(f".{folder.name}.lock"), timeout=0):
            _run(task, profile, folder, report)
    except Timeout as error:
        raise OptionError(
            f"{folder}: another process is collecting this task; wait for it, or give another --out"
        ) from error


def _run(task: Task, profile: Profile, folder: Path, report: Report) -> None:
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    learner = make_learner(task, profile)
    histories = record.Histories(
        **{
            name: np.lib.format.open_memmap(partial / f"{name}.npy", "w+", dtype, shape)
            for name, (shape, dtype) in record.shapes(task.layout, profile.ego).items()
        }
    )
    state = jax.jit(learner.init)(jax.random.key(task.seed))
    update = compiled_update(learner)
    started = time.perf_counter()
    with (partial / "metrics.jsonl").open("w", encoding="utf-8") as log:
        for number in range(profile.ego.updates):
            state, rollout, metrics = update(state)
            record.keep(histories, number, rollout)
            line = _metrics_line(number, metrics, profile, time.perf_counter() - started)
            log.write(json.dumps(line) + "\n")
            report(number, line)
    for array in histories:
        array.flush()  # type: ignore[attr-defined]
    save_policy(
        partial,
        learner.network,
        state.params,
        {"task_id": task.task_id, "steps": profile.ego.updates * profile.ego.steps_per_update},
    )
    _finish(partial, folder, task, profile)


def _metrics_line(number: int, metrics: dict[str, Any], profile: Profile, seconds: float) -> dict[str, float]:
    values = {name: float(value) for name, value in metrics.items()}
    if not values["episodes"]:
        del values["return"]
    step = (number + 1) * profile.ego.steps_per_update
    return {"update": number, "step": step, "steps_per_second": round(step / seconds, 1), **values}


def _finish(partial: Path, folder: Path, task: Task, profile: Profile) -> None:
    files = {path.name: file_hash(path) for path in sorted(partial.iterdir())}
    metadata = {
        "task": asdict(task),
        "profile": profile.name,
        "ego": asdict(profile.ego),
        "ego_hash": profile.ego_hash,
        "code_version": version("icrl4aht-data"),
        "files": files,
    }
    (partial / METADATA).write_text(json.dumps(metadata, indent=2) + "\n", encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)
