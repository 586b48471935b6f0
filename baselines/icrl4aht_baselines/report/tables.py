"""Results as rows and tables, the summary of a report, and the paper's numbers next to them."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_baselines.report.results import (
    EPISODE_BLOCKS,
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    CellReturns,
    EvaluationRun,
    ResultCell,
    in_order,
    published_instances,
)
from icrl4aht_baselines.report.scores import (
    CellScales,
    Score,
    cell_scales,
    find_score,
    known_headroom,
    scored_cells,
)
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.seen import overlap_marks
from icrl4aht_data.benchmark.best_responses import read_best_responses
from icrl4aht_data.benchmark.facts import KEPT_STEPS, LEAST_HEADROOM, TRACKS, family_order
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.templates import card_file
from icrl4aht_data.utils.text import counted_noun

PAPER_METHODS = ("AD", "DPT")
"""Published methods in tables next to an agent without published results."""

AVERAGE = "Average"
"""Label of the row of means over families, as in cards/published.json."""

Published = tuple[float, float | None]
"""A published mean and its standard deviation, which the paper does not always state."""


def mean_of(cells: Iterable[np.ndarray]) -> float:
    """Return the mean of the cells' means."""
    return float(np.mean([values.mean() for values in cells]))


def blocks_text(cells: Sequence[CellReturns]) -> str:
    """Return the mean returns over cells in each block of episodes, such as "1: 10.0, 2-5: 12.0"."""
    # Evaluations of different lengths may share a table: only blocks that all of them have can be compared.
    names = [name for name in EPISODE_BLOCKS if all(name in of.blocks for of in cells)]
    return ", ".join(f"{name}: {mean_of(of.blocks[name] for of in cells):z.1f}" for name in names)


class Headline(NamedTuple):
    """Summary of a run's results on one kind of tasks.

    The numbers are of the cells with headroom that were played completely, or of all cells played if there is none.

    Attributes:
        label: the run's label with marks for overlap of its training data with these tasks.
        protocol: name of the protocol.
        tasks: the cells in words, such as "12 test cells with headroom, of 16 played".
        score: the score; None without a cell with headroom.
        mean: return of an episode, mean over cells.
        blocks: mean returns in blocks of episodes in words; empty for one episode.
        why_no_score: reason for a missing score, as a sentence; empty if there is a score.
        overlaps: kinds of overlap of the training data with these tasks.
    """

    label: str
    protocol: str
    tasks: str
    score: Score | None
    mean: MeanInterval
    blocks: str
    why_no_score: str
    overlaps: tuple[str, ...]

    @property
    def text(self) -> str:
        """The summary as sentences for the console and Markdown."""
        parts = [self.score.text] if self.score else []
        parts.append(f"return {self.mean.text()}")
        parts += [f"by episode {self.blocks}"] if self.blocks else []
        text = f"{self.label} ({self.protocol}), {self.tasks}: {'; '.join(parts)}."
        text += " Parentheses: 95 % intervals." if self.mean.range() else ""
        return f"{text} {self.why_no_score}".rstrip()


def find_headlines(run: EvaluationRun) -> list[Headline]:
    """Return a run's summaries, one for each kind of tasks that was played, test tasks first."""
    scales, found = cell_scales(run.protocol), []
    for kind in TASK_KINDS:
        played = [cell for cell in run.returns if cell.kind == kind]
        scored = scored_cells(run, played, scales)
        if not played:
            continue
        cells = scored or played
        returns, counted = [run.returns[cell] for cell in cells], counted_noun(len(cells), f"{kind} cell")
        overlaps = run.overlaps(cells)
        found.append(
            Headline(
                label=run.label + overlap_marks(overlaps),
                protocol=run.protocol,
                tasks=f"{counted} with headroom, of {len(played)} played" if scored else counted,
                score=find_score(run.returns, scored, scales),
                mean=mean_interval(*(of.mean for of in returns)),
                blocks=blocks_text(returns) if min(run.cells[cell].shape[1] for cell in cells) > 1 else "",
                why_no_score="" if scored else _why_no_score(run, played, scales),
                overlaps=overlaps,
            )
        )
    return found


