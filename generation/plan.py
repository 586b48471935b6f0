"""What a rebuild costs, before it starts."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich import filesize

from generation import record
from generation.collect import make_learner
from generation.learners.ppo import PPOConfig
from generation.profiles import Profile
from icrl4aht_data.benchmark import KEPT_STEPS
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.release import NewHistory, NewTask, write_release
from icrl4aht_data.schema import KINDS, TASKS, Kind
from icrl4aht_data.tasks import Task, read_tasks

_WORTH_MEASURING = 20.0
"""Seconds: a whole update that should take less is measured itself, not only a share of it."""


@dataclass(frozen=True)
class Cost:
    """Of a whole profile. Hours are of learning and recording; N devices take the tasks in turn."""

    profile: str
    tasks: int
    environment_steps: int
    recorded_transitions: int
    kept_transitions: int
    artefact_bytes: int
    lite_bytes: int
    full_bytes: int
    device: str
    steps_per_second: float
    compile_seconds: float  # of each task
    hours_on_one: float
    devices: int
    hours_on_devices: float

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def in_words(self) -> Iterator[tuple[str, str]]:
        """(what, how much) in the order to be printed."""
        yield "profile", self.profile
        yield "tasks", f"{self.tasks:,}"
        yield "environment steps", f"{self.environment_steps:,}"
        yield "recorded transitions", f"{self.recorded_transitions:,}"
        yield "kept transitions", f"{self.kept_transitions:,}"
        yield "disk, artefacts", filesize.decimal(self.artefact_bytes)
        yield "disk, release lite", filesize.decimal(self.lite_bytes)
        yield "disk, release full", filesize.decimal(self.full_bytes)
        yield "measured here", f"{self.steps_per_second:,.0f} steps/s on {self.device}"
        yield "compiling a task", f"{self.compile_seconds:.0f} s"
        yield "hours on one such device", f"{self.hours_on_one:,.1f}"
        yield f"hours on {self.devices} of them", f"{self.hours_on_devices:,.1f}"


def cost(profile: Profile, devices: int) -> Cost:
    """Reckoned from the profile, a calibration run of its first task, and a history of the bundled release.

    Args:
        devices: the N of `hours_on_devices`; each does one task at a time.
    """
    tasks, ego = profile.tasks(), profile.ego
    speed, compiling = calibrate(tasks[0], profile)
    seconds = ego.updates * ego.steps_per_update / speed + compiling
    kept = len(tasks) * profile.keep * ego.episodes * KEPT_STEPS
    device = jax.devices()[0]
    return Cost(
        profile=profile.name,
        tasks=len(tasks),
        environment_steps=len(tasks) * ego.updates * ego.steps_per_update,
        recorded_transitions=len(tasks) * ego.environments * ego.episodes * KEPT_STEPS,
        kept_transitions=kept,
        artefact_bytes=artefact_bytes(tasks, ego),
        **{f"{kind}_bytes": round(kept * bytes_per_transition(kind)) for kind in KINDS},
        device=f"{device.device_kind} ({device.platform})",
        steps_per_second=round(speed, 1),
        compile_seconds=round(compiling, 1),
        hours_on_one=round(len(tasks) * seconds / 3600, 2),
        devices=devices,
        hours_on_devices=round(-(-len(tasks) // devices) * seconds / 3600, 2),
    )


def calibrate(task: Task, profile: Profile) -> tuple[float, float]:
    """Steps/s of a task's learner on this machine, and the seconds it takes to compile.

    First an update with the environments of one minibatch, which costs as much a step where the device is kept busy
    by that many; where a whole update should then be short, that is measured instead.
    """
    ego = profile.ego
    share = replace(ego, environments=ego.environments // ego.minibatches, minibatches=1)
    speed, compiling = _measure(task, profile, share)
    if share != ego and ego.steps_per_update / speed < _WORTH_MEASURING:
        speed, compiling = _measure(task, profile, ego)
    return speed, compiling


def _measure(task: Task, profile: Profile, ego: PPOConfig) -> tuple[float, float]:
    learner = make_learner(task, replace(profile, ego=ego))
    began = time.perf_counter()
    state = jax.jit(learner.init)(jax.random.key(task.seed))
    update = jax.jit(learner.update, donate_argnums=0).lower(state).compile()
    compiling = time.perf_counter() - began
    state, *_ = jax.block_until_ready(update(state))
    began = time.perf_counter()
    jax.block_until_ready(update(state))
    return ego.steps_per_update / (time.perf_counter() - began), compiling


def artefact_bytes(tasks: Sequence[Task], ego: PPOConfig) -> int:
    """What the histories of these tasks take, uncompressed."""
    arrays = (record.shapes(task.layout, ego).values() for task in tasks)
    return sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for task in arrays for shape, dtype in task)


def bytes_per_transition(kind: Kind) -> float:
    """Of the bundled release's data, one history of each of its tasks, if packed so."""
    dataset = load_icrl4aht()
    with tempfile.TemporaryDirectory() as folder:
        new = [NewTask(task, {}, 1, partial(_first_history, task)) for task in read_tasks(dataset.root / TASKS)]
        root = write_release(Path(folder) / kind, kind, new, data_version="0.0.0", card="")
        shards = sum(path.stat().st_size for path in (root / "data").rglob("*.h5"))
        return shards / sum(entry.T for entry in load_icrl4aht(root).entries)


def _first_history(task: Task) -> list[NewHistory]:
    history = load_icrl4aht(task_id=task.task_id)[0]
    names = [field.name for field in history.entry.stored_fields("lite")]
    return [NewHistory(history.entry.env_idx, {name: history.read(name) for name in names})]
