"""Results of evaluations as one tidy table.

A table of results is a data frame with a row for each task, seed and block of episodes:

    agent, training         name of the agent; number of its training run, if there are several with different seeds
    protocol, control       name of the protocol; control, one of `protocols.CONTROLS`, or empty
    layout, family, kind    result cell of the task, see `ResultCell`
    overlap                 overlaps of training data and the cell's tasks, see `seen.OVERLAPS`
    task, seed              label of the task, see `task_label`; seed of the episodes
    block, return           block of episodes, one of `BLOCKS`; mean return of the team in the block

A result cell never mixes test tasks with other kinds of tasks, since the paper's numbers are of the test tasks.

Shapes: T training runs, U tasks of a cell, S seeds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from icrl4aht_baselines.agents.egos import AGENTS, NamedEgo
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import CONTROLS, EVALUATION_SPLITS, Protocol, bundled_tasks
from icrl4aht_baselines.evaluate.results import RESULTS, Result, read_result
from icrl4aht_baselines.training.run_folder import read_config
from icrl4aht_baselines.training.seen import (
    TRAINED_ON,
    SeenInTraining,
    find_overlaps,
    parse_training_record,
    sorted_overlaps,
)
from icrl4aht_data.benchmark.facts import KEPT_STEPS, PREFERENCE, TRACKS, family_sort_key, layout_sort_key, layout_track
from icrl4aht_data.benchmark.tasks import Task, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.layouts_file import LAYOUTS_NAME, read_tasks_and_layouts, write_layouts_file
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import json_hash, read_json, write_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.progress import bar_updater
from icrl4aht_data.utils.text import counted_noun

TEST_LAYOUTS = tuple(layout for track in TRACKS.values() for layout in track["test"])
"""Names of the benchmark's test layouts, in the paper's order."""

OWN_TASKS, TRAINED_RUN = "tasks.jsonl", "run.json"
"""Files in a folder of results: tasks that are not published test tasks, and settings of the evaluated model."""

PUBLISHED_PROTOCOL = "published"
"""Name of the protocol that the paper's numbers belong to."""

BLOCKS = {"all": (0, None), "1": (0, 1), "2-5": (1, 5), "6-20": (5, 20), "21-100": (20, 100), "last 20": (-20, None)}
"""Name of a block -> its slice of a task's episodes. Results have only blocks with at least one played episode."""

EPISODE_BLOCKS = ("1", "2-5", "6-20", "21-100")
"""Names of the blocks that tables show in columns."""

CELL_COLUMNS = ["layout", "family", "kind"]
AGENT_COLUMNS = ["agent", "training", "protocol", "control"]
TABLE_COLUMNS = [*AGENT_COLUMNS, *CELL_COLUMNS, "overlap", "task", "seed", "block", "return"]

TASK_KINDS = {
    "test": "",
    "validation": "Validation tasks: training layouts with drawn teammates that are in no training history. Models are "
    "chosen by them, so their returns are no test results.",
    "diverse": "Validation tasks with diverse teammates, which vary in more than the published training ranges. Models "
    "are chosen by them, too.",
    "training": "Training tasks (split train): the teammates and layouts that models are made to be trained with. "
    "Their returns do not show generalization.",
    "held out": "Held-out tasks: learned teammates that a suite keeps out of its training tasks. Where an agent was "
    "trained with one of them or with others of their algorithm, its score is marked (paper, App. F).",
    PREFERENCE: "Tasks of the track preference, which is this project's own, not the paper's.",
    "own": "Own tasks: not among the published test tasks, so the paper has no numbers of them.",
}
"""Kind of tasks -> explanation for reports; "test" means the published test tasks, which need none."""

_KIND_OF_SPLIT = {"validation": "validation", "train": "training", "heldout": "held out", "test": "own"}