def _why_no_score(run: EvaluationRun, cells: Sequence[ResultCell], scales: CellScales) -> str:
    measured, known = read_best_responses(), [cell for cell in cells if cell in scales]
    if measured.behaviours and run.protocol != measured.protocol:
        return f"No score: best responses were measured under protocol {measured.protocol}."
    if not known:
        return "No score: no best response measured."
    if not any(scales[cell].has_headroom for cell in known):
        return f"No score: no best response earns {LEAST_HEADROOM:g} more than `stay` in these cells."
    return f"No score: it needs all tasks of a cell with a best response, in episodes of {KEPT_STEPS} steps."


class TableScore(NamedTuple):
    """Results of an agent on a group of cells, one entry of a table.

    Attributes:
        text: mean return, std over the instances of a single cell or over cells, and marks of overlaps; a dash if
            nothing was played.
        notes: further numbers as text: what is missing, the paper's numbers, score, blocks of episodes.
        is_flat: whether headroom was measured in a cell, and none has any, see `scores.known_headroom`.
        overlaps: the ways in which training data and tasks overlap, see `icrl4aht_baselines.training.seen.OVERLAPS`.
    """

    text: str = "–"
    notes: Sequence[str] = ()
    is_flat: bool = False
    overlaps: tuple[str, ...] = ()


def table_score(
    cells: Sequence[ResultCell], run: EvaluationRun | None, protocol: str, published: Published | None = None
) -> TableScore:
    """Return a run's results on a group of cells.

    Args:
        cells: the group.
        run: None if the agent was not run.
        protocol: of the run.
        published: the paper's mean and std; left out if a cell was not played, or with another episode length.
    """
    played = [cell for cell in cells if run and cell in run.cells]
    headroom, scales = known_headroom(protocol), cell_scales(protocol)
    measured = [headroom[cell] for cell in cells if cell in headroom]
    is_flat = bool(measured) and not any(measured)
    std = f" ± {published[1]:z.1f}" if published and published[1] is not None else ""
    paper = [f"paper {published[0]:z.1f}{std}"] if published else []
    if run is None or not played:
        return TableScore(notes=paper, is_flat=is_flat)
    returns = [run.returns[cell] for cell in played]
    means = [of.mean.mean(axis=1) for of in returns]
    values = means[0] if len(cells) == 1 else np.array([of_cell.mean() for of_cell in means])
    std = f" ± {values.std():z.1f}" if len(values) > 1 else ""
    complete = all(cell.kind != "test" or run.is_complete(cell) for cell in played)
    counts = f"{len(means[0])} of {counted_noun(published_instances(cells[0]), 'instance')}"
    score, overlaps = find_score(run.returns, scored_cells(run, played, scales), scales), run.overlaps(played)
    blocks = blocks_text(returns)
    notes = [
        f"{len(played)} of {len(cells)} cells" if len(played) < len(cells) else "",
        "" if complete else counts if len(cells) == 1 else "incomplete cells",
        *(paper if len(played) == len(cells) and all(map(run.is_comparable, played)) else []),
        f"score {score.total.mean:z.2f}" if score else "",
        f"episodes {blocks}" if blocks else "",
        "no headroom" if is_flat else "",
    ]
    text = f"{values.mean():z.1f}{std}{overlap_marks(overlaps)}"
    return TableScore(text, [note for note in notes if note], is_flat, overlaps)


class ScoreTable(NamedTuple):
    """A table of scores of one kind of tasks.

    Attributes:
        title: heading of the table.
        kind: kind of the tasks.
        columns: name of a column -> layouts.
        rows: label of a group of families and agent -> scores, one per column.
        caption: conditions of the evaluation, as a sentence.
    """

    title: str
    kind: str
    columns: Mapping[str, Sequence[str]]
    rows: Mapping[tuple[str, str], list[TableScore]]
    caption: str


