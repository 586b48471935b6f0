"""Adaptation headroom: what knowing the teammate from the start is worth to an ego.

Two recurrent egos are trained on the same tasks with the same budget, both with their memory cleared before each
episode: the *informed* one is told in every step which task it plays, the *episodic* one has to find out within the
episode. The return of the first minus that of the second estimates what memory across episodes can earn: both would
earn more after a longer training, the informed one of many tasks above all.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.teammates.registry import build_teammate, with_equal_parameters
from scipy import stats

from icrl4aht_baselines.online.responses import ResponseOptions, TrainingJob
from icrl4aht_baselines.online.rl2 import TaskGroup
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash, parse_json, read_text, write_json
from icrl4aht_data.utils.templates import markdown_table

EgoKind = Literal["informed", "episodic"]
EGO_KINDS: tuple[EgoKind, ...] = ("informed", "episodic")

MEASURED_EPISODES = 100
"""Episodes of each running task over which the return of a trained ego is measured."""

_MEASURE_SEED = 1_000


@dataclass(frozen=True, kw_only=True)
class HeadroomJob(TrainingJob):
    """The training of an informed or episodic ego on a set of tasks, at most as many as are played at once.

    Attributes:
        title: name of the set of tasks.
        kind: "informed" or "episodic".

    Raises:
        OptionError: if there are more tasks than are played at once.
    """

    title: str
    kind: EgoKind

    def __post_init__(self) -> None:
        if len(self.tasks) > self.options.tasks:
            raise OptionError(
                f"tasks = {self.options.tasks}: {self.title} has {len(self.tasks)} tasks, and each is to be played; "
                f"give --tasks {len(self.tasks)} or more"
            )

    @property
    def name(self) -> str:
        """Set of tasks, kind, width and seed."""
        return f"{self.title}-{self.kind}-{self.ending}"

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.title}, {self.kind}, seed {self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """What the result depends on."""
        tasks = json_hash([task.task_id for task in self.tasks])
        return {"tasks_hash": tasks, "kind": self.kind, **super().settings}

    def returns(self) -> dict[str, float]:
        """Return task id -> mean return, of a finished training."""
        return self.result()["returns"]

    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Train the ego, and return its mean return in each task, of drawn actions in new episodes."""
        groups, numbers = self._groups()
        layouts = list(dict.fromkeys(task.layout for task in self.tasks))
        told = len(self.tasks) if self.kind == "informed" else 0
        trainer, params = self.train(layouts, groups, on_update, told=told)
        by_task: dict[int, list[float]] = defaultdict(list)
        groups_played = [group for player in trainer.players for group in player.groups]
        measured = trainer.measure(params, MEASURED_EPISODES, _MEASURE_SEED)
        for group, returns in zip(groups_played, measured, strict=True):
            for number, own in zip(numbers[group.name], returns.mean(axis=1), strict=True):
                by_task[number].append(float(own))
        return {"returns": {task.task_id: round(float(np.mean(by_task[k])), 3) for k, task in enumerate(self.tasks)}}

    def _groups(self) -> tuple[list[TaskGroup], dict[str, list[int]]]:
        """Return the groups of tasks that are played at once, and the number of the task of each, by group's name."""
        numbers: dict[str, list[int]] = defaultdict(list)
        for played in range(self.options.tasks):
            number = played % len(self.tasks)
            numbers[self.tasks[number].teammate_kind].append(number)
        groups = []
        for kind, own in numbers.items():
            layouts = [self.tasks[number].layout for number in own]
            several = len(set(layouts)) > 1
            entries = with_equal_parameters([self.tasks[number].teammate for number in own])
            mates = [build_teammate(None if several else layouts[0], entry) for entry in entries]
            told = own if self.kind == "informed" else None
            groups.append(TaskGroup(layouts, kind, mates, False, self.title, told))
        return groups, {group.name: own for group, own in zip(groups, numbers.values(), strict=True)}


def headroom_jobs(
    sets: Mapping[str, Sequence[Task]], seeds: int, options: ResponseOptions, out: Path
) -> list[HeadroomJob]:
    """Return the jobs that measure sets of tasks, by name, with all kinds of egos; first those of the first seed."""
    return [
        HeadroomJob(tuple(tasks), seed, options, out, title=title, kind=kind)
        for seed in range(seeds)
        for title, tasks in sets.items()
        for kind in EGO_KINDS
    ]


