"""Adaptation headroom: how much more an ego earns if it knows the teammate from the start.

Two recurrent egos are trained on the same tasks with the same budget, and both have their memory cleared before each
episode. They are the informed and the episodic ego of `icrl4aht_data.benchmark.adaptation`. Their difference estimates
how much memory across episodes can raise the return. It is an estimate, because longer training would raise both
returns. On the track `preference`, reference egos also play the tasks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.teammates.registry import build_teammate, with_equal_parameter_names
from scipy import stats

from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import bundled_tasks
from icrl4aht_baselines.online.responses import PROTOCOL, EgoJob, choose_best_response, stored_responses
from icrl4aht_baselines.online.rl2 import PlayTask
from icrl4aht_baselines.training.options import ResponseOptions
from icrl4aht_data.benchmark.adaptation import ADAPTATION, EGO_KINDS, SCRIPTS, adaptation_table, read_adaptation
from icrl4aht_data.benchmark.best_responses import BestResponse, TrainingRun
from icrl4aht_data.benchmark.facts import PREFERENCE
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import json_hash, write_atomically, write_json
from icrl4aht_data.utils.groups import grouped

MEASURED_EPISODES = 100
"""Number of episodes over which the mean return of a trained ego is measured, for each parallel copy of a task."""

_MEASURE_SEED = 1_000


@dataclass(frozen=True, kw_only=True)
class AdaptationJob(EgoJob):
    """Job that trains an informed or episodic ego on a set of tasks, or takes a script, and measures its returns.

    Attributes:
        title: name of the set of tasks.
        kind: kind of the ego, "informed" or "episodic", or one of `SCRIPTS`.
        suite: folder of the learned teammates' checkpoints, see `build_teammate`.

    Raises:
        OptionError: if the set has more tasks than are played in parallel.
    """

    title: str
    kind: str
    suite: Path | None = None

    def __post_init__(self) -> None:
        if self.kind in EGO_KINDS and len(self.tasks) > self.options.tasks:
            raise OptionError(
                f"tasks = {self.options.tasks}: {self.title} has {len(self.tasks)} tasks, and all must be played; "
                f"give --tasks {len(self.tasks)} or more"
            )

    @property
    def name(self) -> str:
        """Name of the job's folder: set of tasks, kind of ego, width, steps and seed."""
        return f"{self.title}-{self.kind}-{self.name_suffix}"

    @property
    def label(self) -> str:
        """Name of the job for progress displays: set of tasks, kind of ego and seed."""
        return f"{self.title}, {self.kind}, seed {self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON."""
        tasks = json_hash([task.task_id for task in self.tasks])
        return {"tasks_hash": tasks, "kind": self.kind, **super().settings}

    @property
    def is_quick(self) -> bool:
        """Whether the job takes only seconds: scripts are not trained."""
        return self.kind in SCRIPTS

    @property
    def updates(self) -> int:
        """Number of training steps; 1 for a script."""
        return 1 if self.kind in SCRIPTS else super().updates

    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Train the ego, unless it is a script, and evaluate it.

        Return {"returns": task id -> mean return in new episodes}. A trained ego samples its actions.
        """
        if self.kind in SCRIPTS:
            ego = find_agent(self.kind).make
            results = evaluate(self.kind, ego, self.tasks, PROTOCOL, seeds=(self.seed,), played=lambda count: None)
            return {"returns": {one.task_id: round(float(np.mean(one.returns)), 3) for one in results}}
        trainer, params = self.train(self._parallel_tasks(), on_update)
        returns = trainer.measure(params, MEASURED_EPISODES, _MEASURE_SEED).mean(axis=1)
        ids = np.array([task.id for task in trainer.tasks])
        return {"returns": {one.task_id: round(float(returns[ids == one.task_id].mean()), 3) for one in self.tasks}}

    def _parallel_tasks(self) -> list[PlayTask]:
        """Return the tasks that are played in parallel, in which each of `tasks` appears about equally often."""
        of_kind = grouped(self.tasks, lambda task: task.teammate_kind)
        several = {kind for kind, own in of_kind.items() if len({task.layout for task in own}) > 1}
        different, entries = [], with_equal_parameter_names([task.teammate for task in self.tasks])
        for number, (task, entry) in enumerate(zip(self.tasks, entries, strict=True)):
            kind, partner = task.teammate_kind, number if self.kind == "informed" else None
            # Heuristics of a kind that plays on several layouts are built without a layout, to share one program.
            mate = build_teammate(None if kind in several else task.layout, entry, suite=self.suite)
            different.append(PlayTask(task.layout, kind, mate, False, self.title, partner, task.task_id))
        return [different[played % len(different)] for played in range(self.options.tasks)]


def cross_dishes(tasks: Sequence[Task]) -> list[Task]:
    """Return tasks in which each teammate on a layout wants each dish that one of the layout's tasks has.

    In the tasks of the track `preference` a teammate wants a single dish. An ego that is trained on few such tasks can
    tell the dish from how the teammate moves, which does not help with other teammates.
    """
    crossed = []
    for own in grouped(tasks, lambda task: task.layout_name).values():
        different = {json_hash(task.teammate): task for task in own}
        dishes = dict.fromkeys(task.recipes for task in own)
        crossed += [
            make_task(task.track, task.split, task.layout_name, task.teammate, task.seed, dish)
            for task in different.values()
            for dish in dishes
        ]
    return crossed


def adaptation_jobs(
    sets: Mapping[str, Sequence[Task]], seeds: int, options: ResponseOptions, out: Path, suite: Path | None = None
) -> list[AdaptationJob]:
    """Return a job for each seed, set of tasks (name -> tasks) and kind of ego, in this order, and those of scripts.

    Tasks of the track `preference` are replaced by those of `cross_dishes`. Each script plays them all in one job, with
    seed 0, because a script's program is compiled for the layouts that it plays.
    """
    own = {title: cross_dishes(of) if of[0].track == PREFERENCE else of for title, of in sets.items()}
    scripted = tuple(task for tasks in own.values() for task in tasks if task.track == PREFERENCE)
    scripts = [AdaptationJob(scripted, 0, options, out, title=PREFERENCE, kind=kind) for kind in SCRIPTS]
    return [
        AdaptationJob(tuple(tasks), seed, options, out, title=title, kind=kind, suite=suite)
        for seed in range(seeds)
        for title, tasks in own.items()
        for kind in EGO_KINDS
    ] + (scripts if scripted else [])


def adaptation_entry(title: str, jobs: Sequence[AdaptationJob]) -> dict[str, Any] | None:
    """Return the entry of a set of tasks for cards/adaptation.json; None if no seed has finished jobs of both kinds.

    An entry has the training steps, the width of the network, and the mean return of each kind of ego for each seed. If
    there are several seeds, "interval" is a 95 % Student's t interval over the seeds of the difference between the two
    kinds. If all scripts have played the tasks, "scripts" has their mean returns.
    """
    own = [job for job in jobs if job.title == title and job.kind in EGO_KINDS and job.is_finished()]
    seeds = sorted(set.intersection(*({job.seed for job in own if job.kind == kind} for kind in EGO_KINDS)))
    if not seeds:
        return None
    found = {(job.kind, job.seed): job.result()["returns"] for job in own}
    scripts = {job.kind: job.result()["returns"] for job in jobs if job.kind in SCRIPTS and job.is_finished()}
    if len(scripts) < len(SCRIPTS) or any(task.task_id not in scripts["stay"] for task in own[0].tasks):
        scripts = {}

    def mean(returns: Mapping[str, float]) -> float:
        return round(float(np.mean([returns[task.task_id] for task in own[0].tasks])), 3)

    returns = {kind: {str(seed): mean(found[kind, seed]) for seed in seeds} for kind in EGO_KINDS}
    return {
        "tasks": title,
        "number": len(own[0].tasks),
        "steps": own[0].options.played_steps,
        "width": own[0].options.width,
        "returns": returns,
        "interval": _seed_interval(returns),
        **({"scripts": {name: mean(of) for name, of in scripts.items()}} if scripts else {}),
    }


def _seed_interval(returns: Mapping[str, Mapping[str, float]]) -> list[float] | None:
    """Return the 95 % interval of informed minus episodic returns over seeds; None if there is only one seed.

    Args:
        returns: kind of ego -> seed -> mean return.
    """
    informed, episodic = (np.array([*returns[kind].values()]) for kind in EGO_KINDS)
    if len(informed) < 2:
        return None
    differences = informed - episodic
    half = stats.t.ppf(0.975, len(differences) - 1) * stats.sem(differences)
    return [round(float(differences.mean() + side * half), 3) for side in (-1, 1)]


def _with_stored_seeds(entry: dict[str, Any], stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a new entry together with the stored entry's other seeds.

    If the number of tasks, the steps or the widths differ, return the entry with more seeds, or the new one if both
    have the same number of seeds.
    """
    if any(entry[name] != stored[name] for name in ("number", "steps", "width")):
        return entry if len(entry["returns"]["informed"]) >= len(stored["returns"]["informed"]) else dict(stored)
    merged = {kind: {**stored["returns"][kind], **entry["returns"][kind]} for kind in EGO_KINDS}
    returns = {kind: dict(sorted(of.items(), key=lambda seed: int(seed[0]))) for kind, of in merged.items()}
    return {**stored, **entry, "returns": returns, "interval": _seed_interval(returns)}


