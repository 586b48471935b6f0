"""Cost of a rebuild, estimated before it starts."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich import filesize

from generation.collection.record import array_shapes
from generation.env import Environment
from generation.learners.config import PPOConfig
from generation.learners.ego import Learner
from generation.learners.population.fcp import FCP
from generation.learners.population.population import Population
from generation.populations.build import population_runs
from generation.profiles import Profile
from generation.teammates.learned import build_untrained
from generation.teammates.registry import build_teammate
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import KINDS, TASKS, Kind
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.threads import usable_cores
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

_MEASUREMENTS = 3
"""Measurements of an estimate: of egos, of teammates, of releases."""

_WORTH_MEASURING = 20.0
"""Seconds: a complete update that should take less is measured itself, not only a share of it."""


class LearnerSpeed(NamedTuple):
    """Speed of a learner on this machine.

    Attributes:
        steps_per_second: environment steps of all its environments.
        compile_seconds: time to compile `init` and `update`.
    """

    steps_per_second: float
    compile_seconds: float

    def seconds(self, steps: int) -> float:
        """Time for so many environment steps, with compiling."""
        return steps / self.steps_per_second + self.compile_seconds


@dataclass(frozen=True)
class RebuildCost:
    """Estimated cost of rebuilding a profile.

    Hours include learning and recording: one process trains the populations one after the other, then `devices` devices
    share the tasks, one task at a time each.

    Attributes:
        profile: name of the profile.
        populations: number of populations of learned teammates.
        teammate_steps: environment steps of all populations.
        tasks: number of tasks.
        environment_steps: environment steps of all tasks.
        recorded_transitions: transitions of all streams, before the stream filter.
        kept_transitions: transitions after the stream filter.
        artefact_bytes: size of the artefacts of all tasks.
        lite_bytes, full_bytes: sizes of a lite and of a full release.
        device: description of the measured device.
        teammate_steps_per_second: measured speed of training populations; None without populations.
        steps_per_second: measured speed of training egos.
        compile_seconds: time to compile a task.
        teammate_hours_on_one: hours to train all populations on one device.
        hours_on_one: hours of the complete rebuild on one device.
        devices: number of devices.
        hours_on_devices: hours of the complete rebuild on this number of devices.
    """

    profile: str
    populations: int
    teammate_steps: int
    tasks: int
    environment_steps: int
    recorded_transitions: int
    kept_transitions: int
    artefact_bytes: int
    lite_bytes: int
    full_bytes: int
    device: str
    teammate_steps_per_second: float | None
    steps_per_second: float
    compile_seconds: float
    teammate_hours_on_one: float
    hours_on_one: float
    devices: int
    hours_on_devices: float

    def to_json(self) -> dict[str, Any]:
        """The fields."""
        return asdict(self)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yields (quantity, value) in the order to be printed."""
        yield "profile", self.profile
        if self.teammate_steps_per_second:
            yield "populations of teammates", f"{self.populations:,}"
            yield "environment steps of them", f"{self.teammate_steps:,}"
        yield "tasks", f"{self.tasks:,}"
        yield "environment steps", f"{self.environment_steps:,}"
        yield "recorded transitions", f"{self.recorded_transitions:,}"
        yield "kept transitions", f"{self.kept_transitions:,}"
        yield "disk, artefacts", filesize.decimal(self.artefact_bytes)
        yield "disk, release lite", filesize.decimal(self.lite_bytes)
        yield "disk, release full", filesize.decimal(self.full_bytes)
        yield "measured here", f"{self.steps_per_second:,.0f} steps/s on {self.device}"
        yield "compiling a task", f"{self.compile_seconds:.0f} s"
        if self.teammate_steps_per_second:
            yield "measured, teammates", f"{self.teammate_steps_per_second:,.0f} steps/s"
            yield "hours, teammates", f"{self.teammate_hours_on_one:,.1f}"
        yield "hours on one such device", f"{self.hours_on_one:,.1f}"
        yield f"hours on {self.devices} of them", f"{self.hours_on_devices:,.1f}"


