"""Figures of populations of teammates."""

from __future__ import annotations

import json
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
