"""Pictures of a dataset. Needs the extra `plot`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.files import file_in_place_of


def plot_learning_curves(dataset: Dataset, path: Path) -> None:
    """Return per episode of every task in the selection: mean over streams, band between the 10th and 90th percentile.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    tasks: dict[str, list[np.ndarray]] = {}
    titles = {}
    for history in dataset:
        entry = history.entry
        tasks.setdefault(entry.task_id, []).append(history.returns())
        titles[entry.task_id] = f"{entry.layout} with {entry.teammate_kind}"
    panels = {}
    for task_id, streams in tasks.items():
        length = min(map(len, streams))
        returns = np.stack([stream[:length] for stream in streams])
        panels[task_id] = {f"mean of {len(streams)} streams": returns}
    plot_curves(path, [(titles[task_id], curves) for task_id, curves in panels.items()])


def plot_curves(path: Path, panels: Sequence[tuple[str, dict[str, np.ndarray]]]) -> None:
    """Panels of learning curves: title, and label -> returns (N streams, E episodes), drawn as mean and band.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise OptionError(f"{path}: expected a name that ends in .png, .svg or .pdf")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OptionError("drawing needs matplotlib: pip install icrl4aht-data[plot]") from error
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.3 * rows), layout="constrained")
    for number, (title, curves) in enumerate(panels, start=1):
        axes = figure.add_subplot(rows, columns, number)
        for label, returns in curves.items():
            episodes = np.arange(1, returns.shape[1] + 1)
            low, high = np.percentile(returns, (10, 90), axis=0)
            (line,) = axes.plot(episodes, returns.mean(axis=0), label=label)
            axes.fill_between(episodes, low, high, alpha=0.25, linewidth=0, color=line.get_color())
        axes.set_title(f"{title} (band: 10th to 90th percentile)", fontsize=9)
        axes.set_xlabel("episode")
        axes.set_ylabel("return of the kept steps")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    with file_in_place_of(path) as partial:
        figure.savefig(partial, dpi=120, format=path.suffix.removeprefix("."))
