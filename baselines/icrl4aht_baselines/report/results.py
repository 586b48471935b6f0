"""Results of evaluation as runs of one agent, and the paper's published numbers.

Reports group results by cell, a layout and a group of teammates. The cells of the benchmark consist of the published
test tasks: ("demo_wide", "H4"). Other tasks never share a cell with those, since the paper's numbers and the headroom
do not apply to them: ("demo_wide", "H4 (validation)") are tasks of the split `validation`, "(training)" of the split
`train`, "(held out)" of the split `heldout`, and "(own)" other tasks of the split `test`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from icrl4aht_baselines.evaluate.protocols import bundled_tasks
from icrl4aht_baselines.evaluate.results import Result, read_result
from icrl4aht_baselines.report.overlap import OVERLAPS, find_overlaps
from icrl4aht_baselines.training.run_folder import read_config
from icrl4aht_baselines.training.seen import TRAINED_ON, SeenInTraining, read_trained_on
from icrl4aht_data.benchmark.facts import KEPT_STEPS, TRACKS, family_order, layout_order, track_of
from icrl4aht_data.benchmark.reference_returns import REFERENCES, Cell, has_headroom
from icrl4aht_data.benchmark.tasks import Task, read_tasks, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash, parse_json, read_text, write_json
from icrl4aht_data.utils.templates import card_file
from icrl4aht_data.utils.text import counted_noun

TEST_LAYOUTS = tuple(layout for track in TRACKS.values() for layout in track["test"])
"""Layouts that the benchmark tests on, in the paper's order."""

OWN_TASKS, TRAINED_RUN = "tasks.jsonl", "run.json"
"""Files next to results: tasks that are not among the published test tasks; settings of the evaluated model."""

PUBLISHED_PROTOCOL = "published"
"""Name of the protocol that the paper's numbers belong to."""

_GROUPS = {"validation": "validation", "train": "training", "heldout": "held out", "test": "own"}
"""Split of tasks that are not published test tasks -> name of their group in reports."""

GROUP_TEXTS = {
    "validation": "Validation tasks (split validation): training layouts with teammates that are drawn from the "
    "training ranges and are in no training history. They are for choosing models, so the returns of a model that was "
    "chosen by them are too high, and they are no test results.",
    "diverse": "Validation tasks with diverse teammates: training layouts with drawn teammates that vary in more than "
    "the published training ranges, and act unlike all test teammates. They are for choosing models, too.",
    "training": "Training tasks (split train): the teammates and layouts that models are made to be trained with. "
    "Their returns do not show generalisation.",
    "held out": "Held-out tasks (split heldout): learned teammates that a suite keeps out of its training tasks. "
    "Where an agent was trained with one of them or with others of their algorithm, its score is marked. The paper "
    "gives these as a figure without numbers (App. F).",
    "own": "Own tasks: not among the published test tasks, so the paper has no numbers of them.",
}
"""Group of tasks that are not published test tasks -> explanation."""

Returns = TypeVar("Returns", float, np.ndarray)
"""A return or several."""

_KINDS = ("test", *GROUP_TEXTS)
_ENDS = 20  # episodes at each end for the adaptation gain (paper, App. F)


