"""Figures of training and evaluation, drawn from plain numbers into PNG files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.benchmark.facts import FAMILIES, LAYOUT_NAMES, TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, Cell
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import legend_below, new_figure, save_figure


class SweepPoint(NamedTuple):
    """One run of a sweep on one layout.

    Attributes:
        value: of what is varied.
        mean: return, over the cells played.
        std: of the cells' means; None for a single cell.
        published: the paper's mean, if it states one for these conditions.
    """

    value: Any
    mean: float
    std: float | None
    published: float | None


def plot_training_log(metrics: Path, path: Path, title: str) -> None:
    """Plot every number of a run's metrics.jsonl over the training steps: a panel each, a line per part of the data."""
    lines = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    names = list(dict.fromkeys(name for line in lines for name in line if name not in ("step", "part")))
    parts = list(dict.fromkeys(line["part"] for line in lines))
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(4.6 * columns, 3.1 * rows)
    panels: list[Any] = [*figure.subplots(rows, columns, squeeze=False).flat]
    for axes, name in zip(panels, names, strict=False):
        for part in parts:
            points = [(line["step"], line[name]) for line in lines if line["part"] == part and name in line]
            if points:
                axes.plot(*np.transpose(points), "-" if part == "train" else ".-", label=part, linewidth=1.2)
        axes.set_title(name.replace("_", " "), fontsize=9)
        axes.set_xlabel("training step", fontsize=8)
        axes.grid(alpha=0.3)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    figure.suptitle(title, fontsize=10)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(parts), frameon=False)
    save_figure(figure, path)


def plot_return_curves(runs: Sequence[tuple[str, Mapping[Cell, np.ndarray]]], path: Path) -> None:
    """Plot the return per episode: a panel per cell, a line per run, with the range over several instances as a band.

    Args:
        runs: (label, cell -> returns (instances, episodes)); the second part of a cell starts with its family.
        path: PNG file to write.
    """
    cells = {cell for _, returns in runs for cell in returns}
    layouts = [layout for layout in LAYOUT_NAMES if any(cell[0] == layout for cell in cells)]
    groups = {cell[1] for cell in cells}
    families = sorted(groups, key=lambda group: (FAMILIES.index(group.partition(" ")[0]), group))
    figure = new_figure(2.5 * len(layouts) + 1, 2.1 * len(families) + 0.6)
    axes = figure.subplots(len(families), len(layouts), squeeze=False, sharex=True)
    for i, family in enumerate(families):
        for j, layout in enumerate(layouts):
            for label, returns in runs:
                if (layout, family) in returns:
                    _plot_band(axes[i, j], label, returns[layout, family])
            axes[i, j].grid(alpha=0.3)
    for j, layout in enumerate(layouts):
        axes[0, j].set_title(layout, fontsize=9)
        axes[-1, j].set_xlabel("episode", fontsize=8)
    for i, family in enumerate(families):
        axes[i, 0].set_ylabel(family)
    legend_below(figure)
    save_figure(figure, path)


def _plot_band(axis: Any, label: str, returns: np.ndarray, smooth: int = 10) -> None:
    window = min(smooth, returns.shape[1])
    kernel = np.ones(window) / window
    curves = np.stack([np.convolve(row, kernel, mode="valid") for row in returns])
    episodes = np.arange(window, returns.shape[1] + 1)
    (line,) = axis.plot(episodes, curves.mean(axis=0), label=label)
    axis.fill_between(episodes, curves.min(axis=0), curves.max(axis=0), color=line.get_color(), alpha=0.2, linewidth=0)


_AGENT_COLOUR = "#1f5fa8"
_REFERENCE_LINES = {"oracle": ("#2c8a4b", "--"), "random": ("#b0653a", ":"), "stay": ("#6b7280", "-.")}


