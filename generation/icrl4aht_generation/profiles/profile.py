"""Profile: settings for generating a release, and the units of work that follow from the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import takewhile
from typing import Any, NamedTuple

from icrl4aht_data.benchmark.facts import (
    HEURISTIC_KINDS,
    LAYOUT_NAMES,
    PAPER_TEAMMATE_STEPS,
    PAPER_TEAMMATES,
    PREFERENCE,
    PREFERENCE_LAYOUTS,
    SOURCES,
    SPREAD_SEED,
    layout_track,
)
from icrl4aht_data.benchmark.tasks import Task, make_task, manifest_path, read_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import json_hash
from icrl4aht_data.utils.options import Count, Natural, check_options, replace_options
from icrl4aht_generation.layouts.families import split_of
from icrl4aht_generation.learners.checkpoint import POLICY_CHECKPOINTS
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.profiles.noise_config import SEARCH, NoiseConfig
from icrl4aht_generation.teammates.draws import VALIDATION_SEED, drawn_teammates
from icrl4aht_generation.teammates.preference import all_training_tasks
from icrl4aht_generation.teammates.registry import heuristic_teammate, sample_teammate
from icrl4aht_generation.teammates.spread import spread_teammates

LEAST_EPISODES = 5
"""Minimum number of episodes of a history, because its initial and final returns are means over five episodes."""

_SOURCE_SEEDS, _LAYOUT_SEEDS, _FAMILY_SEEDS, _DRAW_SEEDS = 1_000_000, 10_000, 1_000, 500
_SPREAD_SEEDS = 250_000
_UNSAMPLED_SEEDS = 500_000  # first seed of tasks with presets and learned teammates
_GENERATED_SEEDS, _LAYOUT_TEAMMATES = 700_000, 16

_GENERATED_DRAWS = {"train": 4, "validation": 5, "test": 6}
"""Base seed of teammates on generated layouts by split; their parameters are sampled from `Heuristic.diverse`."""


class WorkUnit(NamedTuple):
    """A unit of work: one learner or script generates histories of one task, which are stored as one artefact.

    Attributes:
        task: task of the histories.
        source: how the histories are made: "ppo" by an ego that learns, "noise" or "search" by a script.
        learner: number of the learner among the independent learners of the task.
    """

    task: Task
    source: str = "ppo"
    learner: int = 0

    @property
    def name(self) -> str:
        """Name of the artefact's folder."""
        return f"{self.task.task_id}-l{self.learner}" if self.learner else self.task.task_id


@dataclass(frozen=True)
class TeammateConfig:
    """Sizes of the suite of learned teammates for each layout; the defaults are from the paper (App. B.1).

    Attributes:
        members: number of policies in each algorithm's population.
        train: number of teammates of each algorithm for training tasks.
        heldout: number of additional teammates of each algorithm, for the in-distribution check.
        ppo: hyper-parameters of every policy.

    Raises:
        OptionError: if the populations have fewer checkpoints than requested teammates.
    """

    members: Count = 10
    train: Count = PAPER_TEAMMATES
    heldout: Natural = 5
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            total_steps=PAPER_TEAMMATE_STEPS, environments=256, warmup=0.05, shaping_horizon=15_000_000
        )
    )

    def __post_init__(self) -> None:
        check_options(self)
        most = self.members * POLICY_CHECKPOINTS
        if self.train + self.heldout > most:
            raise OptionError(
                f"teammates.train = {self.train}, teammates.heldout = {self.heldout}: expected at most {most} "
                f"together, {POLICY_CHECKPOINTS} checkpoints of each of {self.members} members"
            )


