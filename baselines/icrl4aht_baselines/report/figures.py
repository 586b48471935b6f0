"""Charts of the report's page as plain numbers, which the templates draw: bars of cells, and panels of curves.

Positions are per cent of a chart's width and height, from its top left corner.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_baselines.plotting import smooth_returns
from icrl4aht_baselines.report.results import EvaluationRun, ResultCell, family_title
from icrl4aht_baselines.report.scores import CellScore, cell_headroom, cell_scores, paper_scores
from icrl4aht_baselines.report.statistics import mean_interval
from icrl4aht_data.benchmark.reference_returns import REFERENCES, has_headroom
from icrl4aht_data.plotting import return_limits

_SCORE_LIMITS = (-0.5, 1.5)  # a cell with little headroom can have a score far outside, which is clipped
_TICKS = 5
_DRAWING = 1000  # units of a panel's width and height

NumberedRuns = Mapping[int, EvaluationRun]
"""Number of a series, which has one colour on the whole page -> its run."""


class Tick(NamedTuple):
    """A labelled position on an axis."""

    position: float
    label: str


class Bar(NamedTuple):
    """A bar of one run, from `start` to `start` + `width`; `interval` has the ends of the 95 % interval."""

    series: int
    start: float
    width: float
    interval: tuple[float, float] | None
    text: str
    tooltip: str
    clipped: bool


class Mark(NamedTuple):
    """A marked position, such as the paper's number."""

    name: str
    left: float
    tooltip: str


class BarRow(NamedTuple):
    """The bars of all runs in one cell; `scale` has the returns at the ends of the scale, as text."""

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
    """A curve of one run, as path data of an SVG 1000 units wide and high: smoothed, as measured, and its range.

    `raw` and `band` are empty if there is nothing to draw.
    """

    series: int
    line: str
    raw: str = ""
    band: str = ""


class Panel(NamedTuple):
    """One panel of a figure."""

    title: str
    curves: list[Curve]


class PanelFigure(NamedTuple):
    """Panels with shared axes, which have labelled positions."""

    panels: list[Panel]
    x_ticks: list[Tick]
    y_ticks: list[Tick]


class _Scale(NamedTuple):
    """Axis from `low` to `high`."""

    low: float
    high: float

    def position(self, value: float) -> float:
        """Return the position of a value, in per cent of the axis from its low end; ends for values beyond them."""
        return round(100 * (min(max(value, self.low), self.high) - self.low) / (self.high - self.low), 2)

    def ticks(self, vertical: bool = False) -> list[Tick]:
        """Return labelled positions at round numbers; from the top of a vertical axis."""
        step = 10 ** math.floor(math.log10((self.high - self.low) / _TICKS))
        step = next(step * factor for factor in (1, 2, 5, 10) if (self.high - self.low) / (step * factor) <= _TICKS)
        numbers = range(math.ceil(self.low / step), math.floor(self.high / step) + 1)
        found = [Tick(self.position(number * step), f"{number * step:g}") for number in numbers]
        return [Tick(round(100 - position, 2), label) for position, label in found] if vertical else found


def reported_series(runs: NumberedRuns) -> dict[int, EvaluationRun]:
    """Return the runs whose scores are worth a bar: no reference egos unless there are no others."""
    return {number: run for number, run in runs.items() if run.agent not in REFERENCES} or dict(runs)


def score_bars(runs: NumberedRuns, protocol: str) -> BarChart | None:
    """Return bars from `stay` to the agents' normalised scores, with the paper's where the protocol matches.

    Returns:
        Rows of the cells with headroom that a run played completely; None if there is none.
    """
    scores = {
        number: {cell: score for cell, score in cell_scores(run).items() if score.normalised is not None}
        for number, run in runs.items()
    }
    played, cells = (dict.fromkeys(_in_order(found)) for found in (map(cell_scores, runs.values()), scores.values()))
    if not cells:
        return None
    stated = {
        cell: {name: at for run in runs.values() if cell in run.cells for name, at in paper_scores(run, cell).items()}
        for cell in cells
    }
    drawn = [score.normalised for of_run in scores.values() for score in of_run.values()]
    values = [float(found.mean()) for found in drawn if found is not None]
    values += [value for of_cell in stated.values() for value in of_cell.values()]
    scale = _Scale(max(_SCORE_LIMITS[0], min(-0.05, *values)), min(_SCORE_LIMITS[1], max(1.05, *values)))
    headroom = cell_headroom(protocol)
    layouts: dict[str, list[BarRow]] = {}
    for cell in cells:
        tips = {name: f"the paper's {name}: {value:z.2f}" for name, value in stated[cell].items()}
        marks = [Mark(name, scale.position(value), tips[name]) for name, value in stated[cell].items()]
        ends = f"{headroom[cell]['stay']:z.1f} to {headroom[cell]['oracle']:z.1f}"
        row = BarRow(cell.family, ends, _bars(runs, scores, cell, scale), marks)
        layouts.setdefault(cell.layout, []).append(row)
    flat = [cell for cell in played if cell in headroom and not has_headroom(headroom[cell])]
    partial = [cell for cell in played if cell in headroom and cell not in (*flat, *cells)]
    reasons = {"The oracle earns no more than an ego that stays": flat, "Not all tasks were played": partial}
    left_out = [f"{why}: {', '.join(f'{c.layout} {c.family}' for c in of)}." for why, of in reasons.items() if of]
    names = dict.fromkeys(name for of_cell in stated.values() for name in of_cell)
    ticks = [Tick(scale.position(0), "stay"), Tick(scale.position(1), "oracle")]
    return BarChart(ticks, layouts, list(names), left_out)


