"""Figures of populations of teammates."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.plotting import new_figure, save_figure


def plot_training(metrics: Path, path: Path, title: str) -> None:
    """Draw returns over environment steps from a JSON-lines log: self-play, and cross-play if there is any."""
    lines = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    figure = new_figure(7, 4)
    axes: Any = figure.subplots()
    for stage in sorted({line["stage"] for line in lines}):
        own = [line for line in lines if line["stage"] == stage]
        for name, style in (("self_play", "-"), ("cross_play", "--")):
            points = [(line["step"], line[name]) for line in own if name in line]
            if points:
                label = name.replace("_", "-") + (f", stage {stage}" if stage else "")
                axes.plot(*np.transpose(points), style, label=label, linewidth=1.2)
    axes.set(title=title, xlabel="environment steps of each member", ylabel="return of an episode (400 steps)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False)
    save_figure(figure, path)


def plot_matrix(values: np.ndarray, names: Sequence[str], path: Path, title: str, labels: tuple[str, str]) -> None:
    """Draw a square matrix as coloured cells with their numbers.

    Args:
        values: float (n, n).
        names: names of the rows and of the columns.
        path: the picture.
        title: its title.
        labels: what rows and columns are.
    """
    size = len(names)
    figure = new_figure(max(1.6 + 0.75 * size, 4.2), max(1.4 + 0.6 * size, 3.4))
    axes: Any = figure.subplots()
    image = axes.imshow(values, cmap="viridis", aspect="auto")
    middle = (values.max() + values.min()) / 2
    for (i, j), value in np.ndenumerate(values):
        text = f"{value:.2f}" if np.abs(values).max() < 2 else f"{value:.0f}"
        axes.text(j, i, text, ha="center", va="center", color="white" if value < middle else "black", fontsize=8)
    axes.set_xticks(range(size), names, fontsize=8)
    axes.set_yticks(range(size), names, fontsize=8)
    axes.set_ylabel(labels[0])
    axes.set_xlabel(labels[1])
    axes.set_title(title, fontsize=10)
    figure.colorbar(image)
    save_figure(figure, path)