def write_adaptation(jobs: Sequence[AdaptationJob], folder: Path) -> Path:
    """Add the measurements of finished jobs to a folder's file `ADAPTATION`. Return the file's path.

    Stored returns of other seeds are kept if the number of tasks, the steps and the width are equal. Otherwise the
    entry with more seeds is kept. A Markdown file of the same name gets a table of all entries.
    """
    path = folder / ADAPTATION
    known = {entry["tasks"]: entry for entry in read_adaptation(folder)}
    for title in dict.fromkeys(job.title for job in jobs if job.kind in EGO_KINDS):
        if entry := adaptation_entry(title, jobs):
            known[title] = _with_stored_seeds(entry, known.get(title, entry))
    write_json(path, list(known.values()))
    write_atomically(path.with_suffix(".md"), f"# Adaptation headroom\n\n{adaptation_table(known.values())}\n")
    return path


def informed_responses(jobs: Sequence[AdaptationJob], folder: Path) -> list[BestResponse]:
    """Return the informed egos of finished jobs as best responses, one for each test task of the track `preference`.

    Jobs that lack some test tasks of their layout are left out. Earlier runs in the folder's best responses are kept.
    """
    tested = grouped(bundled_tasks(PREFERENCE, "test"), lambda task: task.layout_name)
    known = {one.tasks: one.seeds for one in stored_responses(folder)}
    found: dict[str, BestResponse] = {}
    for job in (job for job in jobs if job.kind == "informed" and job.is_finished()):
        tasks, returns = tested.get(job.tasks[0].layout_name, []), job.result()["returns"]
        if job.tasks[0].track != PREFERENCE or any(task.task_id not in returns for task in tasks):
            continue
        steps, width = job.options.played_steps, job.options.width
        for task in tasks:
            name = task.task_id
            run = TrainingRun(job.seed, steps, returns[name], width, acting="sampled", tasks=len(job.tasks))
            earlier = found[name].seeds if name in found else known.get((name,), ())
            found[name] = choose_best_response([task], [*earlier, run])
    return list(found.values())