def plot_family_curves(
    families: Mapping[str, Mapping[str, np.ndarray]], agent: str, path: Path, title: str, notes: Mapping[str, str]
) -> None:
    """Plot an agent's mean return in each episode with a 95 % band, and reference egos' mean returns as lines.

    Args:
        families: teammate family -> agent -> returns (U, E) of U pairs of a task and a seed in E episodes; a panel
            each.
        agent: the agent whose curve is drawn; the others are lines.
        path: PNG file to write.
        title: heading of the figure.
        notes: teammate family -> text below the family's name.
    """
    figure = new_figure(3.5 * len(families) + 0.4, 3.7)
    panels: Any = figure.subplots(1, len(families), squeeze=False, sharey=True)[0]
    for axes, (family, returns) in zip(panels, families.items(), strict=True):
        curves = returns[agent]
        episodes, mean = np.arange(1, curves.shape[1] + 1), curves.mean(axis=0)
        error = 1.96 * curves.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else np.zeros(len(mean))
        for name in (name for name in returns if name != agent):
            colour, dashes = _REFERENCE_LINES.get(name, ("black", "-"))
            axes.axhline(returns[name].mean(), color=colour, linestyle=dashes, linewidth=1.6, label=name)
        axes.fill_between(episodes, mean - error, mean + error, color=_AGENT_COLOUR, alpha=0.18, linewidth=0)
        axes.plot(episodes, mean, "o-", color=_AGENT_COLOUR, linewidth=2, markersize=3.5, label=agent)
        axes.set_title(f"{family}\n{notes[family]}", fontsize=9)
        axes.set_xlabel("episode within the task")
        axes.set_xlim(0.5, len(episodes) + 0.5)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("return of an episode")
    figure.suptitle(title, fontsize=11)
    legend_below(figure)
    save_figure(figure, path, dpi=130)


def plot_sweep(panels: Mapping[str, Mapping[str, Sequence[SweepPoint]]], quantity: str, path: Path) -> None:
    """Plot the return over the varied quantity: a panel per layout, a line per agent, hollow diamonds for the paper."""
    figure = new_figure(3.4 * len(panels) + 1, 3.2)
    axes: Any = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (layout, lines) in zip(axes, panels.items(), strict=True):
        names = list(dict.fromkeys(str(point.value) for points in lines.values() for point in points))
        for agent, points in lines.items():
            x = [names.index(str(point.value)) for point in points]
            bars = [np.nan if p.std is None else p.std for p in points]
            drawn = axis.errorbar(x, [p.mean for p in points], bars, label=agent, marker="o", capsize=3, linewidth=1.3)
            stated = [(k, p.published) for k, p in zip(x, points, strict=True) if p.published is not None]
            if stated:
                colour = drawn.lines[0].get_color()
                axis.plot(*np.transpose(stated), "D", markerfacecolor="none", color=colour, label=f"{agent}, paper")
        axis.set_xticks(range(len(names)), names)
        axis.set_title(layout, fontsize=9)
        axis.set_xlabel(quantity)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean return over families")
    legend_below(figure)
    save_figure(figure, path)


def plot_adaptation_gain(runs: Sequence[tuple[str, Mapping[Cell, float]]], path: Path) -> None:
    """Plot the adaptation gain per track (paper, App. F): mean over cells as a bar, a dot per cell.

    Args:
        runs: (label, cell -> gain).
        path: PNG file to write.

    Raises:
        OptionError: if there is no run.
    """
    if not runs:
        raise OptionError("no run to draw the adaptation gain of; give at least one folder of results")
    figure = new_figure(4.2 + 0.5 * len(runs), 3.2)
    axis = figure.add_subplot()
    width = 0.8 / len(runs)
    for number, (label, cells) in enumerate(runs):
        for position, track in enumerate(TRACKS):
            tested = TRACKS[track]["test"]
            gains = [gain for cell, gain in cells.items() if cell[0] in tested and cell[1] in HEURISTICS]
            if gains:
                x = position + (number - (len(runs) - 1) / 2) * width
                shown = label if label not in axis.get_legend_handles_labels()[1] else None
                axis.bar(x, np.mean(gains), width * 0.9, color=f"C{number}", alpha=0.6, label=shown)
                axis.plot(np.full(len(gains), x), gains, ".", color=f"C{number}", markersize=4)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(TRACKS)), [f"track {track}" for track in TRACKS])
    axis.set_xlim(-0.5, len(TRACKS) - 0.5)
    axis.set_ylabel("last 20 - first 20 episodes")
    axis.grid(alpha=0.3, axis="y")
    legend_below(figure)
    save_figure(figure, path)