@dataclass(frozen=True)
class SpreadConfig:
    """How many widely different heuristic teammates to choose, see `teammates.spread`.

    Attributes:
        per_layout: number of training teammates by layout; the source "noise" uses all of them.
        ppo: number of training teammates by layout that the source "ppo" uses, counted from the first.
        validation: number of validation teammates by layout, which only the source "noise" uses.
    """

    per_layout: dict[str, int]
    ppo: dict[str, int]
    validation: dict[str, int]

    def teammates_of(self, layout: str, source: str) -> list[tuple[str, dict[str, Any]]]:
        """Return pairs (split of the task, teammate entry) of a source on a layout.

        Raises:
            OptionError: if too few measured teammates of the layout differ from the test teammates.
        """
        count = self.ppo[layout] if source == "ppo" else None
        found = [("train", entry) for entry in self._split_entries(layout, "train", self.per_layout[layout])[:count]]
        validation = self._split_entries(layout, "validation", self.validation[layout])
        return found + [("validation", entry) for entry in validation if source == "noise"]

    def _split_entries(self, layout: str, split: str, count: int) -> list[dict[str, Any]]:
        return spread_teammates(layout, split, count)


@dataclass(frozen=True)
class SampledConfig(SpreadConfig):
    """How many heuristic teammates to sample from the published training ranges of their parameters.

    Attributes:
        families: for each layout, the heuristic families, which take turns, see `teammates.draws`.
    """

    families: dict[str, tuple[str, ...]]

    def _split_entries(self, layout: str, split: str, count: int) -> list[dict[str, Any]]:
        families, seed, trained = self.families[layout], 0, set[tuple[str, int]]()
        if split == "validation" and count:
            training = drawn_teammates(layout, families, self.per_layout[layout])
            trained, seed = {(draw.family, draw.behaviour) for _, draw in training}, VALIDATION_SEED
        return [entry for entry, _ in drawn_teammates(layout, families, count, seed, trained)]


