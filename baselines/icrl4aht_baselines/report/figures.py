"""Bar charts and panels of curves for the report's page, as numbers that the page's template draws.

Positions are in per cent of a chart's width and height, from its top left corner.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import groupby
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from icrl4aht_baselines.report.results import (
    TASK_KINDS,
    EvaluationRun,
    ResultCell,
    family_title,
    mean_over_cells,
    sorted_cells,
)
from icrl4aht_baselines.report.scores import cell_scales, find_score, mean_return, scored_cells
from icrl4aht_baselines.report.statistics import MeanInterval
from icrl4aht_baselines.training.seen import overlap_marks
from icrl4aht_data.benchmark.reference_returns import REFERENCES
from icrl4aht_data.plotting import axis_limits, running_mean

SMOOTHING = 10
"""Largest number of episodes in a curve's running mean; shorter curves use a tenth of their episodes."""

# Scores beyond these limits are clipped. Such scores occur where a best response earns little more than `stay`.
_SCORE_LIMITS = (-0.5, 1.5)
_TICKS = 5
_DRAWING = 1000  # units of a panel's width and height

NumberedRuns = Mapping[int, EvaluationRun]
"""Number of a series, which determines its colour on the page -> run of the series."""


class Tick(NamedTuple):
    """Labelled position on an axis."""

    position: float
    label: str


class Bar(NamedTuple):
    """Bar of one run, from `start` to `start` + `width`; `interval` has the ends of the 95 % interval, if any."""

    series: int
    start: float
    width: float
    interval: tuple[float, float] | None
    text: str
    tooltip: str


class BarRow(NamedTuple):
    """Bars of all runs for one layout and family; `scale` states the returns at the ends of the axis, as text."""

    label: str
    bars: list[Bar]
    scale: str = ""


class Curve(NamedTuple):
    """Curve of one run, as path data of an SVG of 1000 x 1000 units.

    `line` is the smoothed curve, `raw` the curve without smoothing, and `band` the range over the tasks.
    `raw` and `band` are empty if there is nothing to draw.
    """

    series: int
    line: str
    raw: str = ""
    band: str = ""


class Chart(NamedTuple):
    """Figure of the page: bars for each layout and family, or panels of curves, on shared axes.

    Attributes:
        title: text above the figure.
        caption: text below the figure; may be empty.
        series: number and label of each run in the figure; labels have symbols for overlap with training data.
        x_ticks: labelled positions on the horizontal axis.
        y_ticks: labelled positions on the vertical axis; empty for bars.
        bars: layout -> rows of bars.
        panels: title of a panel -> curves.
    """

    title: str
    caption: str
    series: list[tuple[int, str]]
    x_ticks: list[Tick]
    y_ticks: Sequence[Tick] = ()
    bars: Mapping[str, list[BarRow]] = MappingProxyType({})
    panels: Mapping[str, list[Curve]] = MappingProxyType({})


class _Scale(NamedTuple):
    """Scale of an axis from `low` to `high`."""

    low: float
    high: float

    def position(self, value: float) -> float:
        """Return the position of a value, in per cent of the axis from its low end; values outside are clipped."""
        return round(100 * (min(max(value, self.low), self.high) - self.low) / (self.high - self.low), 2)

    def ticks(self) -> list[Tick]:
        """Return labelled positions at round values of the axis."""
        step = 10 ** math.floor(math.log10((self.high - self.low) / _TICKS))
        step = next(step * factor for factor in (1, 2, 5, 10) if (self.high - self.low) / (step * factor) <= _TICKS)
        numbers = range(math.ceil(self.low / step), math.floor(self.high / step) + 1)
        return [Tick(self.position(number * step), f"{number * step:g}") for number in numbers]