def return_bars(runs: NumberedRuns, kind: str) -> BarChart | None:
    """Return bars from 0 to the mean returns, for the cells of one kind of tasks; None if there is none."""
    scores = {
        number: {cell: score._replace(normalised=None) for cell, score in cell_scores(run).items() if cell.kind == kind}
        for number, run in runs.items()
    }
    cells = _in_order(scores.values())
    if not cells:
        return None
    scale = _Scale(*return_limits(float(score.means.mean()) for of_run in scores.values() for score in of_run.values()))
    layouts: dict[str, list[BarRow]] = {}
    for cell in cells:
        row = BarRow(family_title(cell.family), "", _bars(runs, scores, cell, scale), [])
        layouts.setdefault(cell.layout, []).append(row)
    return BarChart(scale.ticks(), layouts, [], [])


def _in_order(scores: Iterable[Iterable[ResultCell]]) -> list[ResultCell]:
    return sorted({cell for of_run in scores for cell in of_run}, key=lambda cell: cell.order)


def _bars(runs: NumberedRuns, scores: Mapping[int, Any], cell: ResultCell, scale: _Scale) -> list[Bar]:
    return [_bar(number, run, scores[number][cell], scale) for number, run in runs.items() if cell in scores[number]]


def _bar(number: int, run: EvaluationRun, score: CellScore, scale: _Scale) -> Bar:
    """Return the bar of a run in a cell, of its normalised score if it has one, otherwise of its return."""
    values, digits = (score.means, 1) if score.normalised is None else (score.normalised, 2)
    value, low, high = mean_interval(values)
    text = f"{value:z.{digits}f}"
    tooltip = f"{run.label}: {text}"
    if len(values) > 1:
        tooltip += f" (95 % interval {low:z.{digits}f} to {high:z.{digits}f})"
    if score.normalised is not None and score.references:
        egos = ", ".join(f"{name} {score.references[name]:z.1f}" for name in ("stay", "oracle"))
        tooltip += f"; return {score.means.mean():z.1f}, {egos}"
    zero, end = scale.position(0), scale.position(value)
    interval = (scale.position(low), scale.position(high)) if len(values) > 1 else None
    return Bar(number, min(zero, end), abs(end - zero), interval, text, tooltip, not scale.low <= value <= scale.high)


def curve_figure(runs: NumberedRuns, cells: Sequence[ResultCell]) -> PanelFigure:
    """Return a panel per cell with each run's return per episode, on shared axes.

    Lines are running means of the mean over a cell's instances; bands are the range of the instances' running means.
    """
    raw = {(number, cell): run.cells[cell] for number, run in runs.items() for cell in cells if cell in run.cells}
    smooth = {key: np.stack([smooth_returns(returns) for returns in of_cell]) for key, of_cell in raw.items()}
    drawn = [*smooth.values(), *(of_cell.mean(axis=0) for of_cell in raw.values())]
    y = _Scale(*return_limits(float(value) for found in drawn for value in found.flat))
    episodes = max(returns.shape[1] for returns in raw.values())
    x = _Scale(1, max(2, episodes))
    panels = []
    for cell in cells:
        keys = [(number, cell) for number in runs if (number, cell) in raw]
        panels.append(Panel(cell.title, [_curve(key[0], smooth[key], raw[key].mean(axis=0), x, y) for key in keys]))
    ticks = [Tick(x.position(number), str(number)) for number in dict.fromkeys((1, (episodes + 1) // 2, episodes))]
    return PanelFigure(panels, ticks, y.ticks(vertical=True))


def _curve(number: int, smooth: np.ndarray, raw: np.ndarray, x: _Scale, y: _Scale) -> Curve:
    if len(raw) == 1:  # a point has no line
        smooth, raw = smooth.repeat(2, axis=1), raw.repeat(2)
    episodes, mean = np.arange(1, len(raw) + 1), smooth.mean(axis=0)
    outline = np.concatenate([episodes, episodes[::-1]]), np.concatenate([smooth.min(axis=0), smooth.max(axis=0)[::-1]])
    return Curve(
        number,
        _path(episodes, mean, x, y),
        "" if np.array_equal(raw, mean) else _path(episodes, raw, x, y),
        f"{_path(*outline, x, y)}Z" if len(smooth) > 1 else "",
    )


def _path(xs: np.ndarray, ys: np.ndarray, x: _Scale, y: _Scale) -> str:
    """Return the path data of a line through some points."""
    columns = np.rint((xs - x.low) / (x.high - x.low) * _DRAWING).astype(int)
    heights = np.rint((y.high - ys) / (y.high - y.low) * _DRAWING).astype(int)
    return "M" + "L".join(f"{column} {height}" for column, height in zip(columns, heights, strict=True))
