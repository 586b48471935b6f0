"""The paper's tables of results as data, each filled with our numbers and the published ones.

A table compares agents on groups of the benchmark's cells: single cells, a layout's four cells, or a track's cells. The
score of a single cell is the mean over its instances, that of a larger group the mean over its cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from baselines.plotting import SweepPoint
from baselines.report.results import EvaluationRun, normalized_return, published_cells, read_published
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, Cell, has_headroom, read_headroom

AVERAGE = "Average"
"""Label of the row of means over families, as in cards/published.json."""

_TEAMMATE, _LAYOUT = TRACKS["teammate"]["test"], TRACKS["layout"]["test"]


class PaperTable(NamedTuple):
    """Layout of one of the paper's tables.

    Attributes:
        title: the paper's.
        group: what one score covers.
        columns: layouts, or tracks.
        agents: in the paper's order.
    """

    title: str
    group: Literal["cell", "layout", "track"]
    columns: tuple[str, ...]
    agents: tuple[str, ...]


PAPER_TABLES = (
    PaperTable("Track 1: Teammate Generalization", "cell", _TEAMMATE, ("AD", "DPT", "random")),
    PaperTable("Track 2: Layout Generalization", "cell", _LAYOUT, ("AD", "DPT", "random")),
    PaperTable(
        "Ablation: Teammate Action Conditioning",
        "cell",
        ("test_wide", "demo_wide", "cramped_down"),
        ("AD", "AD+TA", "DPT", "DPT+TA", "random"),
    ),
    PaperTable("Hybrid-AD vs. AD", "layout", ("test_wide", "demo_wide", *_LAYOUT), ("AD", "Hybrid-AD")),
    PaperTable("Offline Meta-RL Comparison", "track", tuple(TRACKS), ("AD", "DPT", "AMAGO-Offline", "random")),
)
"""The paper's five tables of results (Sec. 5), in order."""


class TableScore(NamedTuple):
    """Score of an agent on a group of cells, one entry of a table.

    Attributes:
        mean: mean return; None if nothing was played.
        std: standard deviation over the instances of a single cell, or over cells.
        published: the paper's mean, and its std if it states one.
        normalised: (return - stay) / (oracle - stay), mean over the cells with headroom.
        headroom: (number of measured cells with headroom, number of measured cells).
        played: (number of cells played, number of cells).
    """

    mean: float | None
    std: float | None
    published: tuple[float, float | None] | None
    normalised: float | None
    headroom: tuple[int, int]
    played: tuple[int, int]


class TableRow(NamedTuple):
    """Scores of one agent, a row of a table.

    Attributes:
        label: the teammate family, `AVERAGE`, or empty.
        agent: name of the agent.
        scores: scores of the agent, one per column.
    """

    label: str
    agent: str
    scores: list[TableScore]


def fill_table(table: PaperTable, runs: Sequence[EvaluationRun], protocol: str) -> list[TableRow]:
    """Returns a table's rows: the paper's agents, then other agents that were run, if the table covers a track.

    Args:
        table: one of `PAPER_TABLES`.
        runs: runs under one protocol, none of a sweep.
        protocol: name of the protocol.
    """
    covers_track = table.columns in (_TEAMMATE, _LAYOUT)
    others = [
        run.label
        for run in runs
        if covers_track and run.label not in table.agents and any(layout in table.columns for layout, _ in run.cells)
    ]
    by_label = {run.label: run for run in runs}
    headroom = read_headroom(protocol)
    labels = (*HEURISTICS, AVERAGE) if table.group == "cell" else ("",)
    filled = []
    for label in labels:
        for agent in dict.fromkeys((*table.agents, *others)):
            groups = [_cells_and_published(table.group, label, column, agent) for column in table.columns]
            run = by_label.get(agent)
            scores = [score_cells(cells, run, headroom, published) for cells, published in groups]
            filled.append(TableRow(label, agent, scores))
    return filled


def _cells_and_published(
    group: str, label: str, column: str, agent: str
) -> tuple[list[Cell], tuple[float, float | None] | None]:
    """Returns the cells that one score covers, and the paper's mean and std."""
    if group == "track":
        cells = [(layout, family) for layout in TRACKS[column]["test"] for family in HEURISTICS]
        found = read_published()["tracks"]["methods"].get(agent, {}).get(column)
    else:
        single = label in HEURISTICS
        cells = [(column, label)] if single else [(column, family) for family in HEURISTICS]
        found = published_cells(agent).get(column, {}).get(label if single else AVERAGE)
    return cells, found and (found[0], found[1])


def score_cells(
    cells: Sequence[Cell],
    run: EvaluationRun | None,
    headroom: Mapping[Cell, dict[str, float]],
    published: tuple[float, float | None] | None = None,
) -> TableScore:
    """Returns a run's score on a group of cells: over instances of a single cell, over the means of several cells.

    Args:
        cells: the group.
        run: None if the agent was not run.
        headroom: cell -> reference ego -> mean return.
        published: the paper's mean and std.
    """
    means = {cell: run.means(cell) for cell in cells if cell in run.cells} if run else {}
    measured = [headroom[cell] for cell in cells if cell in headroom]
    normalised = [normalized_return(float(mean.mean()), headroom.get(cell)) for cell, mean in means.items()]
    with_headroom = [value for value in normalised if value is not None]
    values = next(iter(means.values())) if len(cells) == 1 and means else np.array([m.mean() for m in means.values()])
    return TableScore(
        mean=float(values.mean()) if len(values) else None,
        std=float(values.std()) if len(values) else None,
        published=published,
        normalised=float(np.mean(with_headroom)) if with_headroom else None,
        headroom=(sum(map(has_headroom, measured)), len(measured)),
        played=(len(means), len(cells)),
    )


def sweep_points(runs: Sequence[EvaluationRun], quantity: str) -> dict[str, dict[str, list[SweepPoint]]]:
    """Returns layout -> agent -> points, of the runs in which `quantity` was varied: "K" or "size"."""
    panels: dict[str, dict[str, list[SweepPoint]]] = {}
    for run in runs:
        if run.variant is None or run.variant[0] != quantity:
            continue
        value = run.variant[1]
        for layout in dict.fromkeys(layout for layout, _ in run.cells):
            means = np.array([run.means(cell).mean() for cell in run.cells if cell[0] == layout])
            published = _published_point(quantity, run.agent, layout, value)
            points = panels.setdefault(layout, {}).setdefault(run.agent, [])
            points.append(SweepPoint(value, float(means.mean()), float(means.std()), published))
    return panels


def _published_point(quantity: str, agent: str, layout: str, value: Any) -> float | None:
    """Returns the paper's mean: its text states some contexts, and its tables are of K = 500 and the small size."""
    if quantity == "K":
        stated = read_published()["contexts"]["methods"].get(agent, {}).get(layout, {})
        if str(value) in stated:
            return stated[str(value)]
    if value in (500, "small"):
        return published_cells(agent).get(layout, {}).get(AVERAGE, (None,))[0]
    return None
