"""The report's figures beside the curves: sweeps and adaptation gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from baselines.report.results import Run
from baselines.report.tables import Point
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import legend_below, save_figure


def plot_sweep(panels: Mapping[str, Mapping[str, Sequence[Point]]], what: str, path: Path) -> None:
    """Return over what was varied: a panel per layout, a line per agent, hollow diamonds where the paper states one."""
    figure = Figure(figsize=(3.4 * len(panels) + 1, 3.2), layout="constrained")
    axes: Any = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (layout, lines) in zip(axes, panels.items(), strict=True):
        names = list(dict.fromkeys(str(point.value) for points in lines.values() for point in points))
        for agent, points in lines.items():
            x = [names.index(str(point.value)) for point in points]
            drawn = axis.errorbar(
                x, [p.mean for p in points], [p.std for p in points], label=agent, marker="o", capsize=3, linewidth=1.3
            )
            stated = [(k, p.published) for k, p in zip(x, points, strict=True) if p.published is not None]
            if stated:
                colour = drawn.lines[0].get_color()
                axis.plot(*np.transpose(stated), "D", markerfacecolor="none", color=colour, label=f"{agent}, paper")
        axis.set_xticks(range(len(names)), names)
        axis.set_title(layout, fontsize=9)
        axis.set_xlabel(what)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean return over families")
    legend_below(figure)
    save_figure(figure, path)


def plot_gain(runs: Sequence[Run], path: Path) -> None:
    """Adaptation gain per track (paper, App. F): mean over cells, a dot per cell.

    Raises:
        OptionError: if there is no run.
    """
    if not runs:
        raise OptionError("no run to draw the adaptation gain of; give at least one folder of results")
    figure = Figure(figsize=(4.2 + 0.5 * len(runs), 3.2), layout="constrained")
    axis = figure.add_subplot()
    width = 0.8 / len(runs)
    for number, run in enumerate(runs):
        for place, track in enumerate(TRACKS):
            gains = [run.gain(cell) for cell in run.cells if cell[0] in TRACKS[track]["test"] and cell[1] in HEURISTICS]
            if gains:
                x = place + (number - (len(runs) - 1) / 2) * width
                label = run.name if run.name not in axis.get_legend_handles_labels()[1] else None
                axis.bar(x, np.mean(gains), width * 0.9, color=f"C{number}", alpha=0.6, label=label)
                axis.plot(np.full(len(gains), x), gains, ".", color=f"C{number}", markersize=4)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(TRACKS)), [f"track {track}" for track in TRACKS])
    axis.set_xlim(-0.5, len(TRACKS) - 0.5)
    axis.set_ylabel("last 20 - first 20 episodes")
    axis.grid(alpha=0.3, axis="y")
    legend_below(figure)
    save_figure(figure, path)
