"""Figures of a training's log, and what other figures share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.plotting import MOST_PANELS, legend_below, new_figure, return_limits, running_mean, save_figure

LogCurves = dict[str, dict[str, dict[int, list[float]]]]
"""Panel -> curve -> training step -> values."""

_RETURN = "return"
"""First word of the names of returns in a log, "return <layout> [rearranged] <kind of teammate>"."""


def plot_training_log(metrics: Path, path: Path, title: str) -> None:
    """Plot the numbers of a run's metrics.jsonl over the training steps, in at most `MOST_PANELS` panels.

    Each number has a panel with a line per part of the data; returns have a panel per layout with a line per kind of
    teammate, on one axis. Thick lines are running means over a twentieth of the points, thin ones the points.
    """
    lines = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    panels = _log_curves(lines, by_layout=True)
    if len(panels) > MOST_PANELS:
        panels = _log_curves(lines, by_layout=False)
    labels = list(dict.fromkeys(label for curves in panels.values() for label in curves))
    of_returns = [curve for name, curves in panels.items() if name.startswith(_RETURN) for curve in curves.values()]
    limits = return_limits(float(np.mean(values)) for curve in of_returns for values in curve.values())
    figure, grid = panel_grid(
        [name if name.startswith(_RETURN) else name.replace("_", " ") for name in panels],
        min(4 if len(panels) > 9 else 3, len(panels)),
        (4.2, 2.6),
        "training step",
    )
    for axes, (name, curves) in zip(grid, panels.items(), strict=False):
        for label, points in curves.items():
            _plot_log_curve(axes, label, f"C{labels.index(label)}", points)
        if name.startswith(_RETURN):
            axes.set_ylim(*limits)
    figure.suptitle(title, fontsize=10)
    legend_below(figure)
    save_figure(figure, path)


def panel_grid(
    titles: Sequence[str], columns: int, size: tuple[float, float], x_label: str, **sharing: Any
) -> tuple[Any, list[Any]]:
    """Return a figure and its axes: a panel of this size in inches for each title, and hidden ones in the last row."""
    rows = -(-len(titles) // columns)
    figure = new_figure(size[0] * columns + 0.3, size[1] * rows + 0.6)
    grid: list[Any] = [*figure.subplots(rows, columns, squeeze=False, **sharing).flat]
    for axes, title in zip(grid, titles, strict=False):
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.3)
    for axes in grid[len(titles) :]:
        axes.set_axis_off()
    for axes in grid[max(0, len(titles) - columns) : len(titles)]:
        axes.set_xlabel(x_label, fontsize=8)
    return figure, grid


def _log_curves(lines: Sequence[Mapping[str, Any]], by_layout: bool) -> LogCurves:
    """Return the curves of a log, with a panel of returns for each layout, or one for all."""
    found: LogCurves = {}
    for line in lines:
        for name in (name for name in line if name not in ("step", "part")):
            panel, label = name, line["part"]
            if name.startswith(f"{_RETURN} "):
                words = name.split()
                panel = f"{_RETURN}, {words[1]}" if by_layout else f"{_RETURN}, mean over layouts"
                label = words[-1].replace("_", " ") + ("" if label == "train" else f", {label}")
            found.setdefault(panel, {}).setdefault(label, {}).setdefault(line["step"], []).append(line[name])
    return found


def _plot_log_curve(axes: Any, label: str, color: str, points: Mapping[int, Sequence[float]]) -> None:
    steps, values = list(points), np.array([np.mean(of_step) for of_step in points.values()])
    window = len(values) // 20
    if window > 1:
        axes.plot(steps, values, color=color, alpha=0.35, linewidth=0.7)
    marker = "" if len(values) > 20 else "."
    axes.plot(steps, running_mean(values, window), color=color, marker=marker, label=label, linewidth=1.4)


def shrink_picture(picture: Path, path: Path) -> None:
    """Write a copy of a PNG file with 64 colours: curves look the same in a third of the bytes."""
    from PIL import Image

    with Image.open(picture) as image:
        reduced = image.convert("RGB").quantize(64)
    reduced.save(path, optimize=True)
