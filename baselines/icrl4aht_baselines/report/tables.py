"""The paper's tables of results as data, each filled with our numbers and the published ones.

A table compares agents on groups of the benchmark's cells: single cells, a layout's four cells, or a track's cells. The
score of a single cell is the mean over its instances, that of a larger group the mean over its cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from icrl4aht_baselines.report.overlap import describe_overlap
from icrl4aht_baselines.report.results import (
    PUBLISHED_PROTOCOL,
    EvaluationRun,
    family_of,
    group_of,
    groups_of,
    instances_range,
    instances_text,
    normalised_score,
    published_cells,
    published_instances,
    read_published,
)
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, Cell, has_headroom, read_headroom

AVERAGE = "Average"
"""Label of the row of means over families, as in cards/published.json."""

_TEAMMATE, _LAYOUT = TRACKS["teammate"]["test"], TRACKS["layout"]["test"]


class SweepPoint(NamedTuple):
    """One run of a sweep on one layout.

    Attributes:
        value: of what is varied.
        mean: return, over the cells played.
        std: of the cells' means; None for a single cell.
        published: the paper's mean, if it states one for these conditions.
    """

    value: Any
    mean: float
    std: float | None
    published: float | None


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
        std: standard deviation over the instances of a single cell, or over cells; None if there is only one.
        published: the paper's mean, and its std if it states one; None under other protocols than the paper's.
        normalised: (return - stay) / (oracle - stay), mean over the complete cells with headroom.
        headroom: (number of measured cells with headroom, number of measured cells).
        played: (number of cells played, number of cells).
        shortfall: instances played, if they are not the published ones, such as "1 of 5 instances"; usually empty.
        overlaps: the ways in which training data and tasks overlap, see `icrl4aht_baselines.report.overlap.OVERLAPS`.
        details: what the score is of, with the conditions of the evaluation and the training of the agent; sentences.
        gain: mean gain over the cells played, see `EvaluationRun.gain`; None if nothing was played.
    """

    mean: float | None
    std: float | None
    published: tuple[float, float | None] | None
    normalised: float | None
    headroom: tuple[int, int]
    played: tuple[int, int]
    shortfall: str = ""
    overlaps: tuple[str, ...] = ()
    details: str = ""
    gain: float | None = None


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

    Under other protocols than the paper's, there are no rows for agents that were not run, since the paper's numbers
    do not belong there.

    Args:
        table: one of `PAPER_TABLES`.
        runs: runs under one protocol, none of a sweep.
        protocol: name of the protocol.
    """
    covers_track = table.columns in (_TEAMMATE, _LAYOUT)
    present = [run for run in runs if not table_cells(table).isdisjoint(run.cells)]
    by_label = {run.label: run for run in present}
    stated = [name for name in table.agents if protocol == PUBLISHED_PROTOCOL or name in by_label]
    others = [run.label for run in present if covers_track and run.label not in table.agents]
    headroom = read_headroom(protocol)
    labels = (*HEURISTICS, AVERAGE) if table.group == "cell" else ("",)
    filled = []
    for label in labels:
        for agent in dict.fromkeys((*stated, *others)):
            groups = [_cells_and_published(table.group, label, column, agent) for column in table.columns]
            run = by_label.get(agent)
            scores = [
                score_cells(cells, run, headroom, published if protocol == PUBLISHED_PROTOCOL else None)
                for cells, published in groups
            ]
            filled.append(TableRow(label, agent, scores))
    return filled


def returns_table(
    runs: Sequence[EvaluationRun], cells: Sequence[Cell], protocol: str
) -> tuple[list[str], list[TableRow]]:
    """Returns a table of all that was played in some cells, without empty rows and columns.

    Test cells also have averages over the families of a layout, over the layouts, and over all.

    Args:
        runs: runs under one protocol, none of a sweep.
        cells: cells of one kind of tasks.
        protocol: name of the protocol.

    Returns:
        The names of the columns with scores, and the rows.
    """
    headroom = read_headroom(protocol)
    layouts, groups = list(dict.fromkeys(layout for layout, _ in cells)), groups_of(cells)
    is_test = group_of(cells[0]) == "test"
    columns = {layout: [layout] for layout in layouts} | ({AVERAGE: layouts} if is_test and len(layouts) > 1 else {})
    labels = {family_of(("", group)): [group] for group in groups} | (
        {AVERAGE: groups} if is_test and len(groups) > 1 else {}
    )
    filled = []
    for label, of_label in labels.items():
        for run in runs:
            wanted = [[(n, g) for n in names for g in of_label if (n, g) in cells] for names in columns.values()]
            scores = [_score_with_paper(of_column, run, headroom) for of_column in wanted]
            if any(score.mean is not None for score in scores):
                filled.append(TableRow(label, run.label, scores))
    return list(columns), filled


def _score_with_paper(
    cells: Sequence[Cell], run: EvaluationRun, headroom: Mapping[Cell, dict[str, float]]
) -> TableScore:
    """Returns a run's score on cells, with the paper's number of the same agent on a single cell."""
    published = None
    if len(cells) == 1 and cells[0] in run.cells and run.variant is None:
        layout, family = cells[0]
        published = published_cells(run.agent).get(layout, {}).get(family)
    return score_cells(cells, run, headroom, published)


def table_cells(table: PaperTable) -> set[Cell]:
    """Returns the cells that a table covers."""
    columns = [TRACKS[column]["test"] if table.group == "track" else (column,) for column in table.columns]
    return {(layout, family) for layouts in columns for layout in layouts for family in HEURISTICS}


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
        published: the paper's mean and std; left out if the run has another protocol or episode length.
    """
    means = {cell: run.means(cell) for cell in cells if cell in run.cells} if run else {}
    measured = [headroom[cell] for cell in cells if cell in headroom]
    flat = (sum(map(has_headroom, measured)), len(measured))
    if run is None or not means:
        return TableScore(None, None, published, None, flat, (0, len(cells)))
    normalised = [normalised_score(run, cell, headroom) for cell in means]
    with_headroom = [value for value in normalised if value is not None]
    values = next(iter(means.values())) if len(cells) == 1 else np.array([mean.mean() for mean in means.values()])
    return TableScore(
        mean=float(values.mean()),
        std=float(values.std()) if len(values) > 1 else None,
        published=published if all(map(run.is_like_the_papers, means)) else None,
        normalised=float(np.mean(with_headroom)) if with_headroom else None,
        headroom=flat,
        played=(len(means), len(cells)),
        shortfall=_shortfall(run, list(means)),
        overlaps=run.overlaps(means),
        details=" ".join(["Mean over cells:"] * (len(cells) > 1) + [_describe_cell(run, cell) for cell in means]),
        gain=float(np.mean([run.gain(cell) for cell in means])),
    )