class ResultCell(NamedTuple):
    """A group of tasks with the same layout, teammate family and kind of task.

    Reports average returns over each group.

    Attributes:
        layout: name of the layout.
        family: family of the teammates.
        kind: kind of the tasks, one of `TASK_KINDS`.
    """

    layout: str
    family: str
    kind: str = "test"

    @property
    def title(self) -> str:
        """Title in reports, such as "demo_wide, H4" or "demo_wide, learned (validation)"."""
        return f"{self.layout}, {family_title(self.family)}{'' if self.kind == 'test' else f' ({self.kind})'}"

    @property
    def order(self) -> tuple[Any, ...]:
        """Sort key that orders layouts and families as in the paper."""
        return layout_sort_key(self.layout), family_sort_key(self.family), list(TASK_KINDS).index(self.kind)


class CellReturns(NamedTuple):
    """Returns of an agent in one result cell.

    Attributes:
        tasks: labels of the tasks, see `task_label`.
        seeds: seeds of the episodes.
        blocks: block of episodes, see `BLOCKS` -> mean returns, float64 of shape (T, U, S).
        overlaps: kinds of overlap of the tasks with the training data.
        trainings: numbers of the agent's training runs.
    """

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    blocks: Mapping[str, np.ndarray]
    overlaps: tuple[str, ...] = ()
    trainings: tuple[int, ...] = (0,)

    @property
    def mean(self) -> np.ndarray:
        """Mean returns over all episodes and training runs, float64 of shape (U, S)."""
        return self.blocks["all"].mean(axis=0)


def mean_over_cells(cells: Iterable[np.ndarray]) -> float:
    """Return the mean of the means of several result cells."""
    return float(np.mean([values.mean() for values in cells]))


AgentReturns = Mapping[ResultCell, CellReturns]
"""Result cell -> returns of an agent under one protocol."""


def returns_by_cell(table: pd.DataFrame) -> dict[ResultCell, CellReturns]:
    """Return the returns in each result cell, in the paper's order, from a table of one agent, control and protocol."""
    found = {}
    for key, rows in table.groupby(CELL_COLUMNS, sort=False):
        codes, axes = zip(*(pd.factorize(rows[name]) for name in ("training", "task", "seed", "block")), strict=True)
        values = np.full([len(axis) for axis in axes], np.nan)
        values[codes] = rows["return"]
        blocks = {str(name): values[..., number] for number, name in enumerate(axes[3])}
        overlaps = sorted_overlaps(" ".join(rows["overlap"].unique()).split())
        cell = ResultCell._make(map(str, key))
        if np.isnan(values).any():
            raise OptionError(
                f"{cell.title}: training runs differ in tasks, seeds or episodes; evaluate all runs alike"
            )
        trainings, seeds = (tuple(map(int, axes[number])) for number in (0, 2))
        found[cell] = CellReturns(tuple(axes[1]), seeds, blocks, overlaps, trainings)
    return {cell: found[cell] for cell in sorted_cells(found)}


def task_label(task_id: str) -> str:
    """Return a task's label: the teammate's number and the hash of the task id, such as "t0-9bc579c9"."""
    _, number, _, digest = task_id.rsplit("_", 3)
    return f"{number}-{digest}"


class ResultSource(NamedTuple):
    """Origin of results: folder, settings, tasks, and training data of the agent.

    Attributes:
        folder: folder that the results were read from.
        settings: settings of the evaluation, see `evaluate.results.Result`.
        trained: content of run.json, see `write_run_and_tasks`; None for an agent without a run folder.
        tasks: result cell -> evaluated tasks, in the order of the returns.
        seen: layouts and teammates in the agent's training; None if they are not known.
    """

    folder: str
    settings: dict[str, Any]
    trained: dict[str, Any] | None
    tasks: Mapping[ResultCell, tuple[Task, ...]]
    seen: SeenInTraining | None

    @property
    def layouts(self) -> tuple[str, ...]:
        """Names of the evaluated layouts."""
        return tuple(dict.fromkeys(cell.layout for cell in self.tasks))

    def detail(self, name: str) -> Any:
        """Return an entry of the agent's `details`, such as `encoder`; an empty string if there is no such entry."""
        return self.settings.get("details", {}).get(name, "")

    @property
    def conditions(self) -> str:
        """Text with protocol, seeds, episodes and steps of the evaluation, and the play mode of a model."""
        protocol, seeds = self.settings["protocol"], self.settings["seeds"]
        listed = ", ".join(map(str, seeds))
        if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[0] + len(seeds))):
            listed = f"{seeds[0]} to {seeds[-1]}"
        return (
            f"protocol {protocol['name']}, {counted_noun(len(seeds), 'seed')} ({listed}), "
            f"{counted_noun(protocol['episodes'], 'episode')} of {counted_noun(protocol['steps'], 'step')}"
            + (f", {self.detail('acting')} acting" if self.detail("acting") else "")
            + (", sampled actions" if self.detail("sampled") else "")
            + (", memory cleared before each episode" if self.detail("forget") else "")
        )


