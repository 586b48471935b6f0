"""Figures of datasets, histories and layouts, and pictures for notebooks; drawing needs the extra `plot`."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Iterable, Sequence
from html import escape
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.benchmark.facts import SOURCES
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.overcooked.actions import DOWN
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.render import draw_frame, encode_episode
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD
from icrl4aht_data.overcooked.state import initial_record
from icrl4aht_data.utils.files import atomic_write, write_atomically
from icrl4aht_data.utils.install_hints import import_optional, install_command
from icrl4aht_data.utils.text import counted_histories

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg", ".pdf")
"""Accepted suffixes of a figure's file name."""

_CURVE_PARTS = 25  # maximum number of points of a learning curve

MOST_PANELS = 12
"""Number of panels above which a figure draws smaller panels, or averages over layouts."""


class Picture:
    """A figure or an animation that notebooks display; `save` writes the picture to a file.

    Args:
        title: what the picture shows, in words.
        content: a matplotlib figure, or the content of a GIF file.

    Attributes:
        title: what the picture shows, in words.
        figure: the matplotlib figure; None for an animation.
    """

    def __init__(self, title: str, content: Figure | bytes) -> None:
        self.title = title
        self._content = content

    @property
    def figure(self) -> Figure | None:
        """The matplotlib figure, which may be changed before the picture is shown; None for an animation."""
        return None if isinstance(self._content, bytes) else self._content

    def __repr__(self) -> str:
        suffixes = ", ".join(PICTURES) if self.figure else ".gif"
        return f"Picture({self.title}; notebooks show it, .save(path) writes it: {suffixes})"

    def _repr_html_(self) -> str:
        """Return the picture as an HTML element, for notebooks."""
        content, kind = self._content, "gif"
        if not isinstance(content, bytes):
            drawn = BytesIO()
            content.savefig(drawn, dpi=110, format="png")
            content, kind = drawn.getvalue(), "png"
        data = b64encode(content).decode()
        return f'<img alt="{escape(self.title)}" style="max-width:100%" src="data:image/{kind};base64,{data}">'

    def save(self, path: str | Path) -> None:
        """Write the picture to a file atomically.

        Raises:
            OptionError: if the path does not end in .gif (animation), or in .png, .svg or .pdf (figure).
        """
        target = Path(path)
        if not isinstance(self._content, bytes):
            save_figure(self._content, target)
            return
        _check_suffix(target, (".gif",))
        write_atomically(target, self._content)


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Return the running mean of `values` (E,) over `window` values, or fewer at the ends, as float64 (E,)."""
    width = max(1, window)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    numbers = np.arange(len(values))
    start, stop = np.maximum(numbers - width // 2, 0), np.minimum(numbers + (width + 1) // 2, len(values))
    return (sums[stop] - sums[start]) / (stop - start)


def axis_limits(values: Iterable[float]) -> tuple[float, float]:
    """Return the limits of a plot axis that shows 0 and all given returns, and spans at least one delivery's reward.

    Small variations of an almost constant return are therefore not magnified.
    """
    found = [0.0, *values]
    low, high = min(found), max(found)
    high = max(high, low + DELIVERY_REWARD)
    margin = 0.04 * (high - low)
    return low - margin, high + margin


def plot_history(returns: np.ndarray, title: str, expert_return: float | None = None) -> Figure:
    """Plot a history's learning curve: the return of each episode, and the running mean over 5 % of the episodes.

    Args:
        returns: real (E,), each episode's return.
        title: title of the figure.
        expert_return: return per episode of the expert policy, drawn as a line; None draws no line.

    Raises:
        OptionError: if matplotlib is not installed.
    """
    figure, (axes,) = _panels(1, (5.6, 3.3), 1)
    episodes, window = np.arange(1, len(returns) + 1), max(1, len(returns) // 20)
    axes.plot(episodes, returns, color="C0", alpha=0.3, linewidth=0.8, label="each episode")
    axes.plot(episodes, running_mean(returns, window), color="C0", label=f"running mean over {window}")
    if expert_return is not None:
        axes.axhline(expert_return, color="C1", linestyle="--", linewidth=1, label="expert, acting greedily")
    axes.set_ylim(*axis_limits([*map(float, returns), expert_return or 0.0]))
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("episode")
    axes.set_ylabel("return of the kept steps")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False)
    return figure


def animate_episode(
    layout: Layout, records: np.ndarray, rewards: np.ndarray, title: str, *, cell: int = 32, fps: int = 8
) -> Picture:
    """Return an episode as an animated GIF, which notebooks play.

    Args:
        layout: the layout.
        records: state records uint8 (T, S) in order.
        rewards: real (T,), the reward of the step taken in each record's state.
        title: what the animation shows, in words.
        cell: side of a map cell in pixels, 16 to 128.
        fps: frames per second, 1 to 50.

    Raises:
        OptionError: for an impossible `cell` or `fps`, or if Pillow is not installed.
    """
    return Picture(title, encode_episode(layout, records, rewards, cell=cell, fps=fps))


def plot_learning_curves(dataset: Iterable[Any], path: Path | None = None) -> Figure:
    """Plot the return by episode for every source of a selection, see `plot_source_curves`.

    The generated layouts of a family share a curve. The figure is written to a file if a path is given.

    Raises:
        OptionError: if matplotlib is not installed, or the path does not end in .png, .svg or .pdf.
    """
    curves: SourceCurves = {}
    for history in dataset:
        entry = history.entry
        add_curve(curves, entry.source, layout_title(entry.layout), entry.split, history.returns())
    figure = plot_source_curves(curves)
    if path is not None:
        save_figure(figure, path, dpi=80)
    return figure


_SPLIT_LINES = {"train": "-", "validation": "--"}

SourceCurves = dict[str, dict[tuple[str, str], list[np.ndarray]]]
"""Source -> (layout, split) -> list with the episode returns (E,) of each history."""


def add_curve(curves: SourceCurves, source: str, layout: str, split: str, returns: np.ndarray) -> None:
    """Add a history's episode returns (E,) to the curves of the history's source, layout and split."""
    curves.setdefault(source, {}).setdefault((layout, split), []).append(returns)


def plot_source_curves(curves: SourceCurves) -> Figure:
    """Plot mean returns by episode, on a logarithmic axis, with one panel for each source.

    A thin line is the mean of a layout's training histories. The thick solid line is the mean of all training
    histories, with a band from the 10th to the 90th percentile; thick dashed or dotted lines are means of other splits.
    A mean ends with the shortest history. Episodes are averaged in at most 25 blocks of equal length on the axis.

    Raises:
        OptionError: if matplotlib is not installed.
    """
    sources = sorted(curves, key=lambda source: (*SOURCES, source).index(source))
    figure, grid = _panels(len(sources), (5.0, 3.2), columns=min(2, len(sources)))
    titles = list(dict.fromkeys(layout for of_source in curves.values() for layout, split in of_source))
    ends: list[float] = []
    for axes, source in zip(grid, sources, strict=True):
        by_split: dict[str, list[np.ndarray]] = {}
        for (layout, split), histories in curves[source].items():
            by_split.setdefault(split, []).extend(histories)
            if split == "train":
                number = titles.index(layout)
                style = {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else "-.", "linewidth": 0.9}
                axes.plot(*_mean_by_episode(histories)[:2], label=layout, **style)
        for split, histories in by_split.items():
            episodes, mean, low, high = _mean_by_episode(histories)
            style = _SPLIT_LINES.get(split, ":")
            axes.plot(episodes, mean, style, label=f"all of split {split}", color="black", linewidth=2)
            if split == "train":
                axes.fill_between(episodes, low, high, alpha=0.15, linewidth=0, color="black")
        ends += list(axes.dataLim.intervaly)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        if axes.dataLim.x1 < 10:  # otherwise the axis would have a single tick label
            axes.xaxis.set_minor_formatter("{x:g}")
        axes.set_title(f"source {source}, {counted_histories(sum(map(len, by_split.values())))}", fontsize=9)
        axes.set_xlabel("episode", fontsize=8)
        axes.tick_params(which="both", labelsize=7)
        axes.grid(alpha=0.3)
    for axes in grid:
        axes.set_ylim(*axis_limits(ends))
    figure.suptitle("Return of the kept steps by episode (band: 10th to 90th percentile of histories)", fontsize=9)
    add_legend_below(figure)
    return figure


def _mean_by_episode(histories: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return centres of blocks of episodes, and mean, 10th and 90th percentile of returns, each float64 (blocks,)."""
    length = min(map(len, histories))
    episodes, means = average_in_blocks(np.stack([own[:length] for own in histories]))
    low, high = np.percentile(means, (10, 90), axis=0)
    return episodes, means.mean(axis=0), low, high


