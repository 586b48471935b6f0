"""Results -> the paper's Tables 1 and 2 with the published numbers beside ours, and adaptation curves."""

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
from icrl4aht_data.benchmark.facts import FAMILIES, LAYOUT_NAMES, TRACKS
from icrl4aht_data.benchmark.reference_returns import Cell, has_headroom
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import legend_below, save_figure
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.templates import card_file

TEST_LAYOUTS = tuple(layout for track in TRACKS.values() for layout in track["test"])
OWN_TASKS, ABOUT = "tasks.jsonl", "run.json"
"""Beside results: tasks that are not the published ones; what the evaluated model was trained on."""
_ENDS = 20  # episodes at each end for the adaptation gain (paper, App. F)


class Source(NamedTuple):
    """Where results come from."""

    folder: str
    layouts: tuple[str, ...]
    settings: dict[str, Any]
    trained: dict[str, Any] | None  # of a trained model: see `provenance.note_run`
    tasks: Mapping[Cell, Task] = MappingProxyType({})  # of each cell the first that was played


@dataclass(frozen=True, eq=False)
class Run:
    """One agent's results under one protocol."""

    agent: str
    protocol: str
    cells: dict[Cell, np.ndarray]  # (instances, episodes) team returns, means over the seeds
    variant: tuple[str, Any] | None = None  # of a sweep: what is varied and this run's value, such as ("K", 250)
    note: str = ""  # tells apart results of one agent on the same cells
    sources: tuple[Source, ...] = ()

    def means(self, cell: Cell) -> np.ndarray:
        """float64 (instances,)."""
        return self.cells[cell].mean(axis=1)

    def gain(self, cell: Cell) -> float:
        """Mean return of the last 20 episodes minus that of the first 20 (paper, App. F); of the halves, if shorter."""
        returns = self.cells[cell]
        ends = max(1, min(_ENDS, returns.shape[1] // 2))
        return float(returns[:, -ends:].mean() - returns[:, :ends].mean())

    @cached_property
    def label(self) -> str:
        """The agent, and what tells this run from its others."""
        varied = "" if self.variant is None else ", {} = {}".format(*self.variant)
        return self.agent + varied + (f" [{self.note}]" if self.note else "")

    @cached_property
    def name(self) -> str:
        return f"{self.label} ({self.protocol})"


def read_run(folder: Path) -> Run:
    """The results in a run's folder.

    Raises:
        OptionError: if there is none, if they mix settings, or if one is of no published task.
    """
    results = [read_result(path) for path in sorted((folder / "tasks").glob("*.json"))]
    if not results:
        raise OptionError(
            f"{folder}: no results in {folder / 'tasks'}; run `python -m baselines evaluate --out {folder}`"
        )
    own = read_tasks(folder / OWN_TASKS) if (folder / OWN_TASKS).exists() else []
    about = parse_json(read_text(folder / ABOUT)) if (folder / ABOUT).exists() else None
    return as_run(results, str(folder), own, about)


def as_run(
    results: Sequence[Result], where: str = "results", tasks: Sequence[Task] = (), trained: dict[str, Any] | None = None
) -> Run:
    """Results of one agent as a run; of the published tasks, and of those that are given."""
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
                f"{where}: {result.task_id!r} is not one of the published test tasks, and {OWN_TASKS} beside the "
                f"results does not have it; evaluate again, or put the manifest there"
            )
        task = known[result.task_id]
        cell = task.layout.name, task.teammate_family
        cells[cell].append(np.mean(result.returns, axis=0))
        first.setdefault(cell, task)
    variant = next(iter(settings.get("details", {}).get("variant", {}).items()), None)
    arrays = {cell: np.array(cells[cell]) for cell in sorted(cells, key=place_of)}
    source = Source(where, tuple(dict.fromkeys(layout for layout, _ in arrays)), settings, trained, first)
    return Run(settings["agent"], settings["protocol"]["name"], arrays, variant, sources=(source,))


def place_of(cell: Cell) -> tuple[int, int]:
    """Where a cell stands in the paper's order."""
    return LAYOUT_NAMES.index(cell[0]), FAMILIES.index(cell[1])


def merge(runs: Sequence[Run]) -> list[Run]:
    """One agent's results on different cells, of models trained on each layout, as one run; where the same cell was
    played twice, runs stay apart and bear their folder's name."""
    merged: list[Run] = []
    for run in runs:
        same = [k for k, other in enumerate(merged) if (other.name, _episodes(other)) == (run.name, _episodes(run))]
        apart = [k for k in same if not merged[k].cells.keys() & run.cells.keys()]
        if apart:
            other = merged[apart[0]]
            cells = other.cells | run.cells
            ordered = {cell: cells[cell] for cell in sorted(cells, key=place_of)}
            merged[apart[0]] = replace(other, cells=ordered, sources=other.sources + run.sources)
        else:
            merged.append(replace(run, note=run.sources[0].folder) if same and run.sources else run)
    return merged


def _episodes(run: Run) -> set[int]:
    return {returns.shape[1] for returns in run.cells.values()}


@cache
def read_published() -> dict[str, Any]:
    """The paper's numbers, each part with its source: cards/published.json."""
    return parse_json(read_text(card_file("published.json")))


def published_cells(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    """layout -> family or "Average" -> published mean and std; empty for an agent that the paper does not have."""
    return read_published()["methods"].get(agent, {})


def normalised(mean: float, references: dict[str, float] | None) -> float | None:
    """(return - stay) / (oracle - stay); None where the cell leaves no headroom or was not measured."""
    if references is None or not has_headroom(references):
        return None
    return (mean - references["stay"]) / (references["oracle"] - references["stay"])


def families_of(cells: Iterable[Cell]) -> list[str]:
    """Those that there are, in the paper's order."""
    there = {family for _, family in cells}
    return [family for family in FAMILIES if family in there]


def plot_curves(runs: list[Run], path: Path) -> None:
    """Return per episode for every cell: mean, and the range over instances as a band."""
    from matplotlib.figure import Figure

    every = [cell for run in runs for cell in run.cells]
    layouts = [layout for layout in LAYOUT_NAMES if any(cell[0] == layout for cell in every)]
    families = families_of(every)
    figure = Figure(figsize=(2.5 * len(layouts) + 1, 2.1 * len(families) + 0.6), layout="constrained")
    axes = figure.subplots(len(families), len(layouts), squeeze=False, sharex=True)
    for i, family in enumerate(families):
        for j, layout in enumerate(layouts):
            axis = axes[i, j]
            for run in runs:
                if (layout, family) in run.cells:
                    _plot_cell(axis, run, (layout, family))
            axis.grid(alpha=0.3)
            if i == 0:
                axis.set_title(layout, fontsize=9)
            if j == 0:
                axis.set_ylabel(family)
            if i == len(families) - 1:
                axis.set_xlabel("episode", fontsize=8)
    legend_below(figure)
    save_figure(figure, path)


def _plot_cell(axis: Any, run: Run, cell: Cell, smooth: int = 10) -> None:
    returns = run.cells[cell]
    window = min(smooth, returns.shape[1])
    kernel = np.ones(window) / window
    curves = np.stack([np.convolve(row, kernel, mode="valid") for row in returns])
    episodes = np.arange(window, returns.shape[1] + 1)
    (line,) = axis.plot(episodes, curves.mean(axis=0), label=run.name)
    axis.fill_between(episodes, curves.min(axis=0), curves.max(axis=0), color=line.get_color(), alpha=0.2, linewidth=0)
