"""Pictures of training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from icrl4aht_data.plotting import save_figure

_LEFT_OUT = ("step", "part")


def plot_run(metrics: Path, path: Path, title: str) -> None:
    """Every number of a run's log over the training steps, one panel each, training beside what was held out."""
    lines = [json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines()]
    names = list(dict.fromkeys(name for line in lines for name in line if name not in _LEFT_OUT))
    parts = list(dict.fromkeys(line["part"] for line in lines))
    columns = min(3, len(names))
    figure = Figure(figsize=(4.6 * columns, 3.1 * -(-len(names) // columns)), layout="constrained")
    panels: list[Any] = [*figure.subplots(-(-len(names) // columns), columns, squeeze=False).flat]
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
