"""Figures of training logs, and helpers for other figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from icrl4aht_data.plotting import MOST_PANELS, add_legend_below, axis_limits, new_figure, running_mean, save_figure


def plot_training_log(metrics: Path, path: Path, title: str) -> None:
    """Plot the numbers of a run's metrics.jsonl over the training steps, in at most `MOST_PANELS` panels.

    Each logged number has a panel with a line for each part of the data. Returns have a panel for each layout, with a
    line for each kind of teammate; these panels have equal limits. Thick lines are running means over a twentieth of
    the points; thin lines connect the points.
    """
    lines = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    numbers = pd.DataFrame(lines).melt(["step", "part"], var_name="panel", value_name="number").dropna()
    numbers["label"] = numbers["part"]
    # Returns are named "return <layout> [rearranged] <kind of teammate>".
    is_return = numbers["panel"].str.startswith("return ")
    words, parts = numbers["panel"][is_return].str.split(), numbers["part"][is_return]
    kinds = words.str[-1].str.replace("_", " ")
    numbers.loc[is_return, "label"] = kinds.where(parts == "train", kinds + ", " + parts)
    numbers.loc[is_return, "panel"] = "return, " + words.str[1]
    if numbers["panel"].nunique() > MOST_PANELS:
        numbers.loc[is_return, "panel"] = "return, mean over layouts"
    curves = numbers.groupby(["panel", "label", "step"], sort=False)["number"].mean()
    panels, labels = (list(dict.fromkeys(curves.index.get_level_values(name))) for name in ("panel", "label"))
    returns = [name for name in panels if name.startswith("return, ")]
    limits = axis_limits(float(value) for name in returns for value in curves[name])
    figure, grid = panel_grid(
        [name if name in returns else name.replace("_", " ") for name in panels],
        min(4 if len(panels) > 9 else 3, len(panels)),
        (4.2, 2.6),
        "training step",
    )
    for axes, name in zip(grid, panels, strict=False):
        for label, points in curves[name].groupby("label", sort=False):
            _plot_log_curve(axes, str(label), f"C{labels.index(label)}", points.droplevel("label"))
        if name in returns:
            axes.set_ylim(*limits)
    figure.suptitle(title, fontsize=10)
    add_legend_below(figure)
    save_figure(figure, path)


def panel_grid(
    titles: Sequence[str], columns: int, size: tuple[float, float], x_label: str, **sharing: Any
) -> tuple[Any, list[Any]]:
    """Return a figure and its axes: one panel of `size` inches for each title; the last row may have hidden panels."""
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


def _plot_log_curve(axes: Any, label: str, color: str, points: pd.Series) -> None:
    steps, values = points.index, points.to_numpy()
    window = len(values) // 20
    if window > 1:
        axes.plot(steps, values, color=color, alpha=0.35, linewidth=0.7)
    marker = "" if len(values) > 20 else "."
    axes.plot(steps, running_mean(values, window), color=color, marker=marker, label=label, linewidth=1.4)


def shrink_picture(picture: Path, path: Path) -> None:
    """Write a copy of a PNG file with 64 colours: curves look the same, and the file is a third as large."""
    from PIL import Image

    with Image.open(picture) as image:
        reduced = image.convert("RGB").quantize(64)
    reduced.save(path, optimize=True)
