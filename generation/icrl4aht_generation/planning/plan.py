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

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.format.schema import KINDS, TASKS, Kind
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_generation.collection.noise import noise_bytes
from icrl4aht_generation.collection.noise_rollout import EPISODES_AT_ONCE, play_noisy_episodes
from icrl4aht_generation.collection.record import array_shapes
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.ego import Learner
from icrl4aht_generation.learners.population.fcp import FCP
from icrl4aht_generation.learners.population.population import Population
from icrl4aht_generation.populations.build import population_runs
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.learned import build_untrained
from icrl4aht_generation.teammates.registry import build_teammate

_MEASUREMENTS = 4
"""Measurements of an estimate: of egos, of noise histories, of teammates, of releases."""

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

    Hours include learning, playing and recording: one process trains the populations one after the other, then
    `devices` devices share the tasks, one task at a time each. A process compiles noise histories once for all tasks of
    one teammate family on one layout, but a device of several compiles each of its tasks.

    Attributes:
        profile: name of the profile.
        populations: number of populations of learned teammates.
        teammate_steps: environment steps of all populations.
        tasks: number of tasks.
        learners: number of egos that learn.
        environment_steps: environment steps of all of them.
        noise_histories: number of noise histories.
        noise_transitions: number of their transitions.
        recorded_transitions: transitions of all streams and noise histories, before the stream filter.
        kept_transitions: transitions after the stream filter, at most.
        artefact_bytes: size of the artefacts of all tasks.
        lite_bytes, full_bytes: sizes of a lite and of a full release.
        device: description of the measured device.
        teammate_steps_per_second: measured speed of training populations; None without populations.
        steps_per_second: measured speed of training egos, the mean of all; None without egos.
        compile_seconds: time to compile an ego's task, the longest; None without egos.
        noise_steps_per_second: measured speed of playing noise histories; None without any.
        noise_programs: number of programs to compile for them, one for each layout and teammate family.
        noise_compile_seconds: time to compile one of them; None without any.
        teammate_hours_on_one: hours to train all populations on one device.
        noise_hours_on_one: hours to play all noise histories on one device.
        hours_on_one: hours of the complete rebuild on one device.
        devices: number of devices.
        hours_on_devices: hours of the complete rebuild on this number of devices.
    """

    profile: str
    populations: int
    teammate_steps: int
    tasks: int
    learners: int
    environment_steps: int
    noise_histories: int
    noise_transitions: int
    recorded_transitions: int
    kept_transitions: int
    artefact_bytes: int
    lite_bytes: int
    full_bytes: int
    device: str
    teammate_steps_per_second: float | None
    steps_per_second: float | None
    compile_seconds: float | None
    noise_steps_per_second: float | None
    noise_programs: int
    noise_compile_seconds: float | None
    teammate_hours_on_one: float
    noise_hours_on_one: float
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
        if self.steps_per_second:
            yield "learners", f"{self.learners:,}"
            yield "environment steps", f"{self.environment_steps:,}"
        if self.noise_steps_per_second:
            yield "noise histories", f"{self.noise_histories:,}"
            yield "transitions of them", f"{self.noise_transitions:,}"
        yield "recorded transitions", f"{self.recorded_transitions:,}"
        yield "kept transitions", f"{self.kept_transitions:,}"
        yield "disk, artefacts", filesize.decimal(self.artefact_bytes)
        yield "disk, release lite", filesize.decimal(self.lite_bytes)
        yield "disk, release full", filesize.decimal(self.full_bytes)
        if self.steps_per_second:
            yield "measured here", f"{self.steps_per_second:,.0f} steps/s on {self.device}"
            yield "compiling a task", f"{self.compile_seconds:.0f} s"
        if self.teammate_steps_per_second:
            yield "measured, teammates", f"{self.teammate_steps_per_second:,.0f} steps/s"
            yield "hours, teammates", f"{self.teammate_hours_on_one:,.1f}"
        if self.noise_steps_per_second:
            yield "measured, noise", f"{self.noise_steps_per_second:,.0f} steps/s on {self.device}"
            yield "compiling noise", f"{self.noise_programs} x {self.noise_compile_seconds:.0f} s"
            yield "hours, noise", f"{self.noise_hours_on_one:,.1f}"
        yield "hours on one such device", f"{self.hours_on_one:,.1f}"
        yield f"hours on {self.devices} of them", f"{self.hours_on_devices:,.1f}"


class SourceCost(NamedTuple):
    """Estimated cost of one source's tasks.

    Attributes:
        tasks: number of tasks.
        units: number of learners or of noise histories.
        steps: environment steps of all units.
        recorded: transitions of all units.
        kept: those that a release has at most.
        artefact_bytes: size of the artefacts.
        speed: measured speed; None without tasks.
        programs: number of programs that one process compiles.
        seconds_on_one: time on one device.
        seconds_on_devices: time if several devices share the tasks.
    """

    tasks: int = 0
    units: int = 0
    steps: int = 0
    recorded: int = 0
    kept: int = 0
    artefact_bytes: int = 0
    speed: LearnerSpeed | None = None
    programs: int = 0
    seconds_on_one: float = 0.0
    seconds_on_devices: float = 0.0


def estimate_cost(
    profile: Profile, devices: int, advance: NamedProgress = lambda what, done, total: None
) -> RebuildCost:
    """Estimate a rebuild's cost from the profile, short calibration runs, and histories of the bundled release.

    Args:
        profile: the profile.
        devices: number of devices that share the tasks.
        advance: called before each of the measurements with its name, the number of those done, and their number.
    """
    advance("measuring how fast egos learn", 0, _MEASUREMENTS)
    ppo = ppo_cost(profile, devices) if "ppo" in profile.sources else SourceCost()
    advance("measuring how fast noise histories are played", 1, _MEASUREMENTS)
    noise = noise_cost(profile, devices) if "noise" in profile.sources else SourceCost()
    advance("measuring how fast teammates learn", 2, _MEASUREMENTS)
    populations = [run.steps for run in population_runs(profile, profile.algorithms, 0)]
    playing = calibrate(profile.teammates.ppo, partial(calibration_population, profile)) if populations else None
    advance("measuring the size of releases", 3, _MEASUREMENTS)
    parts = [(source, part.kept) for source, part in (("ppo", ppo), ("noise", noise)) if part.kept]
    sizes = {kind: round(sum(kept * bytes_per_transition(kind, source) for source, kept in parts)) for kind in KINDS}
    advance("measured", _MEASUREMENTS, _MEASUREMENTS)
    teammate_seconds = sum(playing.seconds(steps) for steps in populations) if playing else 0.0
    device = jax.devices()[0]
    return RebuildCost(
        profile=profile.name,
        populations=len(populations),
        teammate_steps=sum(populations),
        tasks=ppo.tasks + noise.tasks,
        learners=ppo.units,
        environment_steps=ppo.steps,
        noise_histories=noise.units,
        noise_transitions=noise.recorded,
        recorded_transitions=ppo.recorded + noise.recorded,
        kept_transitions=ppo.kept + noise.kept,
        artefact_bytes=ppo.artefact_bytes + noise.artefact_bytes,
        **{f"{kind}_bytes": size for kind, size in sizes.items()},
        device=f"{usable_cores()} CPU cores" if device.platform == "cpu" else device.device_kind,
        teammate_steps_per_second=round(playing.steps_per_second, 1) if playing else None,
        steps_per_second=round(ppo.speed.steps_per_second, 1) if ppo.speed else None,
        compile_seconds=round(ppo.speed.compile_seconds, 1) if ppo.speed else None,
        noise_steps_per_second=round(noise.speed.steps_per_second, 1) if noise.speed else None,
        noise_programs=noise.programs,
        noise_compile_seconds=round(noise.speed.compile_seconds, 1) if noise.speed else None,
        teammate_hours_on_one=round(teammate_seconds / 3600, 2),
        noise_hours_on_one=round(noise.seconds_on_one / 3600, 2),
        hours_on_one=round((teammate_seconds + ppo.seconds_on_one + noise.seconds_on_one) / 3600, 2),
        devices=devices,
        hours_on_devices=round((teammate_seconds + ppo.seconds_on_devices + noise.seconds_on_devices) / 3600, 2),
    )


def ppo_cost(profile: Profile, devices: int) -> SourceCost:
    """Estimate the cost of a profile's egos, measuring the speed of one with each of their hyper-parameters."""
    counts = {layout: profile.tasks_on(layout, "ppo") for layout in profile.layouts}
    egos = [profile.ego_on(layout) for layout, count in counts.items() for _ in range(count * profile.learners)]
    if not egos:
        return SourceCost()
    histories = {layout: profile.ego_on(layout).episodes * KEPT_STEPS for layout in counts}
    speeds = {ego: calibrate(ego, partial(task_learner, profile)) for ego in dict.fromkeys(egos)}
    steps = [ego.updates * ego.steps_per_update for ego in egos]
    playing = sum(count / speeds[ego].steps_per_second for ego, count in zip(egos, steps, strict=True))
    seconds = [speeds[ego].seconds(count) for ego, count in zip(egos, steps, strict=True)]
    speed = LearnerSpeed(sum(steps) / playing, max(found.compile_seconds for found in speeds.values()))
    return SourceCost(
        tasks=sum(counts.values()),
        units=len(egos),
        steps=sum(steps),
        recorded=sum(ego.environments * ego.episodes * KEPT_STEPS for ego in egos),
        kept=sum(count * profile.keep * histories[layout] for layout, count in counts.items()),
        artefact_bytes=sum(
            count * profile.learners * artefact_bytes([layout], profile.ego_on(layout))
            for layout, count in counts.items()
        ),
        speed=speed,
        seconds_on_one=sum(seconds),
        seconds_on_devices=sum(sorted(seconds, reverse=True)[::devices]),  # each round takes as long as its longest
    )


