"""The paper's tables of results as data, each filled with our numbers beside the published ones.

A table has places (cells, layouts or tracks) and agents. A place is one or several cells of the benchmark; its score is
the mean over instances where it is one cell, and over cells where it is several.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from baselines.report.results import Run, normalised, published_cells, read_published
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, Cell, has_headroom, read_headroom

AVERAGE = "Average"
_TEAMMATE, _LAYOUT = TRACKS["teammate"]["test"], TRACKS["layout"]["test"]


class PaperTable(NamedTuple):
    """What a table compares where. `rows` says what a score is of: a cell, a layout's four cells, a track's cells."""

    title: str
    rows: Literal["cell", "layout", "track"]
    columns: tuple[str, ...]  # layouts, or tracks
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


class Score(NamedTuple):
    """One entry of a table."""

    mean: float | None  # None where we have nothing
    std: float | None
    published: tuple[float, float | None] | None  # mean, std where it is stated
    normalised: float | None  # (return - stay) / (oracle - stay), over the cells with headroom
    headroom: tuple[int, int]  # how many of the place's measured cells have headroom
    played: tuple[int, int]  # how many of the place's cells we have


class Row(NamedTuple):
    """An agent's scores at places of one kind."""

    label: str  # the family, or Average, or empty
    agent: str
    scores: list[Score]


def fill(table: PaperTable, runs: Sequence[Run], protocol: str) -> list[Row]:
    """A table's rows. After the paper's agents come the others that were run, where it compares agents everywhere.

    Args:
        table: one of `PAPER_TABLES`.
        runs: of one protocol, none of them of a sweep.
        protocol: theirs.
    """
    everywhere = table.columns in (_TEAMMATE, _LAYOUT)
    others = [
        run.label
        for run in runs
        if everywhere and run.label not in table.agents and any(layout in table.columns for layout, _ in run.cells)
    ]
    by_label = {run.label: run for run in runs}
    headroom = read_headroom(protocol)
    labels = (*HEURISTICS, AVERAGE) if table.rows == "cell" else ("",)
    return [
        Row(
            label,
            agent,
            [_score(table.rows, label, column, agent, by_label.get(agent), headroom) for column in table.columns],
        )
        for label in labels
        for agent in dict.fromkeys((*table.agents, *others))
    ]


def _score(rows: str, label: str, column: str, agent: str, run: Run | None, headroom: Mapping[Cell, Any]) -> Score:
    if rows == "track":
        cells = [(layout, family) for layout in TRACKS[column]["test"] for family in HEURISTICS]
        found = read_published()["tracks"]["methods"].get(agent, {}).get(column)
    else:
        single = label in HEURISTICS
        cells = [(column, label)] if single else [(column, family) for family in HEURISTICS]
        found = published_cells(agent).get(column, {}).get(label if single else AVERAGE)
    return score(cells, run, headroom, found and (found[0], found[1]))


def score(
    cells: Sequence[Cell],
    run: Run | None,
    headroom: Mapping[Cell, dict[str, float]],
    published: tuple[float, float | None] | None = None,
) -> Score:
    """A run's score at a place: mean and std over instances of one cell, over the means of several cells."""
    means = {cell: run.means(cell) for cell in cells if cell in run.cells} if run else {}
    measured = [headroom[cell] for cell in cells if cell in headroom]
    share = [normalised(float(mean.mean()), headroom.get(cell)) for cell, mean in means.items()]
    useful = [value for value in share if value is not None]
    values = next(iter(means.values())) if len(cells) == 1 and means else np.array([m.mean() for m in means.values()])
    return Score(
        mean=float(values.mean()) if len(values) else None,
        std=float(values.std()) if len(values) else None,
        published=published,
        normalised=float(np.mean(useful)) if useful else None,
        headroom=(sum(map(has_headroom, measured)), len(measured)),
        played=(len(means), len(cells)),
    )


class Point(NamedTuple):
    """A run of a sweep on one layout."""

    value: Any
    mean: float  # over the cells played
    std: float
    published: float | None


def sweep(runs: Sequence[Run], what: str) -> dict[str, dict[str, list[Point]]]:
    """Layout -> agent -> points, of the runs in which `what` was varied: "K" or "size"."""
    panels: dict[str, dict[str, list[Point]]] = {}
    for run in runs:
        if run.variant is None or run.variant[0] != what:
            continue
        value = run.variant[1]
        for layout in dict.fromkeys(layout for layout, _ in run.cells):
            means = np.array([run.means(cell).mean() for cell in run.cells if cell[0] == layout])
            stated = _stated(what, run.agent, layout, value)
            line = panels.setdefault(layout, {}).setdefault(run.agent, [])
            line.append(Point(value, float(means.mean()), float(means.std()), stated))
    return panels


def _stated(what: str, agent: str, layout: str, value: Any) -> float | None:
    """What the paper states of that point: of some contexts in its text, and its tables are of K = 500, small."""
    if what == "K":
        stated = read_published()["contexts"]["methods"].get(agent, {}).get(layout, {})
        if str(value) in stated:
            return stated[str(value)]
    if value in (500, "small"):
        return published_cells(agent).get(layout, {}).get(AVERAGE, (None,))[0]
    return None