def _shortfall(run: EvaluationRun, cells: Sequence[Cell]) -> str:
    """Returns the number of instances if it is not that of the published tasks of each cell."""
    numbers = {cell: len(run.cells[cell]) for cell in cells}
    if all(number == published_instances(cell) for cell, number in numbers.items()):
        return ""
    if len(cells) == 1:
        return instances_text(*next(iter(numbers.items())))
    return f"{instances_range(numbers.values())} a cell"


def _describe_cell(run: EvaluationRun, cell: Cell) -> str:
    source = run.source(cell)
    instances = instances_text(cell, len(run.cells[cell]))
    return f"{cell[0]}, {cell[1]}: {instances}, {source.conditions}. {describe_overlap(run.tasks(cell), source.seen)}"


def sweep_scores(runs: Sequence[EvaluationRun], quantity: str) -> dict[str, dict[str, list[tuple[Any, TableScore]]]]:
    """Returns layout -> agent -> (value, score) for the runs in which `quantity` was varied: "K" or "size".

    A score is the mean over the cells of a layout that were played, with the paper's mean over the four families if
    the run has its protocol. Tasks that are not test tasks have layouts of their own: "demo_wide (validation)".
    """
    panels: dict[str, dict[str, list[tuple[Any, TableScore]]]] = {}
    for run in runs:
        if run.variant is None or run.variant[0] != quantity:
            continue
        value, headroom = run.variant[1], read_headroom(run.protocol)
        for layout, kind in dict.fromkeys((cell[0], group_of(cell)) for cell in run.cells):
            is_test = kind == "test"
            cells = [cell for cell in run.cells if cell[0] == layout and group_of(cell) == kind]
            of_test = [(layout, family) for family in HEURISTICS]
            mean = _published_point(quantity, run.agent, layout, value) if is_test else None
            score = score_cells(of_test if is_test else cells, run, headroom, None if mean is None else (mean, None))
            panel = layout if is_test else f"{layout} ({kind})"
            panels.setdefault(panel, {}).setdefault(run.agent, []).append((value, score))
    return panels


def sweep_points(runs: Sequence[EvaluationRun], quantity: str) -> dict[str, dict[str, list[SweepPoint]]]:
    """Returns layout -> agent -> points to plot; see `sweep_scores`.

    The paper's mean is left out if not all families were played.
    """
    return {
        layout: {
            agent: [
                SweepPoint(value, score.mean, score.std, _complete_published(score))
                for value, score in scores
                if score.mean is not None
            ]
            for agent, scores in lines.items()
        }
        for layout, lines in sweep_scores(runs, quantity).items()
    }


def _complete_published(score: TableScore) -> float | None:
    return score.published[0] if score.published and score.played[0] == score.played[1] else None


def _published_point(quantity: str, agent: str, layout: str, value: Any) -> float | None:
    """Returns the paper's mean: its text states some contexts, and its tables are of K = 500 and the small size."""
    if quantity == "K":
        stated = read_published()["contexts"]["methods"].get(agent, {}).get(layout, {})
        if str(value) in stated:
            return stated[str(value)]
    if value in (500, "small"):
        return published_cells(agent).get(layout, {}).get(AVERAGE, (None,))[0]
    return None
