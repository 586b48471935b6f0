"""Charts of the report's page as plain numbers, which the templates draw: bars of cells, and panels of curves.

Positions are per cent of a chart's width and height, from its top left corner.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from icrl4aht_baselines.plotting import smooth_returns
from icrl4aht_baselines.report.headline import paper_scores
from icrl4aht_baselines.report.intervals import bootstrap_interval
from icrl4aht_baselines.report.results import (
    EvaluationRun,
    cell_order,
    family_of,
    group_of,
    group_title,
    normalise,
    normalised_score,
)
from icrl4aht_baselines.report.tables import SweepPoint
from icrl4aht_data.benchmark.reference_returns import REFERENCES, Cell, has_headroom, read_headroom
from icrl4aht_data.plotting import return_limits

_SCORE_LIMITS = (-0.5, 1.5)  # a cell with little headroom can have a score far outside, which is clipped
_TICKS = 5
_DRAWING = 1000  # units of a panel's width and height


class Tick(NamedTuple):
    """A labelled position on an axis."""

    position: float
    label: str


class Bar(NamedTuple):
    """A bar of one run, from `start` to `start` + `width`.

    Attributes:
        series: number of the run, which has one colour on the whole page.
        start, width: where the bar is.
        interval: ends of the 95 % interval; None for a single instance.
        text: the value.
        tooltip: the run, the value and its interval in words.
        clipped: whether the value lies outside the chart.
    """

    series: int
    start: float
    width: float
    interval: tuple[float, float] | None
    text: str
    tooltip: str
    clipped: bool


class Mark(NamedTuple):
    """A marked position, such as the paper's number.

    Attributes:
        name: what is marked.
        left, top: where it is.
        tooltip: name and number in words.
        series: number of the run whose colour it has.
    """

    name: str
    left: float
    top: float
    tooltip: str
    series: int = 0


class BarRow(NamedTuple):
    """The bars of all runs in one cell.

    Attributes:
        label: teammates of the cell.
        scale: the returns at the ends of the scale, as text.
        bars: a bar for each run.
        marks: the paper's numbers.
    """

    label: str
    scale: str
    bars: list[Bar]
    marks: list[Mark]


class BarChart(NamedTuple):
    """Bars of several cells on one scale.

    Attributes:
        ticks: labelled positions of the scale.
        layouts: layout -> rows.
        marks: names of what is marked, in order.
        left_out: sentences on cells that are not drawn.
    """

    ticks: list[Tick]
    layouts: dict[str, list[BarRow]]
    marks: list[str]
    left_out: list[str]


class Curve(NamedTuple):
    """A curve of one run in a panel, as path data of an SVG 1000 units wide and high.

    Attributes:
        series: number of the run.
        line: the curve.
        raw: the curve before smoothing; empty if there is none.
        band: outline of the range around the curve; empty if there is none.
    """

    series: int
    line: str
    raw: str = ""
    band: str = ""


class Panel(NamedTuple):
    """One panel of a figure.

    Attributes:
        title: what it shows.
        curves: a curve for each run.
        marks: marked points.
    """

    title: str
    curves: list[Curve]
    marks: list[Mark]


class PanelFigure(NamedTuple):
    """Panels with shared axes.

    Attributes:
        panels: at most `plotting.MOST_PANELS`.
        x_ticks, y_ticks: labelled positions of the axes.
        x_label: what the horizontal axis is.
    """

    panels: list[Panel]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    x_label: str


def score_bars(runs: Mapping[int, EvaluationRun], protocol: str) -> BarChart | None:
    """Returns bars from `stay` to the agents' normalised scores, with the paper's where the protocol matches.

    Args:
        runs: number of the series -> run.
        protocol: of the runs.

    Returns:
        Rows of the cells with headroom that a run played completely; None if there is none.
    """
    headroom = read_headroom(protocol)
    found = {
        number: {cell: normalised_score(run, cell, headroom) for cell in run.cells} for number, run in runs.items()
    }
    scores = {n: {cell: value for cell, value in of.items() if value is not None} for n, of in found.items()}
    cells = sorted({cell for of_run in scores.values() for cell in of_run}, key=cell_order)
    if not cells:
        return None
    stated = {
        cell: {
            name: value for run in runs.values() if cell in run.cells for name, value in paper_scores(run, cell).items()
        }
        for cell in cells
    }
    values = [value for of in (*scores.values(), *stated.values()) for value in of.values()]
    scale = _Scale(max(_SCORE_LIMITS[0], min(-0.05, *values)), min(_SCORE_LIMITS[1], max(1.05, *values)))
    layouts: dict[str, list[BarRow]] = {}
    for cell in cells:
        references = headroom[cell]
        bars = [_bar(number, run, cell, scale, references) for number, run in runs.items() if cell in scores[number]]
        marks = [
            Mark(name, scale.clip(value), 0, f"the paper's {name}: {value:z.2f}")
            for name, value in stated[cell].items()
        ]
        ends = f"{references['stay']:z.1f} to {references['oracle']:z.1f}"
        layouts.setdefault(cell[0], []).append(BarRow(cell[1], ends, bars, marks))
    names = dict.fromkeys(name for of_cell in stated.values() for name in of_cell)
    tested = [cell for cell in _played(runs) if cell in headroom]
    flat = [cell for cell in tested if not has_headroom(headroom[cell])]
    partial = [cell for cell in tested if cell not in flat and cell not in cells]
    reasons = {"The oracle earns no more than an ego that stays": flat, "Not all tasks were played": partial}
    left_out = [f"{why}: {', '.join(map(' '.join, of_why))}." for why, of_why in reasons.items() if of_why]
    ticks = [Tick(scale.position(0), "stay"), Tick(scale.position(1), "oracle")]
    return BarChart(ticks, layouts, list(names), left_out)


def return_bars(runs: Mapping[int, EvaluationRun], kind: str) -> BarChart | None:
    """Returns bars from 0 to the mean returns, for the cells of one kind of tasks; None if there is none."""
    cells = [cell for cell in _played(runs) if group_of(cell) == kind]
    if not cells:
        return None
    means = [float(run.means(cell).mean()) for run in runs.values() for cell in cells if cell in run.cells]
    scale = _Scale(*return_limits(means))
    layouts: dict[str, list[BarRow]] = {}
    for cell in cells:
        bars = [_bar(number, run, cell, scale) for number, run in runs.items() if cell in run.cells]
        layouts.setdefault(cell[0], []).append(BarRow(group_title(family_of(cell)), "", bars, []))
    return BarChart(scale.ticks(), layouts, [], [])


def _played(runs: Mapping[int, EvaluationRun]) -> list[Cell]:
    return sorted({cell for run in runs.values() for cell in run.cells}, key=cell_order)


def _bar(
    number: int, run: EvaluationRun, cell: Cell, scale: _Scale, references: Mapping[str, float] | None = None
) -> Bar:
    """Returns the bar of a run in a cell.

    Args:
        number: of the series.
        run, cell: what is drawn.
        scale: the axis.
        references: reference ego -> its return in a cell with headroom, on an axis of normalised scores; None for an
            axis of returns.
    """
    means = run.means(cell)
    values = means if references is None else normalise(means, references)
    value, digits = float(values.mean()), 1 if references is None else 2
    text, interval = f"{value:z.{digits}f}", None
    tooltip = f"{run.label}: {text}"
    if len(values) > 1:
        low, high = bootstrap_interval(values, np.random.default_rng(0))
        interval = scale.clip(low), scale.clip(high)
        tooltip += f" (95 % interval {low:z.{digits}f} to {high:z.{digits}f})"
    if references is not None:
        stay, oracle = references["stay"], references["oracle"]
        tooltip += f"; return {means.mean():z.1f}, stay {stay:z.1f}, oracle {oracle:z.1f}"
    zero, end = scale.position(0), scale.clip(value)
    return Bar(number, min(zero, end), abs(end - zero), interval, text, tooltip, not scale.low <= value <= scale.high)


def curve_figure(runs: Mapping[int, EvaluationRun], cells: Sequence[Cell]) -> PanelFigure:
    """Returns a panel per cell with each run's return per episode, on shared axes.

    Lines are running means of the mean over a cell's instances; bands are the range of the instances' running means.
    """
    drawn = [(number, cell, run.cells[cell]) for number, run in runs.items() for cell in cells if cell in run.cells]
    smooth = {
        (number, cell): np.stack([smooth_returns(returns) for returns in of_cell]) for number, cell, of_cell in drawn
    }
    raw = {(number, cell): of_cell.mean(axis=0) for number, cell, of_cell in drawn}
    y = _Scale(*return_limits(float(value) for found in (*smooth.values(), *raw.values()) for value in found.flat))
    episodes = max(returns.shape[1] for _, _, returns in drawn)
    x = _Scale(1, max(2, episodes))
    panels = []
    for cell in cells:
        curves = [
            _curve(number, smooth[number, cell], raw[number, cell], x, y) for number in runs if (number, cell) in raw
        ]
        panels.append(Panel(_cell_title(cell), curves, []))
    return PanelFigure(panels, _episode_ticks(x, episodes), y.ticks(vertical=True), "episode")


def _curve(number: int, smooth: np.ndarray, raw: np.ndarray, x: _Scale, y: _Scale) -> Curve:
    episodes = np.arange(1, len(raw) + 1)
    if len(raw) == 1:  # a point has no line
        episodes, smooth, raw = np.array([1, 2]), smooth.repeat(2, axis=1), raw.repeat(2)
    low, high = smooth.min(axis=0), smooth.max(axis=0)
    outline = np.concatenate([episodes, episodes[::-1]]), np.concatenate([low, high[::-1]])
    is_range = len(smooth) > 1
    return Curve(
        number,
        _path(episodes, smooth.mean(axis=0), x, y),
        _path(episodes, raw, x, y) if not np.array_equal(raw, smooth.mean(axis=0)) else "",
        f"{_path(*outline, x, y)}Z" if is_range else "",
    )


def sweep_figure(panels: Mapping[str, Mapping[str, Sequence[SweepPoint]]], quantity: str) -> PanelFigure:
    """Returns a panel per layout with the return over the varied quantity, a curve per agent.

    Bands are one standard deviation to both sides, marks the paper's numbers.
    """
    points = [point for lines in panels.values() for of_agent in lines.values() for point in of_agent]
    names = list(dict.fromkeys(str(point.value) for point in points))
    agents = list(dict.fromkeys(agent for lines in panels.values() for agent in lines))
    ends = [value for p in points for value in (p.mean - (p.std or 0), p.mean + (p.std or 0), p.published or 0.0)]
    x, y = _Scale(-0.3, len(names) - 0.7), _Scale(*return_limits(ends))
    drawn = []
    for layout, lines in panels.items():
        curves, marks = [], []
        for agent, of_agent in lines.items():
            at = np.array([names.index(str(point.value)) for point in of_agent], float)
            mean, std = np.array([(point.mean, point.std or 0.0) for point in of_agent]).T
            outline = np.concatenate([at, at[::-1]]), np.concatenate([mean - std, (mean + std)[::-1]])
            curves.append(Curve(agents.index(agent), _path(at, mean, x, y), band=f"{_path(*outline, x, y)}Z"))
            marks += [
                Mark(
                    name,
                    x.position(number),
                    round(100 - y.position(value), 2),
                    f"{agent}, {quantity} = {point.value}: {text}",
                    agents.index(agent),
                )
                for number, point in zip(at, of_agent, strict=True)
                for name, value, text in _sweep_marks(point)
            ]
        drawn.append(Panel(layout, curves, marks))
    ticks = [Tick(x.position(number), name) for number, name in enumerate(names)]
    return PanelFigure(drawn, ticks, y.ticks(vertical=True), quantity)


def _sweep_marks(point: SweepPoint) -> Iterable[tuple[str, float, str]]:
    yield "ours", point.mean, f"{point.mean:z.1f}"
    if point.published is not None:
        yield "paper", point.published, f"the paper's {point.published:z.1f}"


def reported_series(runs: Mapping[int, EvaluationRun]) -> dict[int, EvaluationRun]:
    """Returns the runs whose scores are worth a bar, by their number: not those of a sweep, nor reference egos unless
    there are no others."""
    plain = {number: run for number, run in runs.items() if run.variant is None}
    agents = {number: run for number, run in plain.items() if run.agent not in REFERENCES}
    return agents or plain


def _cell_title(cell: Cell) -> str:
    return f"{cell[0]}, {group_title(cell[1])}"


class _Scale(NamedTuple):
    """Axis from `low` to `high`."""

    low: float
    high: float

    def position(self, value: float) -> float:
        """Returns where a value is, in per cent of the axis from its low end."""
        return round(100 * (value - self.low) / (self.high - self.low), 2)

    def clip(self, value: float) -> float:
        """Returns the position of a value, or the end of the axis that it lies beyond."""
        return self.position(min(max(value, self.low), self.high))

    def ticks(self, vertical: bool = False) -> list[Tick]:
        """Returns labelled positions at round numbers; from the top of a vertical axis."""
        step = 10 ** math.floor(math.log10((self.high - self.low) / _TICKS))
        step = next(step * factor for factor in (1, 2, 5, 10) if (self.high - self.low) / (step * factor) <= _TICKS)
        numbers = range(math.ceil(self.low / step), math.floor(self.high / step) + 1)
        found = [Tick(self.position(number * step), f"{number * step:g}") for number in numbers]
        return [Tick(round(100 - position, 2), label) for position, label in found] if vertical else found


def _episode_ticks(x: _Scale, episodes: int) -> list[Tick]:
    return [Tick(x.position(episode), str(episode)) for episode in dict.fromkeys((1, (episodes + 1) // 2, episodes))]


def _path(xs: np.ndarray, ys: np.ndarray, x: _Scale, y: _Scale) -> str:
    """Returns the path data of a line through some points."""
    columns = np.rint((xs - x.low) / (x.high - x.low) * _DRAWING).astype(int)
    rows = np.rint((y.high - ys) / (y.high - y.low) * _DRAWING).astype(int)
    return "M" + "L".join(f"{column} {row}" for column, row in zip(columns, rows, strict=True))