def estimate_cost(
    profile: Profile, devices: int, advance: NamedProgress = lambda what, done, total: None
) -> RebuildCost:
    """Estimate a rebuild's cost from the profile, short calibration runs, and histories of the bundled release.

    Args:
        profile: the profile.
        devices: number of devices that share the tasks.
        advance: called before each of the measurements with its name, the number of those done, and their number.
    """
    ego = profile.ego
    layouts = [
        layout
        for layout in profile.layouts
        for _ in range(profile.tasks_on(layout, "ppo") * profile.learners * ("ppo" in profile.sources))
    ]
    tasks = len(layouts)
    advance("measuring how fast egos learn", 0, _MEASUREMENTS)
    learning = calibrate(ego, partial(task_learner, profile))
    task_seconds = learning.seconds(ego.updates * ego.steps_per_update)
    advance("measuring how fast teammates learn", 1, _MEASUREMENTS)
    populations = [run.steps for run in population_runs(profile, profile.algorithms, 0)]
    playing = calibrate(profile.teammates.ppo, partial(calibration_population, profile)) if populations else None
    advance("measuring the size of releases", 2, _MEASUREMENTS)
    sizes = {kind: bytes_per_transition(kind) for kind in KINDS}
    advance("measured", _MEASUREMENTS, _MEASUREMENTS)
    population_seconds = [playing.seconds(steps) for steps in populations] if playing else []
    in_turn = sum(population_seconds) + -(-tasks // devices) * task_seconds
    kept = tasks * profile.keep * ego.episodes * KEPT_STEPS
    device = jax.devices()[0]
    return RebuildCost(
        profile=profile.name,
        populations=len(populations),
        teammate_steps=sum(populations),
        tasks=tasks,
        environment_steps=tasks * ego.updates * ego.steps_per_update,
        recorded_transitions=tasks * ego.environments * ego.episodes * KEPT_STEPS,
        kept_transitions=kept,
        artefact_bytes=artefact_bytes(layouts, ego),
        **{f"{kind}_bytes": round(kept * size) for kind, size in sizes.items()},
        device=f"{usable_cores()} CPU cores" if device.platform == "cpu" else device.device_kind,
        teammate_steps_per_second=round(playing.steps_per_second, 1) if playing else None,
        steps_per_second=round(learning.steps_per_second, 1),
        compile_seconds=round(learning.compile_seconds, 1),
        teammate_hours_on_one=round(sum(population_seconds) / 3600, 2),
        hours_on_one=round((sum(population_seconds) + tasks * task_seconds) / 3600, 2),
        devices=devices,
        hours_on_devices=round(in_turn / 3600, 2),
    )


def task_learner(profile: Profile, ego: PPOConfig, layout_name: str | None = None) -> Learner:
    """The ego of a task on the profile's first layout or the given one, with a teammate of the profile's kind."""
    layout = get_layout(layout_name or profile.layouts[0])
    heuristics = [work.task.teammate for work in profile.works() if work.source == "ppo"]
    if profile.algorithms or not heuristics:
        teammate = build_untrained(layout, profile.teammates.ppo.widths)
    else:
        teammate = build_teammate(layout, heuristics[0])
    return Learner(Environment(layout), teammate, ego)


def calibration_population(profile: Profile, config: PPOConfig) -> Population:
    """A population on the profile's first layout."""
    return Population(Environment(get_layout(profile.layouts[0])), FCP(profile.teammates.members), config)


def calibrate(config: PPOConfig, make: Callable[[PPOConfig], Learner | Population]) -> LearnerSpeed:
    """Measure the learner that `make` returns for a configuration.

    An update with the environments of one minibatch costs as much per step if it keeps the device busy; if the complete
    update should then be short, it is measured instead.
    """
    share = replace(config, environments=config.environments // config.minibatches, minibatches=1)
    speed, steps = _measure(make(share))
    if share != config and steps * config.minibatches / speed.steps_per_second < _WORTH_MEASURING:
        speed, _ = _measure(make(config))
    return speed


def _measure(learner: Learner | Population) -> tuple[LearnerSpeed, int]:
    """Speed, and the environment steps of an update."""
    began = time.perf_counter()
    state: Any = jax.jit(learner.init)(jax.random.key(0))
    update = jax.jit(learner.update, donate_argnums=0).lower(state).compile()
    compiling = time.perf_counter() - began
    state, *_ = jax.block_until_ready(update(state))
    began = time.perf_counter()
    jax.block_until_ready(update(state))
    steps = learner.steps_per_update
    return LearnerSpeed(steps / (time.perf_counter() - began), compiling), steps


def artefact_bytes(layouts: Sequence[str], ego: PPOConfig) -> int:
    """Uncompressed size of the histories of one task on each of these layouts."""
    arrays = (array_shapes(get_layout(layout), ego).values() for layout in layouts)
    return sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for task in arrays for shape, dtype in task)


def bytes_per_transition(kind: Kind) -> float:
    """Size per transition of a release of this kind, measured on one history of each task of the bundled release."""
    dataset = load_icrl4aht()
    with tempfile.TemporaryDirectory() as folder:
        new = [
            NewTask(task, Provenance(), 1, partial(_first_history, task)) for task in read_tasks(dataset.root / TASKS)
        ]
        root = write_release(Path(folder) / kind, kind, new, data_version="0.0.0", card="")
        shards = sum(path.stat().st_size for path in (root / "data").rglob("*.h5"))
        return shards / sum(entry.T for entry in load_icrl4aht(root).entries)


def _first_history(task: Task) -> list[NewHistory]:
    return [NewHistory.from_history(load_icrl4aht(task_id=task.task_id)[0])]