def returns_tables(runs: Sequence[EvaluationRun], protocol: str) -> list[ScoreTable]:
    """Return a table for each kind of tasks that was played.

    Tables of test tasks also have averages, and under the paper's protocol rows of the paper's AD, DPT and `random`.

    Args:
        runs: runs under one protocol.
        protocol: name of the protocol.
    """
    tables = []
    for kind in TASK_KINDS:
        cells = in_order(cell for run in runs for cell in run.cells if cell.kind == kind)
        if not cells:
            continue
        layouts = tuple(dict.fromkeys(cell.layout for cell in cells))
        families = tuple(sorted({cell.family for cell in cells}, key=family_order))
        columns, labels = ({name: (name,) for name in names} for names in (layouts, families))
        if kind == "test":
            columns |= {AVERAGE: layouts} if len(layouts) > 1 else {}
            labels |= {AVERAGE: families} if len(families) > 1 else {}
        played = {run.label: run for run in runs if not run.cells.keys().isdisjoint(cells)}
        rows = {}
        quoted = (*PAPER_METHODS, "random") if (kind, protocol) == ("test", PUBLISHED_PROTOCOL) else ()
        for label, agent in product(labels, dict.fromkeys((*played, *quoted))):
            run, scores = played.get(agent), []
            for of_column in columns.values():
                group = [ResultCell(*cell, kind) for cell in product(of_column, labels[label])]
                stated = published_score(agent if run is None else run, group) if quoted else None
                scores.append(table_score(group, run, protocol, stated))
            if any(score.notes or score.text != TableScore().text for score in scores):
                rows[label, agent] = scores
        caption = describe_conditions(played.values(), cells)
        tables.append(ScoreTable(f"{kind.capitalize()} tasks", kind, columns, rows, caption))
    return tables


@cache
def read_published() -> dict[str, Any]:
    """Return the paper's numbers, each part with its source, from cards/published.json."""
    return parse_json(read_text(card_file("published.json")))


def published_cells(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Return layout -> family or "Average" -> published mean and std; empty for an agent that is not in the paper."""
    return read_published()["methods"].get(agent, {})


def published_score(agent: EvaluationRun | str, cells: Sequence[ResultCell]) -> Published | None:
    """Return the paper's mean and std of a cell, of a layout's four cells or of a track's cells; None of other groups.

    The paper's text states the means of some contexts, and its tables are of K = 500 and the small size.

    Args:
        agent: name of a published method, or a run of it.
        cells: the group.
    """
    name, context = (agent, None) if isinstance(agent, str) else (agent.agent, agent.sources[0].detail("context"))
    layouts, families = (tuple(dict.fromkeys(cell[part] for cell in cells)) for part in (0, 1))
    stated = read_published()["contexts"]["methods"].get(name, {}).get(layouts[0], {})
    if context != 500 and str(context) in stated:
        return (stated[str(context)], None) if (len(layouts), families) == (1, HEURISTICS) else None
    if len(layouts) == 1:
        label = AVERAGE if families == HEURISTICS else families[0]
        found = published_cells(name).get(layouts[0], {}).get(label) if label == AVERAGE or len(cells) == 1 else None
    else:
        track = next((track for track in TRACKS if (layouts, families) == (TRACKS[track]["test"], HEURISTICS)), "")
        found = read_published()["tracks"]["methods"].get(name, {}).get(track)
    return found and (found[0], found[1])


def describe_conditions(runs: Iterable[EvaluationRun], cells: Container[ResultCell] | None = None) -> str:
    """Return a sentence with protocol, seeds, length and instances of some runs' results, all or those of `cells`.

    If the conditions differ, it says which agents they are of.
    """
    shown = [(run, cell) for run in runs for cell in run.cells if cells is None or cell in cells]
    labels: dict[str, dict[str, None]] = {}
    for run, cell in shown:
        labels.setdefault(run.source(cell).conditions, {})[run.label] = None
    several = len(labels) > 1
    texts = [f"{' and '.join(names)} under {text}" if several else f"under {text}" for text, names in labels.items()]
    instances = instances_range(len(run.cells[cell]) for run, cell in shown)
    return f"Evaluated {'; '.join(texts)}; {instances} in a cell."


def instances_range(numbers: Iterable[int]) -> str:
    """Return numbers of instances as text, such as "5 instances" or "1 to 5 instances"."""
    found = sorted(set(numbers))
    return counted_noun(found[0], "instance") if len(found) == 1 else f"{found[0]} to {found[-1]} instances"