@dataclass(frozen=True, eq=False)
class EvaluationRun:
    """Results of one agent under one protocol.

    Attributes:
        agent: name of the agent.
        protocol: name of the protocol.
        table: results as a table; its columns are described at the top of this module.
        cells: `ResultCell` -> returns averaged over seeds, float64 of shape (tasks, episodes); layouts are in the
            paper's order.
        note: text that distinguishes several results of one agent in the same result cells; usually empty.
        sources: origins of the results; each result cell has one origin.
    """

    agent: str
    protocol: str
    table: pd.DataFrame
    cells: dict[ResultCell, np.ndarray]
    note: str = ""
    sources: tuple[ResultSource, ...] = ()

    def source(self, cell: ResultCell) -> ResultSource:
        """Return the origin of the results in a result cell."""
        return next(source for source in self.sources if cell in source.tasks)

    def tasks(self, cell: ResultCell) -> tuple[Task, ...]:
        """Return the evaluated tasks of a result cell."""
        return self.source(cell).tasks[cell]

    def overlaps(self, cells: Iterable[ResultCell]) -> tuple[str, ...]:
        """Return the kinds of overlap between training data and the tasks of result cells, see `seen.OVERLAPS`."""
        return sorted_overlaps(name for cell in cells for name in self.returns[cell].overlaps)

    @cached_property
    def returns(self) -> dict[ResultCell, CellReturns]:
        """Returns of the agent in each result cell, that is, on each layout with each family of teammates."""
        return returns_by_cell(self.table)

    def has_full_length(self, cell: ResultCell) -> bool:
        """Return whether the episodes in a result cell have the benchmark's length."""
        return self.source(cell).settings["protocol"]["steps"] == KEPT_STEPS

    @property
    def label(self) -> str:
        """Name of the agent in reports, followed by the note if there is one."""
        return f"{self.agent} [{self.note}]" if self.note else self.agent


def episode_blocks(returns: np.ndarray) -> dict[str, np.ndarray]:
    """Return the mean return in each block of episodes, by block name, from returns of shape (..., episodes)."""
    episodes = returns.shape[-1]
    return {
        name: returns[..., start:stop].mean(axis=-1) for name, (start, stop) in BLOCKS.items() if episodes > abs(start)
    }


def write_run_and_tasks(results: Path, run: Path | None = None, tasks: Sequence[Task] = ()) -> None:
    """Store the model's settings and the evaluated tasks in a folder of results, for reports.

    Args:
        results: folder of the results.
        run: run folder of the evaluated model, or None. Its path, settings, their hash and the hash of the data's
            manifest are written to run.json.
        tasks: evaluated tasks; those that are not published test tasks are added to tasks.jsonl.
    """
    results.mkdir(parents=True, exist_ok=True)
    if run is not None:
        config = read_config(run)
        content = {
            "run": str(run.resolve()),
            "run_hash": json_hash(config),
            "manifest_sha256": config["histories"]["manifest_sha256"],
            "config": config,
        }
        write_json(results / TRAINED_RUN, content)
    own = {task.task_id: task for task in tasks if task.task_id not in bundled_tasks_by_id("test")}
    if own:
        path = results / OWN_TASKS
        known = {task.task_id: task for task in read_tasks_and_layouts(path)} if path.exists() else {}
        noted = [*(known | own).values()]
        write_layouts_file(results / LAYOUTS_NAME, [get_layout(task.layout_name) for task in noted])
        write_tasks(path, noted)


