"""Results of evaluation as runs of one agent, and the paper's published numbers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from baselines.evaluate.results import Result, read_result
from baselines.training.run_folder import read_config
from icrl4aht_data.benchmark.facts import FAMILIES, LAYOUT_NAMES, TRACKS
from icrl4aht_data.benchmark.reference_returns import Cell, has_headroom
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash, parse_json, read_text, write_json
from icrl4aht_data.utils.templates import card_file

TEST_LAYOUTS = tuple(layout for track in TRACKS.values() for layout in track["test"])
"""Layouts that the benchmark tests on, in the paper's order."""

OWN_TASKS, TRAINED_RUN = "tasks.jsonl", "run.json"
"""Files next to results: tasks that are not among the published ones; settings of the evaluated model."""

_ENDS = 20  # episodes at each end for the adaptation gain (paper, App. F)


class ResultSource(NamedTuple):
    """Origin of results.

    Attributes:
        folder: folder that the results were read from.
        layouts: layouts that were played.
        settings: settings of the evaluation, see `evaluate.results.Result`.
        trained: content of run.json, see `note_results`; None for an agent that was not trained here.
        tasks: cell -> the first task of the cell that was played.
    """

    folder: str
    layouts: tuple[str, ...]
    settings: dict[str, Any]
    trained: dict[str, Any] | None
    tasks: Mapping[Cell, Task] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class EvaluationRun:
    """One agent's results under one protocol.

    Attributes:
        agent: name of the agent.
        protocol: name of the protocol.
        cells: (layout, family) -> returns of the team, float64 (instances, episodes), means over the seeds.
        variant: name and value of the varied quantity in a sweep, such as ("K", 250); None otherwise.
        note: text that distinguishes results of one agent on the same cells; usually empty.
        sources: origins of the results.
    """

    agent: str
    protocol: str
    cells: dict[Cell, np.ndarray]
    variant: tuple[str, Any] | None = None
    note: str = ""
    sources: tuple[ResultSource, ...] = ()

    def means(self, cell: Cell) -> np.ndarray:
        """Returns the mean return of each instance of a cell, float64 (instances,)."""
        return self.cells[cell].mean(axis=1)

    def gain(self, cell: Cell) -> float:
        """Returns the mean return of the last 20 episodes minus that of the first 20 (paper, App. F).

        With fewer than 40 episodes it compares the halves.
        """
        returns = self.cells[cell]
        ends = max(1, min(_ENDS, returns.shape[1] // 2))
        return float(returns[:, -ends:].mean() - returns[:, :ends].mean())

    @cached_property
    def label(self) -> str:
        """The agent with variant and note, which distinguishes this run from others of the agent."""
        varied = "" if self.variant is None else ", {} = {}".format(*self.variant)
        return self.agent + varied + (f" [{self.note}]" if self.note else "")

    @cached_property
    def name(self) -> str:
        """The label with the protocol in parentheses."""
        return f"{self.label} ({self.protocol})"


def note_results(results: Path, run: Path | None = None, tasks: Sequence[Task] = ()) -> None:
    """Store the settings and tasks of results next to them, for reports.

    Args:
        results: folder of the results.
        run: run folder of the evaluated model, if it was trained here. Its path, settings, their hash and the hash of
            its data's manifest are written to run.json.
        tasks: the tasks played, if they are not the published ones; added to tasks.jsonl.

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
    """Returns the results in a folder that `python -m baselines evaluate` made.

    Raises:
        OptionError: if there are none, if they mix settings, or if the task of one is unknown.
    """
    results = [read_result(path) for path in sorted((folder / "tasks").glob("*.json"))]
    if not results:
        raise OptionError(
            f"{folder}: no results in {folder / 'tasks'}; run `python -m baselines evaluate --out {folder}`"
        )
    own = read_tasks(folder / OWN_TASKS) if (folder / OWN_TASKS).exists() else []
    trained = parse_json(read_text(folder / TRAINED_RUN)) if (folder / TRAINED_RUN).exists() else None
    return as_run(results, str(folder), own, trained)


def as_run(
    results: Sequence[Result], where: str = "results", tasks: Sequence[Task] = (), trained: dict[str, Any] | None = None
) -> EvaluationRun:
    """Returns the results of one agent as a run, which reports take.

    Args:
        results: results of `baselines.evaluate.evaluate`, all under the same settings.
        where: folder of the results, for messages.
        tasks: the tasks that were played, if they are not the published test tasks.
        trained: content of run.json, see `note_results`; None for an agent that was not trained here.

    Raises:
        OptionError: if the settings differ, or a result's task is neither published nor in `tasks`.
    """
    settings = results[0].settings
    if any(result.settings != settings for result in results):
        raise OptionError(f"{where}: results of different settings in one run")
    published = [task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))]
    known = {task.task_id: task for task in (*published, *tasks)}
    cells: dict[Cell, list[np.ndarray]] = defaultdict(list)
    first: dict[Cell, Task] = {}
    for result in results:
        if result.task_id not in known:
            raise OptionError(
                f"{where}: {result.task_id!r} is neither a published test task nor in the results' {OWN_TASKS}; "
                f"evaluate again, or copy the manifest of the tasks to {OWN_TASKS}"
            )
        task = known[result.task_id]
        cell = task.layout.name, task.teammate_family
        cells[cell].append(np.mean(result.returns, axis=0))
        first.setdefault(cell, task)
    variant = next(iter(settings.get("details", {}).get("variant", {}).items()), None)
    arrays = {cell: np.array(cells[cell]) for cell in sorted(cells, key=cell_order)}
    source = ResultSource(where, tuple(dict.fromkeys(layout for layout, _ in arrays)), settings, trained, first)
    return EvaluationRun(settings["agent"], settings["protocol"]["name"], arrays, variant, sources=(source,))


def merge(runs: Sequence[EvaluationRun]) -> list[EvaluationRun]:
    """Returns the runs with those of one agent on different cells, such as models of each layout, merged into one run.

    Runs that played the same cell are not merged; the `note` of the later ones is their folder.
    """
    merged: list[EvaluationRun] = []
    for run in runs:
        same = [k for k, other in enumerate(merged) if (other.name, _episodes(other)) == (run.name, _episodes(run))]
        disjoint = [k for k in same if not merged[k].cells.keys() & run.cells.keys()]
        if disjoint:
            other = merged[disjoint[0]]
            cells = other.cells | run.cells
            ordered = {cell: cells[cell] for cell in sorted(cells, key=cell_order)}
            merged[disjoint[0]] = replace(other, cells=ordered, sources=other.sources + run.sources)
        else:
            merged.append(replace(run, note=run.sources[0].folder) if same and run.sources else run)
    return merged


def _episodes(run: EvaluationRun) -> set[int]:
    return {returns.shape[1] for returns in run.cells.values()}


def cell_order(cell: Cell) -> tuple[int, int]:
    """Returns the sort key of a cell in the paper's order."""
    return LAYOUT_NAMES.index(cell[0]), FAMILIES.index(cell[1])


def families_of(cells: Iterable[Cell]) -> list[str]:
    """Returns the families of cells, in the paper's order."""
    found = {family for _, family in cells}
    return [family for family in FAMILIES if family in found]


@cache
def read_published() -> dict[str, Any]:
    """Returns the paper's numbers, each part with its source, from cards/published.json."""
    return parse_json(read_text(card_file("published.json")))


def published_cells(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Returns layout -> family or "Average" -> published mean and std; empty for an agent that is not in the paper."""
    return read_published()["methods"].get(agent, {})


def normalized_return(mean: float, references: Mapping[str, float] | None) -> float | None:
    """Returns (return - stay) / (oracle - stay), or None if the cell has no headroom or was not measured.

    Args:
        mean: mean return of a cell.
        references: reference ego -> its mean return in the cell.
    """
    if references is None or not has_headroom(references):
        return None
    return (mean - references["stay"]) / (references["oracle"] - references["stay"])
