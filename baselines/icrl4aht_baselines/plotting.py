"""Figures of training and evaluation, drawn from plain numbers into PNG files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from icrl4aht_data.plotting import MOST_PANELS, legend_below, new_figure, return_limits, running_mean, save_figure

LogCurves = dict[str, dict[str, dict[int, list[float]]]]
"""Panel -> curve -> training step -> values."""

_RETURN = "return"
"""First word of the names of returns in a log, "return <layout> [<variant>] <kind of teammate>"."""


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


SMOOTHING = 10
"""Most episodes in the running mean of a curve of returns; of few episodes a tenth."""


def smooth_returns(returns: Float[np.ndarray, " E"]) -> Float[np.ndarray, " E"]:
    """Return the running mean of a task's returns over up to `SMOOTHING` episodes."""
    return running_mean(returns, min(SMOOTHING, len(returns) // 10))


_REFERENCE_LINES = {"oracle": ("#2c8a4b", "--"), "random": ("#b0653a", ":"), "stay": ("#6b7280", "-.")}


def plot_return_curves(
    panels: Mapping[str, Mapping[str, np.ndarray]],
    path: Path,
    references: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> None:
    """Plot the return per episode on shared axes: a panel per cell, a line per run.

    Lines are running means of the mean over a cell's instances, bands the range of the instances' running means, and
    thin lines the mean of each single episode.

    Args:
        panels: title of a cell -> label of a run -> returns (instances, episodes); at most `MOST_PANELS`.
        path: file to write, of a type in `icrl4aht_data.plotting.PICTURES`.
        references: title -> reference ego, stay, random or oracle -> its mean return, drawn as a level line.
    """
    columns = min(4, len(panels))
    figure, grid = panel_grid([*panels], columns, (2.7, 1.9), "episode", sharex=True, sharey=True)
    labels = list(dict.fromkeys(label for runs in panels.values() for label in runs))
    limits = []
    for axes, (title, runs) in zip(grid, panels.items(), strict=False):
        for label, returns in runs.items():
            limits += _plot_curve(axes, label, f"C{labels.index(label)}", returns)
        for name, level in references.get(title, {}).items():
            colour, dashes = _REFERENCE_LINES[name]
            axes.axhline(level, color=colour, linestyle=dashes, linewidth=1.1, label=name)
            limits.append(level)
    grid[0].set_ylim(*return_limits(limits))
    for axes in grid[::columns]:
        axes.set_ylabel("return", fontsize=9)
    legend_below(figure)
    save_figure(figure, path)


def _plot_curve(axes: Any, label: str, color: str, returns: np.ndarray) -> list[float]:
    """Plot the curve of a run in a cell. Return the lowest and the highest return drawn."""
    curves = np.stack([smooth_returns(row) for row in returns])
    low, high, raw = curves.min(axis=0), curves.max(axis=0), returns.mean(axis=0)
    episodes = np.arange(1, returns.shape[1] + 1)
    axes.fill_between(episodes, low, high, color=color, alpha=0.15, linewidth=0)
    axes.plot(episodes, raw, color=color, alpha=0.35, linewidth=0.7)
    axes.plot(episodes, curves.mean(axis=0), color=color, label=label, linewidth=1.6)
    return [float(min(low.min(), raw.min())), float(max(high.max(), raw.max()))]