def evaluate_agent(
    agent: NamedEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    out: Path,
    *,
    seeds: Sequence[int] = (0,),
    show: Callable[..., None] | None = None,
    what: str = "",
    **options: Any,
) -> EvaluationRun:
    """Evaluate an agent, store the results in a folder with all that reports need, and return them.

    Args:
        agent, tasks, protocol, seeds, options: see `evaluate`.
        out: folder of the results.
        show: function for progress, called with (`what`, episodes played, number of episodes); by default, a progress
            bar is shown.
        what: description for `show`.
    """
    played = show and bar_updater(show, what, len(tasks) * len(seeds) * protocol.episodes)
    shared: Any = {"seeds": seeds, "out": out, "details": agent.details, "played": played}
    evaluate(agent.name, agent.make, tasks, protocol, **shared, **options)
    write_run_and_tasks(out, agent.run, tasks)
    return read_run(out)


def read_results(folder: Path) -> list[Result]:
    """Return the results in a folder that `icrl4aht-data evaluate` made.

    Raises:
        OptionError: if the folder has no results.
    """
    results = [read_result(path) for path in sorted((folder / RESULTS).glob("*.json"))]
    if not results:
        raise OptionError(f"{folder}: no results in {folder / RESULTS}; run `icrl4aht-data evaluate --out {folder}`")
    return results


def read_run(folder: Path) -> EvaluationRun:
    """Return the results in a folder as an `EvaluationRun`.

    Raises:
        OptionError: if the folder has no results, the results have different settings, or a task is unknown.
    """
    own = read_tasks_and_layouts(folder / OWN_TASKS) if (folder / OWN_TASKS).exists() else []
    trained = read_json(folder / TRAINED_RUN) if (folder / TRAINED_RUN).exists() else None
    return as_run(read_results(folder), str(folder), own, trained)


def as_run(
    results: Sequence[Result], where: str = "results", tasks: Sequence[Task] = (), trained: dict[str, Any] | None = None
) -> EvaluationRun:
    """Return the results of one agent as an `EvaluationRun`, which the functions for reports take.

    Args:
        results: results of `icrl4aht_baselines.evaluate.evaluate`, all under the same settings.
        where: folder of the results, for messages.
        tasks: evaluated tasks that are neither published test tasks nor the package's validation tasks.
        trained: content of run.json, see `write_run_and_tasks`; None for an agent without a run folder.

    Raises:
        OptionError: if the settings differ, or a task is neither in the package nor in `tasks`.
    """
    settings = results[0].settings
    if any(result.settings != settings for result in results):
        raise OptionError(f"{where}: expected results with equal settings, found different settings; evaluate again")
    known = {key: task for split in EVALUATION_SPLITS for key, task in bundled_tasks_by_id(split).items()}
    known |= {task.task_id: task for task in tasks}
    if missing := [result.task_id for result in results if result.task_id not in known]:
        raise OptionError(
            f"{where}: {missing[0]!r} is neither a published test task, nor a validation task of this package, nor in "
            f"the results' {OWN_TASKS}; evaluate again, or copy the manifest of the tasks to {OWN_TASKS}"
        )
    played = grouped(results, lambda result: cell_of(known[result.task_id]))
    seen = find_training_record(settings, where)
    agent, seeds = (settings["agent"], settings["protocol"]["name"]), settings["seeds"]
    details = settings.get("details", {})
    control = next((name for name, mark in CONTROLS.items() if details.get(mark)), "")
    rows, cells, tracks = [], {}, defaultdict(dict)
    for cell in sorted_cells(played):
        of_cell = tuple(known[result.task_id] for result in played[cell])
        track = "" if "" in seen else layout_track(cell.layout)
        returns = np.array([result.returns for result in played[cell]], np.float64)  # (tasks, seeds, episodes)
        cells[cell], tracks[track][cell] = returns.mean(axis=1), of_cell
        overlaps, names = find_overlaps(of_cell, seen[track]), [task_label(task.task_id) for task in of_cell]
        rows += [
            (agent[0], 0, agent[1], control, *cell, " ".join(overlaps), name, seed, block, value)
            for block, values in episode_blocks(returns).items()
            for name, of_task in zip(names, values.tolist(), strict=True)
            for seed, value in zip(seeds, of_task, strict=True)
        ]
    sources = tuple(ResultSource(where, settings, trained, own, seen[track]) for track, own in tracks.items())
    return EvaluationRun(*agent, pd.DataFrame(rows, columns=TABLE_COLUMNS), cells, sources=sources)