def average_in_blocks(returns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average returns over episode blocks of equal width on a logarithmic axis.

    Args:
        returns: returns by episode, float64 (N, E).

    Returns:
        The centres of the B blocks, at most 25, float64 (B,), and the means, float64 (N, B).
    """
    starts = np.unique(np.geomspace(1, returns.shape[1] + 1, _CURVE_PARTS + 1).round().astype(int))
    means = np.add.reduceat(returns, starts[:-1] - 1, axis=1) / np.diff(starts)
    return np.sqrt(starts[:-1] * (starts[1:] - 1.0)), means


def plot_layouts(layouts: Sequence[Layout], titles: Sequence[str] | None = None) -> Figure:
    """Draw layouts at the start of an episode, with the ego in blue and the teammate in red.

    Args:
        layouts: the layouts; more than `MOST_PANELS` are drawn smaller.
        titles: a title for each layout; by default both names of the layout.

    Raises:
        OptionError: if matplotlib or Pillow is not installed.
    """
    size, columns = (4.6, 3.3), 2 if len(layouts) == 4 else min(3, len(layouts))
    if len(layouts) > MOST_PANELS:
        size, columns = (2.3, 2.0), 6
    figure, grid = _panels(len(layouts), size, columns)
    titles = titles or [f"{layout.name} ({layout.alias})" for layout in layouts]
    for axes, layout, title in zip(grid, layouts, titles, strict=True):
        positions = np.array([layout.agent_cells], np.uint8)
        (record,) = initial_record(layout, positions, np.full((1, 2), DOWN, np.uint8), layout.recipe_items[:1])
        axes.imshow(draw_frame(layout, record, view=False))
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    return figure


def _check_suffix(path: Path, suffixes: Collection[str]) -> None:
    if path.suffix not in suffixes:
        raise OptionError(f"{path}: expected a name that ends in {', '.join(suffixes)}")


def _panels(count: int, size: tuple[float, float], columns: int) -> tuple[Figure, list[Any]]:
    """Return a figure and a list of `count` axes, each `size` inches (width, height)."""
    rows = -(-count // columns)
    figure = new_figure(size[0] * columns, size[1] * rows)
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def can_draw() -> bool:
    """Return whether matplotlib and Pillow are installed."""
    return all(find_spec(name) for name in ("matplotlib", "PIL"))


def check_can_draw() -> None:
    """Check that matplotlib and Pillow are installed; call this before long work that ends with a figure.

    Raises:
        OptionError: if matplotlib or Pillow is not installed.
    """
    if not can_draw():
        raise OptionError(f"drawing needs matplotlib and Pillow: {install_command('plot')}")


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of the given size in inches, with matplotlib's constrained layout.

    Raises:
        OptionError: if matplotlib is not installed.
    """
    return import_optional("matplotlib.figure", "drawing").Figure(figsize=(width, height), layout="constrained")


def add_legend_below(figure: Figure) -> None:
    """Add one legend of all axes at the bottom of a figure, in as many columns as fit its width, at most 5."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    entries = {
        label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    renderer = FigureCanvasAgg(figure).get_renderer()
    for columns in range(min(5, len(entries)), 0, -1):
        options = {"loc": "outside lower center", "ncols": columns, "fontsize": 9, "frameon": False}
        legend = figure.legend(entries.values(), entries.keys(), **options)
        if columns == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        legend.remove()


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure atomically, in the format of the path's suffix.

    Raises:
        OptionError: if the path does not end in .png, .svg or .pdf.
    """
    _check_suffix(path, PICTURES)
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=dpi, format=path.suffix.removeprefix("."))
