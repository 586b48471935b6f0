"""Results -> the paper's Tables 1 and 2 with the published numbers beside ours, and adaptation curves."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from baselines.evaluate import Result, read_result
from icrl4aht_data.benchmark import TRACKS
from icrl4aht_data.cards import card_file
from icrl4aht_data.errors import OptionError
from icrl4aht_data.headroom import HEURISTICS, Cell, has_headroom, read_headroom
from icrl4aht_data.tasks import manifest_path, read_tasks

LAYOUTS = tuple(layout for track in TRACKS.values() for layout in track["test"])
_ENDS = 20  # episodes at each end for the adaptation gain (paper, App. F)
_RESAMPLES = 10_000


@dataclass(frozen=True, eq=False)
class Run:
    """One agent's results under one protocol."""

    agent: str
    protocol: str
    cells: dict[Cell, np.ndarray]  # (instances, episodes) team returns, means over the seeds

    def means(self, cell: Cell) -> np.ndarray:
        """float64 (instances,)."""
        return self.cells[cell].mean(axis=1)

    def gain(self, cell: Cell) -> float:
        """Mean return of the last 20 episodes minus that of the first 20 (paper, App. F)."""
        returns = self.cells[cell]
        return float(returns[:, -_ENDS:].mean() - returns[:, :_ENDS].mean())

    @cached_property
    def name(self) -> str:
        return f"{self.agent} ({self.protocol})"


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
    return as_run(results, str(folder))


def as_run(results: list[Result], where: str = "results") -> Run:
    """Results of one agent as a run."""
    settings = results[0].settings
    if any(result.settings != settings for result in results):
        raise OptionError(f"{where}: results of different settings in one run")
    known = {task.task_id: task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))}
    cells: dict[Cell, list[np.ndarray]] = defaultdict(list)
    for result in results:
        if result.task_id not in known:
            raise OptionError(f"{where}: {result.task_id!r} is not one of the published test tasks")
        task = known[result.task_id]
        cells[task.layout.name, task.teammate_family].append(np.mean(result.returns, axis=0))
    return Run(settings["agent"], settings["protocol"]["name"], {cell: np.array(rows) for cell, rows in cells.items()})


def interval(means: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """The bootstrap 95 % interval of the mean over instances (n,)."""
    resampled = rng.choice(means, (_RESAMPLES, len(means))).mean(axis=1)
    low, high = np.percentile(resampled, (2.5, 97.5))
    return float(low), float(high)


def rows(run: Run) -> list[dict[str, Any]]:
    """One row per cell: ours, the published number of the same agent, interval, gain, and the normalised score."""
    published, headroom = _published(run.agent), read_headroom(run.protocol)
    rng = np.random.default_rng(0)
    table = []
    for layout in LAYOUTS:
        for family in HEURISTICS:
            cell = (layout, family)
            if cell not in run.cells:
                continue
            means = run.means(cell)
            low, high = interval(means, rng)
            theirs = published.get(layout, {}).get(family, (None, None))
            table.append(
                {
                    "agent": run.agent,
                    "protocol": run.protocol,
                    "layout": layout,
                    "family": family,
                    "instances": len(means),
                    "episodes": run.cells[cell].shape[1],
                    "mean": float(means.mean()),
                    "std": float(means.std()),
                    "low": low,
                    "high": high,
                    "published_mean": theirs[0],
                    "published_std": theirs[1],
                    "gain": run.gain(cell),
                    "headroom": has_headroom(headroom[cell]) if cell in headroom else None,
                    "normalised": normalised(float(means.mean()), headroom.get(cell)),
                }
            )
    return table


def _published(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    content = json.loads(card_file("published.json").read_text(encoding="utf-8"))
    return content["methods"].get(agent, {})


def normalised(mean: float, references: dict[str, float] | None) -> float | None:
    """(return - stay) / (oracle - stay); None where the cell leaves no headroom or was not measured."""
    if references is None or not has_headroom(references):
        return None
    return (mean - references["stay"]) / (references["oracle"] - references["stay"])


def markdown(runs: list[Run]) -> str:
    """The tables of both tracks, one block per run."""
    lines = ["# Returns per layout and teammate family", ""]
    lines += [
        "Mean ± std over the instances' means; below it the published number of the same agent, where there is one."
    ]
    for run in runs:
        cells = {(row["layout"], row["family"]): row for row in rows(run)}
        for track, splits in TRACKS.items():
            layouts = [layout for layout in splits["test"] if any((layout, family) in cells for family in HEURISTICS)]
            if layouts:
                lines += ["", f"## {run.name}, track {track}", "", *_grid(cells, layouts)]
    return "\n".join(lines) + "\n"


def _grid(cells: dict[Cell, dict[str, Any]], layouts: list[str]) -> list[str]:
    lines = [f"| family | {' | '.join(layouts)} |", f"|---|{'---|' * len(layouts)}"]
    for family in HEURISTICS:
        present = [cells.get((layout, family)) for layout in layouts]
        lines.append(f"| {family} | {' | '.join(_cell_text(row) for row in present)} |")
    return lines


def _cell_text(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    text = f"{row['mean']:.1f} ± {row['std']:.1f}"
    if row["published_mean"] is not None:
        text += f"<br>published {row['published_mean']:.1f} ± {row['published_std']:.1f}"
    text += f"<br>gain {row['gain']:+.1f}"
    if row["headroom"] is False:
        text += "<br>no headroom"
    if row["normalised"] is not None:
        text += f"<br>normalised {row['normalised']:.2f}"
    return text


def csv_text(runs: list[Run]) -> str:
    """Every row of every run."""
    table = [row for run in runs for row in rows(run)]
    stream = StringIO()
    writer = csv.DictWriter(stream, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return stream.getvalue()


def plot_curves(runs: list[Run], path: Path) -> None:
    """Return per episode for every cell: mean, and the range over instances as a band."""
    from matplotlib.figure import Figure

    layouts = [layout for layout in LAYOUTS if any(cell[0] == layout for run in runs for cell in run.cells)]
    figure = Figure(figsize=(2.5 * len(layouts) + 1, 2.1 * len(HEURISTICS) + 0.6), layout="constrained")
    axes = figure.subplots(len(HEURISTICS), len(layouts), squeeze=False, sharex=True)
    for i, family in enumerate(HEURISTICS):
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
            if i == len(HEURISTICS) - 1:
                axis.set_xlabel("episode", fontsize=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(runs), frameon=False)
    figure.savefig(path, dpi=110)


def _plot_cell(axis: Any, run: Run, cell: Cell, smooth: int = 10) -> None:
    returns = run.cells[cell]
    window = min(smooth, returns.shape[1])
    kernel = np.ones(window) / window
    curves = np.stack([np.convolve(row, kernel, mode="valid") for row in returns])
    episodes = np.arange(window, returns.shape[1] + 1)
    (line,) = axis.plot(episodes, curves.mean(axis=0), label=run.name)
    axis.fill_between(episodes, curves.min(axis=0), curves.max(axis=0), color=line.get_color(), alpha=0.2, linewidth=0)


def write_report(runs: list[Run], out: Path) -> list[Path]:
    """report.md, report.csv and curves.png in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / "report.md", out / "report.csv", out / "curves.png"]
    paths[0].write_text(markdown(runs), encoding="utf-8")
    paths[1].write_text(csv_text(runs), encoding="utf-8")
    plot_curves(runs, paths[2])
    return paths