class ResultSource(NamedTuple):
    """Origin of results.

    Attributes:
        folder: folder that the results were read from.
        layouts: layouts that were played.
        settings: settings of the evaluation, see `evaluate.results.Result`.
        trained: content of run.json, see `note_results`; None for an agent that was not trained here.
        tasks: cell -> the tasks that were played, in the order of the returns.
        seen: what the agent was trained on; None if that is not known.
    """

    folder: str
    layouts: tuple[str, ...]
    settings: dict[str, Any]
    trained: dict[str, Any] | None
    tasks: Mapping[Cell, tuple[Task, ...]] = MappingProxyType({})
    seen: SeenInTraining | None = None

    @property
    def acting(self) -> str:
        """Way of acting of a trained model, see `agents.egos.ACTING`; empty for other agents."""
        return self.settings.get("details", {}).get("acting", "")

    @property
    def playing(self) -> tuple[bool, bool]:
        """Whether a trained model drew its actions, and whether its memory was cleared before each episode."""
        details = self.settings.get("details", {})
        return bool(details.get("sampled")), bool(details.get("forget"))

    @property
    def encoder(self) -> str:
        """Kind of a trained model's encoder, see `methods.options.ModelOptions`; empty for other agents."""
        return self.settings.get("details", {}).get("encoder", "")

    @property
    def conditions(self) -> str:
        """Text with protocol, seeds, episodes and steps of the evaluation, and a model's way of playing."""
        protocol, seeds = self.settings["protocol"], self.settings["seeds"]
        listed, (sampled, forgets) = ", ".join(map(str, seeds)), self.playing
        return (
            f"protocol {protocol['name']}, {counted_noun(len(seeds), 'seed')} ({listed}), "
            f"{counted_noun(protocol['episodes'], 'episode')} of {counted_noun(protocol['steps'], 'step')}"
            + (f", {self.acting} acting" if self.acting else "")
            + (", sampled actions" if sampled else "")
            + (", memory cleared before each episode" if forgets else "")
        )


@dataclass(frozen=True, eq=False)
class EvaluationRun:
    """One agent's results under one protocol.

    Attributes:
        agent: name of the agent.
        protocol: name of the protocol.
        cells: cell, see the module's docstring -> returns of the team, float64 (instances, episodes), means over the
            seeds.
        variant: name and value of the varied quantity in a sweep, such as ("K", 250); None otherwise.
        note: text that distinguishes results of one agent on the same cells; usually empty.
        sources: origins of the results; each cell has one.
    """

    agent: str
    protocol: str
    cells: dict[Cell, np.ndarray]
    variant: tuple[str, Any] | None = None
    note: str = ""
    sources: tuple[ResultSource, ...] = ()

    def source(self, cell: Cell) -> ResultSource:
        """Returns the origin of a cell's results."""
        return next(source for source in self.sources if cell in source.tasks)

    def tasks(self, cell: Cell) -> tuple[Task, ...]:
        """Returns the tasks of a cell that were played."""
        return self.source(cell).tasks[cell]

    def overlaps(self, cells: Iterable[Cell]) -> tuple[str, ...]:
        """Returns the kinds of overlap between training data and the tasks of some cells, see `OVERLAPS`."""
        found = {name for cell in cells for name in find_overlaps(self.tasks(cell), self.source(cell).seen)}
        return tuple(name for name in OVERLAPS if name in found)

    def is_complete(self, cell: Cell) -> bool:
        """Returns whether all published test tasks of a cell were played, and no others."""
        return len(self.tasks(cell)) == published_instances(cell)

    def has_usual_steps(self, cell: Cell) -> bool:
        """Returns whether episodes have the benchmark's length; returns of other lengths compare with nothing."""
        return self.source(cell).settings["protocol"]["steps"] == KEPT_STEPS

    def is_like_the_papers(self, cell: Cell) -> bool:
        """Returns whether the paper's numbers of a cell are of the same tasks, protocol and episode length."""
        return self.protocol == PUBLISHED_PROTOCOL and bool(published_instances(cell)) and self.has_usual_steps(cell)

    def means(self, cell: Cell) -> np.ndarray:
        """Returns the mean return of each instance of a cell, float64 (instances,)."""
        return self.cells[cell].mean(axis=1)

    def ends(self, cell: Cell) -> np.ndarray:
        """Returns the mean returns of the first and the last 20 episodes, or of the halves if there are fewer than 40.

        Returns:
            float64 (2, instances).
        """
        returns = self.cells[cell]
        count = end_episodes(returns.shape[1])
        return np.stack([returns[:, :count].mean(axis=1), returns[:, -count:].mean(axis=1)])

    def gain(self, cell: Cell) -> float:
        """Returns the mean return of the last episodes minus that of the first (paper, App. F), see `ends`."""
        first, last = self.ends(cell)
        return float(last.mean() - first.mean())

    @cached_property
    def label(self) -> str:
        """The agent with variant and note, which distinguishes this run from others of the agent."""
        varied = "" if self.variant is None else ", {} = {}".format(*self.variant)
        return self.agent + varied + (f" [{self.note}]" if self.note else "")

    @cached_property
    def name(self) -> str:
        """The label with the protocol in parentheses."""
        return f"{self.label} ({self.protocol})"