@dataclass(frozen=True)
class Profile:
    """All settings for generating a release.

    Attributes:
        name: name of the profile's file.
        ego: hyper-parameters of the egos.
        teammates: sizes and hyper-parameters of the learned teammates.
        data_version: version of the release, SemVer.
        keep: maximum number of histories of each task of the source "ppo" in the release, best first.
        layouts: names of the layouts.
        sources: how histories are made: "ppo", "noise" and "search", one or more.
        learners: number of independent learners of each task of the source "ppo".
        presets: presets of the heuristic H4 `utility_greedy`, which are teammates on all `layouts`.
        sampled: numbers of heuristic teammates with sampled parameters.
        spread: numbers of widely different heuristic teammates, on layouts without sampled teammates.
        algorithms: algorithms of the learned teammates by layout.
        ego_layouts: hyper-parameters of the egos by layout, for layouts with other values than `ego`.
        noise: options of histories of the source "noise".
        search: options of histories of the source "search".
        scripted_layouts: options by source and layout, for layouts with other values than `noise` or `search`.
        generated: number of sampled teammates by generated layout. TOML tables `[[tasks.generated]]` add generated
            layouts, with `family`, `count`, `split` and `teammates`, the number of diverse teammates (default 0).
        preference: layouts of the source "search", which has the training and validation tasks of the track
            `preference` on these layouts.
        all_dishes: whether the source "search" has a training task for each teammate and dish, not only the training
            tasks of the track, in which most teammates want one dish.
        policies: whether the release contains the policies that label the histories.
        oracle_actions: whether the release contains the scripted oracle's action at every step.
        least_improvement: minimum improvement from the initial to the final return of an ego's history in the release;
            None for no minimum.
        least_rise: minimum mean improvement of a task's histories for a task in the release; None for no minimum.
            Neither minimum applies to a layout where reference egos earn about the same with every teammate.
        xla_threads: number of CPU threads of XLA, which gives equal bits on every machine; None for all cores.

    Raises:
        OptionError: if sizes of the ego's training are invalid.
    """

    name: str
    ego: PPOConfig
    teammates: TeammateConfig
    data_version: str
    keep: int
    layouts: tuple[str, ...]
    sources: tuple[str, ...] = ("ppo",)
    learners: int = 1
    presets: tuple[str, ...] = ()
    sampled: SampledConfig | None = None
    spread: SpreadConfig | None = None
    algorithms: dict[str, tuple[str, ...]] = field(default_factory=dict)
    ego_layouts: dict[str, PPOConfig] = field(default_factory=dict)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    search: NoiseConfig = SEARCH
    scripted_layouts: dict[str, dict[str, NoiseConfig]] = field(default_factory=dict)
    generated: dict[str, int] = field(default_factory=dict)
    preference: tuple[str, ...] = ()
    all_dishes: bool = False
    policies: bool = False
    oracle_actions: bool = False
    least_improvement: float | None = None
    least_rise: float | None = None
    xla_threads: int | None = None

    def __post_init__(self) -> None:
        if "ppo" not in self.sources:
            return
        for ego in (self.ego, *self.ego_layouts.values()):
            if not 0 < self.keep <= ego.environments * self.learners:
                raise OptionError(f"release.keep = {self.keep}: expected 1..{ego.environments * self.learners}")
            if ego.episodes < LEAST_EPISODES:
                raise OptionError(
                    f"ego.total_steps gives {ego.episodes} episodes in a history, expected at least {LEAST_EPISODES}"
                )

    def with_ego(self, given: Mapping[str, Any]) -> Profile:
        """Return a copy of the profile with other hyper-parameters of the ego, which apply to every layout.

        Args:
            given: new values of hyper-parameters by name, such as {"widths": {"gru": 4}}; others are kept.

        Raises:
            OptionError: if a value is invalid.
        """
        try:
            egos = {layout: replace_options(ego, given) for layout, ego in self.ego_layouts.items()}
            return replace(self, ego=replace_options(self.ego, given), ego_layouts=egos)
        except ValueError as error:
            raise OptionError(f"profile {self.name} with the given options: {error}") from error

    def ego_config(self, layout: str) -> PPOConfig:
        """Return the hyper-parameters of the egos on a layout (short name)."""
        return self.ego_layouts.get(layout, self.ego)

    def scripted_config(self, layout: str, source: str) -> NoiseConfig:
        """Return the options of a layout (short name) for the source "noise" or "search"."""
        common = self.search if source == "search" else self.noise
        return self.scripted_layouts.get(source, {}).get(layout, common)

    def layouts_of(self, source: str) -> tuple[str, ...]:
        """Return the names of a source's layouts."""
        return self.preference if source == "search" else self.layouts

    def units(self, learned: Sequence[Task] = ()) -> list[WorkUnit]:
        """Return all units of work of the profile, by source and layout.

        Args:
            learned: training tasks with learned teammates, see `populations.select.make_tasks`.

        Raises:
            OptionError: if a layout has too few usable sampled teammates.
        """
        units = []
        for source in self.sources:
            for layout in self.layouts_of(source):
                own = [task for task in learned if task.layout.name == layout and source != "search"]
                tasks = [*self._heuristic_tasks(layout, source), *(_task_of_source(task, source) for task in own)]
                units += self._work_units(tasks, source)
        return units

    def units_of(self, tasks: Sequence[Task], sources: Mapping[str, str]) -> list[WorkUnit]:
        """Return the units of work of given tasks.

        Args:
            tasks: tasks to generate.
            sources: source by task id; other tasks have the profile's source if it has only one.

        Raises:
            OptionError: if the profile does not have a task's source, or the source of a task is not known.
        """
        units = []
        for task in tasks:
            source = sources.get(task.task_id, self.sources[0])
            if task.task_id not in sources and self.sources[1:]:
                raise OptionError(
                    f"task {task.task_id}: its source is unknown, and profile {self.name} has several: "
                    f"{', '.join(self.sources)}; give the file meta/tasks.jsonl of a release, which states the sources "
                    f"of its tasks, or a profile with one source"
                )
            if source not in self.sources:
                raise OptionError(
                    f"task {task.task_id}: the source is {source}, but profile {self.name} only has "
                    f"{', '.join(self.sources)}: choose a profile with this source, or remove the task"
                )
            units += self._work_units([task], source)
        return units

    def _work_units(self, tasks: Sequence[Task], source: str) -> list[WorkUnit]:
        learners = self.learners if source == "ppo" else 1
        return [WorkUnit(task, source, learner) for task in tasks for learner in range(learners)]

    def task_count(self, layout: str, source: str) -> int:
        """Return the number of tasks of a source on a layout, assuming enough good teammates in every population."""
        learned = len(self.algorithms.get(layout, ())) * self.teammates.train * (source != "search")
        return len(self._heuristic_tasks(layout, source)) + learned

    def _heuristic_tasks(self, layout: str, source: str) -> list[Task]:
        if source == "search":
            first = _first_seed(source) + PREFERENCE_LAYOUTS["train"].index(layout) * _LAYOUT_SEEDS
            paths = (manifest_path(PREFERENCE, split) for split in ("train", "validation"))
            own = [task for path in paths for task in read_tasks(path) if task.layout.name == layout]
            if self.all_dishes:
                own = [*all_training_tasks(layout), *(task for task in own if task.split != "train")]
            return [
                make_task(task.track, task.split, layout, task.teammate, first + number, task.recipes)
                for number, task in enumerate(own)
            ]
        track, first = layout_track(layout), self.layouts.index(layout) * len(self.presets)
        split = "train" if layout in LAYOUT_NAMES else split_of(get_layout(layout))
        tasks = [
            make_task(track, split, layout, heuristic_teammate("utility_greedy", preset, number), first + number)
            for number, preset in enumerate(self.presets)
        ]
        tasks = [_task_of_source(task, source) for task in tasks]
        if layout in self.generated:
            first = _first_seed(source) + _GENERATED_SEEDS + list(self.generated).index(layout) * _LAYOUT_TEAMMATES
            return tasks + [
                make_task(track, split, layout, entry, first + number)
                for number, entry in enumerate(_generated_teammates(layout, split, self.generated))
            ]
        entries = [
            pair for config in (self.sampled, self.spread) if config for pair in config.teammates_of(layout, source)
        ]
        return tasks + [
            make_task(track, split, layout, entry, _drawn_task_seed(layout, source, entry)) for split, entry in entries
        ]

    @property
    def hash(self) -> str:
        """Hash of all settings of the profile."""
        return json_hash(asdict(self))