def headroom_entry(title: str, jobs: Sequence[HeadroomJob]) -> dict[str, Any] | None:
    """Return the entry of a set of tasks in cards/adaptation.json; None before both egos of a seed are trained.

    It has the steps and the network's width of the trainings, and the mean return of each kind of ego by seed, and on
    each layout, mean over these seeds.
    """
    own = [job for job in jobs if job.title == title and job.is_finished()]
    seeds = sorted(set.intersection(*({job.seed for job in own if job.kind == kind} for kind in EGO_KINDS)))
    if not seeds:
        return None
    found = {(job.kind, job.seed): job.returns() for job in own}
    layouts = dict.fromkeys(task.layout.name for task in own[0].tasks)

    def mean(kind: str, seeds: Sequence[int], layout: str = "") -> float:
        ids = [task.task_id for task in own[0].tasks if layout in ("", task.layout.name)]
        return round(float(np.mean([[found[kind, seed][task] for task in ids] for seed in seeds])), 3)

    return {
        "tasks": title,
        "number": len(own[0].tasks),
        "steps": own[0].options.updates * own[0].options.tasks * KEPT_STEPS,
        "width": own[0].options.width,
        "returns": {kind: {str(seed): mean(kind, [seed]) for seed in seeds} for kind in EGO_KINDS},
        "layouts": {layout: {kind: mean(kind, seeds, layout) for kind in EGO_KINDS} for layout in layouts},
    }


ADAPTATION = "adaptation.json"
"""Name of the file of measured sets of tasks, in a folder of trainings and among the package's cards."""


def write_adaptation(jobs: Sequence[HeadroomJob], folder: Path) -> Path:
    """Add the measurements of finished jobs to a folder's `ADAPTATION`.

    They replace those of the same sets, unless these have more seeds.
    """
    path = folder / ADAPTATION
    known = {entry["tasks"]: entry for entry in read_adaptation(folder)}
    for title in dict.fromkeys(job.title for job in jobs):
        entry = headroom_entry(title, jobs)
        if entry and len(known.get(title, entry)["returns"]["informed"]) <= len(entry["returns"]["informed"]):
            known[title] = entry
    with atomic_write(path) as partial:
        write_json(partial, list(known.values()))
    return path


def read_adaptation(folder: Path) -> list[dict[str, Any]]:
    """Return the measured sets of tasks of a folder; none if there is no such file."""
    path = folder / ADAPTATION
    return parse_json(read_text(path)) if path.is_file() else []


def adaptation_table(folder: Path, layouts: bool = True) -> str:
    """Return a Markdown table of the measured sets: returns of both egos, and their difference with its 95 % interval.

    The interval is a Student's t interval over the training seeds; with one seed there is none. A set of several
    layouts also gets a row for each layout, unless `layouts` is False.
    """
    rows = []
    for entry in read_adaptation(folder):
        informed, episodic = (np.array([*entry["returns"][kind].values()]) for kind in EGO_KINDS)
        differences, seeds = informed - episodic, len(informed)
        interval = ""
        if seeds > 1:
            half = stats.t.ppf(0.975, seeds - 1) * differences.std(ddof=1) / np.sqrt(seeds)
            interval = f" ({differences.mean() - half:+.1f} to {differences.mean() + half:+.1f})"
        cells = [f"{informed.mean():.1f}", f"{episodic.mean():.1f}", f"{differences.mean():+.1f}{interval}"]
        training = [str(seeds), f"{entry['steps']:,}", str(entry["width"])]
        rows.append([entry["tasks"], str(entry["number"]), *cells, *training])
        for layout, of in entry["layouts"].items() if layouts and len(entry["layouts"]) > 1 else ():
            one, other = (of[kind] for kind in EGO_KINDS)
            rows.append([layout, "", f"{one:.1f}", f"{other:.1f}", f"{one - other:+.1f}", "", "", ""])
    return markdown_table(["set", "tasks", *EGO_KINDS, "difference", "seeds", "steps of each", "width"], rows, right=7)
