"""Pictures of a dataset. Needs the extra `plot`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.benchmark.reference_returns import HEURISTICS, Cell, has_headroom
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import Entry
from icrl4aht_data.overcooked.actions import DOWN
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.render import draw_frame
from icrl4aht_data.overcooked.state import start
from icrl4aht_data.utils.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg", ".pdf")
"""What the name of a picture may end in."""


def plot_learning_curves(dataset: Dataset, path: Path) -> None:
    """Return per episode of every task in the selection: mean over streams, band between the 10th and 90th percentile.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    _plot_histories(dataset, path, lambda e: (e.task_id, f"{e.layout} with {e.teammate_kind}"), lambda e: "mean")


def plot_layout_curves(dataset: Dataset, path: Path) -> None:
    """Return per episode on every layout in the selection, a curve for each split and kind of teammate, as above.

    Raises:
        OptionError: as above.
    """
    _plot_histories(dataset, path, lambda e: (e.layout, e.layout), lambda e: f"{e.split}, {e.teammate_kind}: mean")


def _plot_histories(
    dataset: Dataset, path: Path, panel: Callable[[Entry], tuple[str, str]], curve: Callable[[Entry], str]
) -> None:
    """Panels by key and title, in each a curve for each label."""
    panels: dict[tuple[str, str], dict[str, list[np.ndarray]]] = {}
    for history in dataset:
        panels.setdefault(panel(history.entry), {}).setdefault(curve(history.entry), []).append(history.returns())
    alike, seen = Counter(title for _, title in panels), Counter()
    drawn = []
    for (_, title), curves in panels.items():
        seen[title] += 1
        number = f", {seen[title]}" if alike[title] > 1 else ""
        streams = {f"{label} of {len(of_label)} streams": _cut(of_label) for label, of_label in curves.items()}
        drawn.append((title + number, streams))
    plot_curves(path, drawn)


def _cut(streams: list[np.ndarray]) -> np.ndarray:
    """(N, E): all of them as long as the shortest."""
    length = min(map(len, streams))
    return np.stack([stream[:length] for stream in streams])


def plot_curves(path: Path, panels: Sequence[tuple[str, dict[str, np.ndarray]]]) -> None:
    """Panels of learning curves: title, and label -> returns (N streams, E episodes), drawn as mean and band.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    figure, grid = _panels(path, len(panels), (4.6, 3.3))
    for axes, (title, curves) in zip(grid, panels, strict=True):
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
    save_figure(figure, path, dpi=120)


def plot_layouts(layouts: Sequence[Layout], path: Path) -> None:
    """The layouts as an episode may start: the agents where the map puts them, ego blue, teammate red.

    Raises:
        OptionError: if matplotlib or Pillow is not installed, or the path does not end in .png, .svg or .pdf.
    """
    figure, grid = _panels(path, len(layouts), (4.6, 3.3))
    for axes, layout in zip(grid, layouts, strict=True):
        positions = np.array([layout.agent_cells], np.uint8)
        (record,) = start(layout, positions, np.full((1, 2), DOWN, np.uint8), layout.recipe_items[:1])
        axes.imshow(draw_frame(layout, record, view=False))
        axes.set_title(f"{layout.name} ({layout.alias})", fontsize=9)
        axes.set_axis_off()
    save_figure(figure, path, dpi=120)


def plot_headroom(cells: Mapping[Cell, Mapping[str, float]], layouts: Sequence[str], path: Path) -> None:
    """By how much the oracle's mean return exceeds that of an ego that stays, for each test layout and family.

    Args:
        cells: see `headroom.read_headroom`.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    figure, (axes,) = _panels(path, 1, (3.4 + 0.9 * len(layouts), 3.3))
    gains = np.array([[cells[n, f]["oracle"] - cells[n, f]["stay"] for n in layouts] for f in HEURISTICS])
    brightest = max(10.0, gains.max())
    axes.imshow(gains, cmap="viridis", vmin=0, vmax=brightest, aspect="auto")
    for (row, family), (column, name) in product(enumerate(HEURISTICS), enumerate(layouts)):
        text = f"{gains[row, column]:.1f}" if has_headroom(cells[name, family]) else "none"
        colour = "white" if gains[row, column] < brightest / 2 else "black"
        axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=9)
    axes.set_xticks(range(len(layouts)), layouts, fontsize=8, rotation=20, ha="right")
    axes.set_yticks(range(len(HEURISTICS)), HEURISTICS)
    axes.set_ylabel("test teammates")
    axes.set_title("Return of the oracle minus that of an ego that stays", fontsize=9)
    save_figure(figure, path, dpi=120)


def _panels(path: Path, count: int, size: tuple[float, float]) -> tuple[Figure, list[Any]]:
    """A figure with that many axes of that many inches, to be saved at `path`."""
    if path.suffix not in PICTURES:
        raise OptionError(f"{path}: expected a name that ends in {', '.join(PICTURES)}")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OptionError("drawing needs matplotlib: pip install 'icrl4aht-data[plot]'") from error
    columns = 2 if count == 4 else min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def legend_below(figure: Figure) -> None:
    """One legend for all axes, in as many columns as fit the figure's width."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    entries = {
        label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    renderer = FigureCanvasAgg(figure).get_renderer()
    for columns in range(min(5, len(entries)), 0, -1):
        place = {"loc": "outside lower center", "ncols": columns}
        legend = figure.legend(entries.values(), entries.keys(), fontsize=9, frameon=False, **place)
        if columns == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        legend.remove()


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure, in the format that the path's suffix names."""
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=dpi, format=path.suffix.removeprefix("."))