def _generated_teammates(layout: str, split: str, generated: Mapping[str, int]) -> list[dict[str, Any]]:
    """Return the sampled teammates of a generated layout; the families take turns over all generated layouts."""
    first, kinds = sum(generated[name] for name in takewhile(layout.__ne__, generated)), list(HEURISTIC_KINDS)
    return [
        sample_teammate(kinds[number % len(kinds)], number // len(kinds), "diverse", _GENERATED_DRAWS[split])
        for number in range(first, first + generated[layout])
    ]


def _drawn_task_seed(layout: str, source: str, entry: Mapping[str, Any]) -> int:
    """Return a unique seed for a task, which does not depend on the rest of the profile."""
    family = list(HEURISTIC_KINDS).index(entry["family"])
    first = LAYOUT_NAMES.index(layout) * _LAYOUT_SEEDS + family * _FAMILY_SEEDS
    first += _SPREAD_SEEDS if entry["base_seed"] == SPREAD_SEED else entry["base_seed"] * _DRAW_SEEDS
    return _first_seed(source) + first + entry["theta_id"]


def _task_of_source(task: Task, source: str) -> Task:
    """Return a task with a preset or learned teammate, with a new seed for the given source unless it is "ppo"."""
    if source == "ppo":
        return task
    seed = _first_seed(source) + _UNSAMPLED_SEEDS + task.seed
    return make_task(task.track, task.split, task.layout.name, task.teammate, seed, task.recipes)


def _first_seed(source: str) -> int:
    return (1 + SOURCES.index(source)) * _SOURCE_SEEDS