def bar_charts(runs: NumberedRuns, protocol: str) -> list[Chart]:
    """Return bar charts of the scores, and of the returns in tasks without scores.

    Charts of test tasks leave out reference egos, unless there are no other agents.
    """
    agents = {number: run for number, run in runs.items() if run.agent not in REFERENCES} or runs
    charts = _score_charts(agents, protocol)
    for kind, about in TASK_KINDS.items():
        shown = agents if kind == "test" else runs
        values = {
            number: {cell: mean_return([found]) for cell, found in run.returns.items() if cell.kind == kind}
            for number, run in shown.items()
        }
        if any(values.values()) and not (kind == "test" and charts):
            scale = _Scale(*axis_limits(found.mean for of_run in values.values() for found in of_run.values()))
            charts.append(_bar_chart(f"Return in each cell, {kind} tasks", shown, values, scale, about))
    return charts


def _score_charts(runs: NumberedRuns, protocol: str) -> list[Chart]:
    """Return a list with the bar chart of the agents' scores; an empty list if there are no scores."""
    scales = cell_scales(protocol)
    values = {
        number: {
            cell: score.total
            for cell in scored_cells(run, run.returns, scales)
            if cell.kind == "test" and (score := find_score(run.returns, [cell], scales))
        }
        for number, run in runs.items()
    }
    cells = sorted_cells(cell for of_run in values.values() for cell in of_run)
    if not cells:
        return []
    ends = [found.mean for of_run in values.values() for found in of_run.values()]
    scale = _Scale(max(_SCORE_LIMITS[0], min(-0.05, *ends)), min(_SCORE_LIMITS[1], max(1.05, *ends)))
    played = sorted_cells(cell for run in runs.values() for cell in run.cells if cell.kind == "test")
    without = [f"{cell.layout} {cell.family}" for cell in played if cell not in cells]
    about = (
        "A bar runs from the return of an ego that stays to that of the agent, relative to the best response; next to "
        "a family are the returns of both. *: beyond the chart."
        + (f" Without a score, the tables say why: {', '.join(without)}." if without else "")
    )
    ranges = {cell: f"{scales[cell].stay:z.1f} to {scales[cell].best:z.1f}" for cell in cells}
    chart = _bar_chart("Score in each cell", runs, values, scale, about, ranges, digits=2)
    return [chart._replace(x_ticks=[Tick(scale.position(0), "stay"), Tick(scale.position(1), "best response")])]


def _bar_chart(
    title: str,
    runs: NumberedRuns,
    values: Mapping[int, Mapping[ResultCell, MeanInterval]],
    scale: _Scale,
    about: str,
    ranges: Mapping[ResultCell, str] = MappingProxyType({}),
    digits: int = 1,
) -> Chart:
    """Return a chart with bars from 0 to each value; `ranges` has the returns at the ends of each scale, as text."""
    shown = {number: run for number, run in runs.items() if values[number]}
    bars: dict[str, list[BarRow]] = defaultdict(list)
    cells = sorted_cells(cell for of_run in values.values() for cell in of_run)
    for cell in cells:
        of_cell = {number: values[number][cell] for number in shown if cell in values[number]}
        drawn = [_make_bar(number, shown[number], cell, found, scale, digits) for number, found in of_cell.items()]
        bars[cell.layout].append(BarRow(family_title(cell.family), drawn, ranges.get(cell, "")))
    several = any(bar.interval for rows in bars.values() for row in rows for bar in row.bars)
    lines = ["Lines: 95 % intervals over behaviours, or over seeds."] * several
    return Chart(title, " ".join([*lines, about]).rstrip(), _labelled_series(shown, cells), scale.ticks(), bars=bars)


def _make_bar(
    number: int, run: EvaluationRun, cell: ResultCell, found: MeanInterval, scale: _Scale, digits: int
) -> Bar:
    returns = run.returns[cell]
    zero, end = scale.position(0), scale.position(found.mean)
    clipped = "" if scale.low <= found.mean <= scale.high else "*"
    text = f"{found.mean:z.{digits}f}{clipped}{overlap_marks(returns.overlaps).strip()}"
    tooltip = f"{run.label}: {found.text(digits)}, return {mean_over_cells([returns.mean]):z.1f}"
    interval = (scale.position(found.low), scale.position(found.high)) if found.interval_text() else None
    return Bar(number, min(zero, end), abs(end - zero), interval, text, tooltip)