def end_episodes(episodes: int) -> int:
    """Returns the number of episodes at each end of a task that the adaptation gain compares."""
    return max(1, min(_ENDS, episodes // 2))


def note_results(results: Path, run: Path | None = None, tasks: Sequence[Task] = ()) -> None:
    """Store the settings and tasks of results next to them, for reports.

    Args:
        results: folder of the results.
        run: run folder of the evaluated model, if it was trained here. Its path, settings, their hash and the hash of
            its data's manifest are written to run.json.
        tasks: the tasks played, if they are not the published test tasks; added to tasks.jsonl.

    Raises:
        OptionError: if `run` is not a run on learning histories.
    """
    results.mkdir(parents=True, exist_ok=True)
    if run is not None:
        config = read_config(run)
        if "histories" not in config:
            raise OptionError(f"{run}: its config.json has no `histories`: expected a run on learning histories")
        content = {
            "run": str(run.resolve()),
            "run_hash": json_hash(config),
            "manifest_sha256": config["histories"]["manifest_sha256"],
            "config": config,
        }
        with atomic_write(results / TRAINED_RUN) as partial:
            write_json(partial, content)
    if tasks:
        path = results / OWN_TASKS
        known = {task.task_id: task for task in read_tasks(path)} if path.exists() else {}
        with atomic_write(path) as partial:
            write_tasks(partial, (known | {task.task_id: task for task in tasks}).values())


def read_run(folder: Path) -> EvaluationRun:
    """Returns the results in a folder that `icrl4aht-data evaluate` made.

    Raises:
        OptionError: if there are none, if they mix settings, or if the task of one is unknown.
    """
    results = [read_result(path) for path in sorted((folder / "tasks").glob("*.json"))]
    if not results:
        raise OptionError(f"{folder}: no results in {folder / 'tasks'}; run `icrl4aht-data evaluate --out {folder}`")
    own = read_tasks(folder / OWN_TASKS) if (folder / OWN_TASKS).exists() else []
    trained = parse_json(read_text(folder / TRAINED_RUN)) if (folder / TRAINED_RUN).exists() else None
    return as_run(results, str(folder), own, trained)


def as_run(
    results: Sequence[Result], where: str = "results", tasks: Sequence[Task] = (), trained: dict[str, Any] | None = None
) -> EvaluationRun:
    """Returns the results of one agent as a run, which reports take.

    Args:
        results: results of `icrl4aht_baselines.evaluate.evaluate`, all under the same settings.
        where: folder of the results, for messages.
        tasks: the tasks that were played, if they are neither the published test tasks nor the package's validation
            tasks.
        trained: content of run.json, see `note_results`; None for an agent that was not trained here.

    Raises:
        OptionError: if the settings differ, or a result's task is neither published nor in `tasks`.
    """
    settings = results[0].settings
    if any(result.settings != settings for result in results):
        raise OptionError(f"{where}: results of different settings in one run")
    known = published_test_tasks() | {task.task_id: task for task in tasks}
    if any(result.task_id not in known for result in results):
        known = shipped_validation_tasks() | _bundled_by_id("diverse") | known
    cells: dict[Cell, list[np.ndarray]] = defaultdict(list)
    played: dict[Cell, list[Task]] = defaultdict(list)
    for result in results:
        if result.task_id not in known:
            raise OptionError(
                f"{where}: {result.task_id!r} is neither a published test task, nor a validation task of this package, "
                f"nor in the results' {OWN_TASKS}; evaluate again, or copy the manifest of the tasks to {OWN_TASKS}"
            )
        task = known[result.task_id]
        cells[cell_of(task)].append(np.mean(result.returns, axis=0))
        played[cell_of(task)].append(task)
    variant = next(iter(settings.get("details", {}).get("variant", {}).items()), None)
    arrays = {cell: np.array(cells[cell]) for cell in sorted(cells, key=cell_order)}
    layouts = tuple(dict.fromkeys(layout for layout, _ in arrays))
    of_cell = {cell: tuple(found) for cell, found in played.items()}
    seen = _find_seen(settings, trained, where)
    sources = [ResultSource(where, layouts, settings, trained, of_cell, seen.get(""))]
    if "" not in seen:  # a model for each track
        sources = [
            ResultSource(
                where, tuple(dict.fromkeys(layout for layout, _ in own)), settings, trained, own, seen.get(track)
            )
            for track in TRACKS
            if (own := {cell: found for cell, found in of_cell.items() if track_of(cell[0]) == track})
        ]
    return EvaluationRun(settings["agent"], settings["protocol"]["name"], arrays, variant, sources=tuple(sources))


def _find_seen(
    settings: dict[str, Any], trained: dict[str, Any] | None, where: str
) -> dict[str, SeenInTraining | None]:
    """Returns what an agent was trained on: nothing for reference egos, None if the results do not say.

    The key is empty, or the track for an agent with a model for each track.
    """
    details = settings.get("details", {})
    config = (trained or {}).get("config", {})
    for record in (details, config):
        entries = record.get(TRAINED_ON)
        if isinstance(entries, dict) and entries.keys() <= TRACKS.keys():
            return {track: read_trained_on(of_track, where) for track, of_track in entries.items()}
        if TRAINED_ON in record:
            return {"": read_trained_on(entries, where)}
    is_reference = settings["agent"] in REFERENCES and not details and trained is None
    return {"": SeenInTraining() if is_reference else None}


def published_test_tasks() -> dict[str, Task]:
    """Returns the 160 published test tasks by id."""
    return _bundled_by_id("test")


def shipped_validation_tasks() -> dict[str, Task]:
    """Returns the package's validation tasks with teammates of the published training ranges, by id."""
    return _bundled_by_id("validation")


@cache
def _bundled_by_id(split: str) -> dict[str, Task]:
    """Returns the package's tasks of one of `EVALUATION_SPLITS`, by id."""
    return {task.task_id: task for track in TRACKS for task in bundled_tasks(track, split)}


@cache
def _instances() -> Counter[Cell]:
    return Counter((task.layout.name, task.teammate_family) for task in published_test_tasks().values())


def published_instances(cell: Cell) -> int:
    """Returns the number of published test tasks of a cell; 0 for cells of other tasks."""
    return _instances()[cell]


def cell_of(task: Task) -> Cell:
    """Returns the cell of a task, see the module's docstring."""
    if task.task_id in published_test_tasks():
        return task.layout.name, task.teammate_family
    group = "diverse" if task.task_id in _bundled_by_id("diverse") else _GROUPS[task.split]
    return task.layout.name, f"{task.teammate_family} ({group})"


def instances_text(cell: Cell, played: int) -> str:
    """Returns the number of instances, such as "1 of 5 instances", or "1 instance" for tasks that are not published."""
    total = published_instances(cell)
    return f"{played} of {counted_noun(total, 'instance')}" if total else counted_noun(played, "instance")


def instances_range(numbers: Iterable[int]) -> str:
    """Returns numbers of instances as text, such as "5 instances" or "1 to 5 instances"."""
    found = sorted(set(numbers))
    return counted_noun(found[0], "instance") if len(found) == 1 else f"{found[0]} to {found[-1]} instances"


def merge(runs: Sequence[EvaluationRun]) -> list[EvaluationRun]:
    """Returns the runs with those of one agent on different cells, such as models of each layout, merged into one run.

    Runs that played the same cell, or under other rules or seeds, are not merged; the `note` of the later ones is their
    folder.
    """
    merged: list[EvaluationRun] = []
    for run in runs:
        same = [k for k, other in enumerate(merged) if other.name == run.name]
        fitting = [
            k for k in same if _rules(merged[k]) == _rules(run) and not merged[k].cells.keys() & run.cells.keys()
        ]
        if fitting:
            other = merged[fitting[0]]
            cells = other.cells | run.cells
            ordered = {cell: cells[cell] for cell in sorted(cells, key=cell_order)}
            merged[fitting[0]] = replace(other, cells=ordered, sources=other.sources + run.sources)
        else:
            merged.append(replace(run, note=run.sources[0].folder) if same else run)
    return merged


def _rules(run: EvaluationRun) -> tuple[Any, ...]:
    """Returns what merged results must agree in: protocol, seeds, way of playing, and encoder."""
    source = run.sources[0]
    return source.settings["protocol"], source.settings["seeds"], source.acting, source.playing, source.encoder


def cell_order(cell: Cell) -> tuple[tuple[int, str], tuple[int, str], str]:
    """Returns the sort key of a cell in the paper's order."""
    return layout_order(cell[0]), family_order(family_of(cell)), cell[1]


def group_title(group: str) -> str:
    """Returns a group of teammates as people read it: learned teammates, family "rl", are called "learned"."""
    family, space, kind = group.partition(" ")
    return f"{'learned' if family == 'rl' else family}{space}{kind}"


def family_of(cell: Cell) -> str:
    """Returns the teammate family of a cell."""
    return cell[1].partition(" ")[0]


def group_of(cell: Cell) -> str:
    """Returns the kind of a cell's tasks: "test" for published test tasks, otherwise one of `GROUP_TEXTS`."""
    return cell[1].partition(" (")[2].removesuffix(")") or "test"


def split_cells(cells: Iterable[Cell], most: int) -> list[list[Cell]]:
    """Returns cells in lists of at most `most`, such as for pictures, in the paper's order.

    A list has one kind of tasks, and all cells of a layout unless these are more than `most`.
    """
    by_layout: dict[tuple[str, str], list[Cell]] = {}
    for cell in sorted(cells, key=cell_order):
        by_layout.setdefault((group_of(cell), cell[0]), []).append(cell)
    split: list[list[Cell]] = []
    for (kind, _), of_layout in sorted(by_layout.items(), key=lambda found: _KINDS.index(found[0][0])):
        for start in range(0, len(of_layout), most):
            part = of_layout[start : start + most]
            if split and group_of(split[-1][0]) == kind and len(split[-1]) + len(part) <= most:
                split[-1] += part
            else:
                split.append(part)
    return split


def groups_of(cells: Iterable[Cell]) -> list[str]:
    """Returns the groups of teammates of cells, such as "H4" and "H4 (training)", in the paper's order."""
    return list(dict.fromkeys(group for _, group in sorted(cells, key=lambda cell: cell_order(cell)[1:])))


@cache
def read_published() -> dict[str, Any]:
    """Returns the paper's numbers, each part with its source, from cards/published.json."""
    return parse_json(read_text(card_file("published.json")))


def published_cells(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Returns layout -> family or "Average" -> published mean and std; empty for an agent that is not in the paper."""
    return read_published()["methods"].get(agent, {})


def normalise(returns: Returns, references: Mapping[str, float]) -> Returns:
    """Returns (return - stay) / (oracle - stay).

    Args:
        returns: a return, or float64 (U,), in a cell with headroom.
        references: reference ego -> its mean return in the cell.
    """
    return (returns - references["stay"]) / (references["oracle"] - references["stay"])


def normalized_return(mean: float, references: Mapping[str, float] | None) -> float | None:
    """Returns the normalised mean return of a cell, or None if the cell has no headroom or was not measured.

    Args:
        mean: mean return of a cell.
        references: reference ego -> its mean return in the cell.
    """
    if references is None or not has_headroom(references):
        return None
    return normalise(mean, references)


def normalised_score(run: EvaluationRun, cell: Cell, headroom: Mapping[Cell, Mapping[str, float]]) -> float | None:
    """Returns the normalised return of a cell of a run, see `normalized_return`.

    None also if the results are not of the tasks and the episode length that the references were measured with.

    Args:
        run: results.
        cell: one of the run's cells.
        headroom: cell -> reference ego -> its mean return.
    """
    if not run.is_complete(cell) or not run.has_usual_steps(cell):
        return None
    return normalized_return(float(run.means(cell).mean()), headroom.get(cell))