def noise_cost(profile: Profile, devices: int) -> SourceCost:
    """Estimate the cost of a profile's noise histories, measuring the speed of one batch of episodes."""
    counts = {layout: profile.tasks_on(layout, "noise") for layout in profile.layouts}
    tasks, config = sum(counts.values()), profile.noise
    if not tasks:
        return SourceCost()
    speed = noise_speed(profile)
    of_task = config.histories * config.episodes * KEPT_STEPS
    families = {(work.task.layout.name, work.task.teammate["family"]) for work in _noise_works(profile)}
    programs = len(families | {(layout, "rl") for layout in profile.algorithms})
    return SourceCost(
        tasks=tasks,
        units=tasks * config.histories,
        recorded=tasks * of_task,
        kept=tasks * of_task,
        artefact_bytes=sum(count * noise_bytes(get_layout(layout), config) for layout, count in counts.items()),
        speed=speed,
        programs=programs,
        seconds_on_one=tasks * of_task / speed.steps_per_second + programs * speed.compile_seconds,
        seconds_on_devices=-(-tasks // devices) * speed.seconds(of_task),
    )


def noise_speed(profile: Profile) -> LearnerSpeed:
    """Measure how fast episodes of the profile's first noise task are played, without writing them."""
    layout, works = get_layout(profile.layouts[0]), _noise_works(profile)
    if works:
        layout, teammate = works[0].task.layout, build_teammate(works[0].task.layout, works[0].task.teammate)
    else:
        teammate = build_untrained(layout, profile.teammates.ppo.widths)
    zeros = np.zeros(EPISODES_AT_ONCE, np.int32)

    def play() -> float:
        began = time.perf_counter()
        episodes = np.arange(EPISODES_AT_ONCE)
        jax.block_until_ready(play_noisy_episodes(layout, teammate, 0, zeros, episodes, zeros.astype(np.float32)))
        return time.perf_counter() - began

    first, second = play(), play()
    return LearnerSpeed(EPISODES_AT_ONCE * KEPT_STEPS / second, max(first - second, 0.0))


def _noise_works(profile: Profile) -> list[Work]:
    """The noise tasks with heuristic teammates."""
    return [work for work in profile.works() if work.source == "noise"]


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
    arrays = (array_shapes(get_layout(layout), ego.environments, ego.episodes).values() for layout in layouts)
    return sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for task in arrays for shape, dtype in task)


def bytes_per_transition(kind: Kind, source: str = "ppo") -> float:
    """Size per transition of a release of this kind, measured on histories of the bundled release.

    Args:
        kind: the kind.
        source: measured is one history of each task of this source, or of each task if the release has none of it.
    """
    dataset = load_icrl4aht()
    tasks = read_tasks(dataset.root / TASKS)
    of_source = {entry.task_id for entry in dataset.entries if entry.source == source}
    with tempfile.TemporaryDirectory() as folder:
        new = [
            NewTask(task, dataset.provenance[task.task_id], 1, partial(_first_history, task))
            for task in tasks
            if not of_source or task.task_id in of_source
        ]
        root = write_release(Path(folder) / kind, kind, new, data_version="0.0.0", card="")
        shards = sum(path.stat().st_size for path in (root / "data").rglob("*.h5"))
        return shards / sum(entry.T for entry in load_icrl4aht(root).entries)


def _first_history(task: Task) -> list[NewHistory]:
    return [NewHistory.from_history(load_icrl4aht(task_id=task.task_id)[0])]