def _labelled_series(runs: NumberedRuns, cells: Sequence[ResultCell]) -> list[tuple[int, str]]:
    return [
        (number, run.label + overlap_marks(run.overlaps(cell for cell in cells if cell in run.cells)))
        for number, run in runs.items()
    ]


def curve_charts(runs: NumberedRuns) -> list[Chart]:
    """Return a chart for each kind of task and layout, with a panel of returns per episode for each teammate family.

    Lines show running means, averaged over the tasks. Bands show the range of the single tasks' running means.
    """
    charts = []
    cells = sorted({cell for run in runs.values() for cell in run.cells}, key=lambda cell: (cell.order[-1], cell.order))
    for (kind, layout), group in groupby(cells, key=lambda cell: (cell.kind, cell.layout)):
        of_layout = list(group)
        shown = {number: run for number, run in runs.items() if not run.cells.keys().isdisjoint(of_layout)}
        charts.append(_curve_chart(f"{kind.capitalize()} tasks on {layout}", shown, of_layout))
    return charts


def _curve_chart(title: str, runs: NumberedRuns, cells: Sequence[ResultCell]) -> Chart:
    raw = {(number, cell): run.cells[cell] for number, run in runs.items() for cell in cells if cell in run.cells}
    smooth = {
        key: np.stack([running_mean(returns, min(SMOOTHING, len(returns) // 10)) for returns in of_cell])
        for key, of_cell in raw.items()
    }
    drawn = [*smooth.values(), *(of_cell.mean(axis=0) for of_cell in raw.values())]
    y = _Scale(*axis_limits(float(value) for found in drawn for value in found.flat))
    episodes = max(returns.shape[1] for returns in raw.values())
    x = _Scale(1, max(2, episodes))
    panels = {
        cell.title: [
            _make_curve(number, smooth[number, cell], raw[number, cell].mean(axis=0), x, y)
            for number in runs
            if (number, cell) in raw
        ]
        for cell in cells
    }
    x_ticks = [Tick(x.position(number), str(number)) for number in dict.fromkeys((1, (episodes + 1) // 2, episodes))]
    y_ticks = [Tick(round(100 - tick.position, 2), tick.label) for tick in y.ticks()]
    return Chart(title, "", _labelled_series(runs, cells), x_ticks, y_ticks, panels=panels)


def _make_curve(number: int, smooth: np.ndarray, raw: np.ndarray, x: _Scale, y: _Scale) -> Curve:
    if len(raw) == 1:  # a line needs two points
        smooth, raw = smooth.repeat(2, axis=1), raw.repeat(2)
    episodes, mean = np.arange(1, len(raw) + 1), smooth.mean(axis=0)
    outline = np.concatenate([episodes, episodes[::-1]]), np.concatenate([smooth.min(axis=0), smooth.max(axis=0)[::-1]])
    return Curve(
        number,
        _svg_path(episodes, mean, x, y),
        "" if np.array_equal(raw, mean) else _svg_path(episodes, raw, x, y),
        f"{_svg_path(*outline, x, y)}Z" if len(smooth) > 1 else "",
    )


def _svg_path(xs: np.ndarray, ys: np.ndarray, x: _Scale, y: _Scale) -> str:
    """Return SVG path data for a line through points."""
    columns = np.rint((xs - x.low) / (x.high - x.low) * _DRAWING).astype(int)
    heights = np.rint((y.high - ys) / (y.high - y.low) * _DRAWING).astype(int)
    return "M" + "L".join(f"{column} {height}" for column, height in zip(columns, heights, strict=True))