def find_training_record(settings: dict[str, Any], where: str) -> dict[str, SeenInTraining | None]:
    """Return the layouts and teammates in an agent's training, by track; None where the results do not state them.

    The only key is "", unless the agent has a separate model for each track. Reference egos have an empty record.
    """
    details = settings.get("details", {})
    if TRAINED_ON not in details:
        return {"": SeenInTraining() if settings["agent"] in AGENTS and not details else None}
    entries = details[TRAINED_ON]
    if isinstance(entries, dict) and entries.keys() <= TRACKS.keys():
        return {track: parse_training_record(entries[track], where) if track in entries else None for track in TRACKS}
    return {"": parse_training_record(entries, where)}


def merge(runs: Sequence[EvaluationRun]) -> list[EvaluationRun]:
    """Merge runs of one agent under one protocol that cover disjoint result cells, such as runs on single layouts.

    Runs that overlap, or differ in rules, seeds, play mode or encoder, stay separate; later runs get their
    folder as `note`.
    """
    merged: list[EvaluationRun] = []
    for run in runs:
        same = [other for other in merged if (other.label, other.protocol) == (run.label, run.protocol)]
        fitting = (other for other in same if _rule_key(other) == _rule_key(run))
        other = next((other for other in fitting if other.cells.keys().isdisjoint(run.cells)), None)
        if other is None:
            merged.append(replace(run, note=run.sources[0].folder) if same else run)
            continue
        both = other.cells | run.cells
        cells = {cell: both[cell] for cell in sorted_cells(both)}
        table, sources = pd.concat([other.table, run.table], ignore_index=True), other.sources + run.sources
        merged[merged.index(other)] = replace(other, table=table, cells=cells, sources=sources)
    return merged


def _rule_key(run: EvaluationRun) -> tuple[Any, ...]:
    """Return the settings that must be equal in merged runs: protocol, seeds, play mode, and encoder."""
    source = run.sources[0]
    playing = [source.detail(name) or False for name in ("acting", "sampled", "forget", "encoder")]
    return source.settings["protocol"], source.settings["seeds"], playing


@cache
def bundled_tasks_by_id(split: str, tracks: tuple[str, ...] = tuple(TRACKS)) -> dict[str, Task]:
    """Return the tasks of a split by task id, by default of both benchmark tracks (160 published tasks in "test")."""
    return {task.task_id: task for track in tracks for task in bundled_tasks(track, split)}


def cell_of(task: Task) -> ResultCell:
    """Return the result cell that a task belongs to."""
    kind = _KIND_OF_SPLIT[task.split]
    if task.track == PREFERENCE and task.split == "test":
        kind = PREFERENCE
    elif task.task_id in bundled_tasks_by_id("test"):
        kind = "test"
    elif task.task_id in bundled_tasks_by_id("diverse"):
        kind = "diverse"
    return ResultCell(task.layout.name, task.teammate_family, kind)


def sorted_cells(cells: Iterable[ResultCell]) -> list[ResultCell]:
    """Return result cells in the paper's order, without repetitions."""
    return sorted(set(cells), key=lambda cell: cell.order)


def family_title(family: str) -> str:
    """Return the name of a teammate family in reports, which is "learned" for `rl`."""
    return "learned" if family == "rl" else family
