"""Scores: of one cell, of groups of cells as the rows of tables, and the numbers that a report opens with.

The score of a single cell is the mean over its instances, that of several cells the mean over the cells. A normalised
score is (return - stay) / (oracle - stay), of cells with headroom that were played completely.

Shapes: U instances of a cell, S seeds.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np

from icrl4aht_baselines.report.results import (
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    EvaluationRun,
    ResultCell,
    end_episodes,
    in_order,
    instances_range,
    published_cells,
    published_instances,
    read_published,
)
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.seen import overlap_marks
from icrl4aht_data.benchmark.facts import KEPT_STEPS, TRACKS, family_order
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, has_headroom, read_headroom
from icrl4aht_data.utils.text import counted_noun

PAPER_METHODS = ("AD", "DPT")
"""The published methods that an agent without published results is compared with."""

AVERAGE = "Average"
"""Label of the row of means over families, as in cards/published.json."""

Returns = TypeVar("Returns", float, np.ndarray)
"""A return or several."""

Published = tuple[float, float | None]
"""A published mean and its standard deviation, which the paper does not always state."""


def cell_headroom(protocol: str) -> dict[ResultCell, dict[str, float]]:
    """Return test cell -> reference ego -> mean return; empty if none was measured under this protocol."""
    return {ResultCell(*cell): references for cell, references in read_headroom(protocol).items()}


def open_cells(protocol: str) -> list[ResultCell]:
    """Return the test cells with headroom under a protocol, in the paper's order."""
    measured = cell_headroom(protocol)
    return in_order(cell for cell in measured if has_headroom(measured[cell]))


def normalise(returns: Returns, references: Mapping[str, float]) -> Returns:
    """Return (return - stay) / (oracle - stay), for returns in a cell with headroom."""
    return (returns - references["stay"]) / (references["oracle"] - references["stay"])


@lru_cache(maxsize=256)
def normalised_returns(run: EvaluationRun) -> dict[ResultCell, np.ndarray]:
    """Return the normalised returns (U, S) in the cells with headroom that a run played completely."""
    headroom = cell_headroom(run.protocol)
    scored = [cell for cell in open_cells(run.protocol) if cell in run.cells]
    scored = [cell for cell in scored if run.is_complete(cell) and run.is_comparable(cell)]
    return {cell: normalise(run.returns[cell].mean, headroom[cell]) for cell in scored}


def _is_like_the_papers(run: EvaluationRun, cell: ResultCell) -> bool:
    return run.variant is None and run.protocol == PUBLISHED_PROTOCOL and run.is_comparable(cell)


def paper_methods(run: EvaluationRun) -> tuple[str, ...]:
    """Return the run's own method if the paper has results of it, or else AD and DPT."""
    return (run.agent,) if published_cells(run.agent) else PAPER_METHODS


def paper_scores(run: EvaluationRun, cell: ResultCell) -> dict[str, float]:
    """Return the normalised scores of published methods in a cell with headroom.

    Empty if the results are not of the paper's protocol, tasks and episode length, or of a sweep.
    """
    if not _is_like_the_papers(run, cell):
        return {}
    stated = {name: published_cells(name).get(cell.layout, {}).get(cell.family) for name in paper_methods(run)}
    references = cell_headroom(run.protocol)[cell]
    return {name: normalise(found[0], references) for name, found in stated.items() if found}


def rows(run: EvaluationRun) -> list[dict[str, Any]]:
    """Return one row per cell of a run.

    A row has the agent, the conditions of the evaluation, mean return, std and 95 % interval over the instances (None
    for a single instance), the paper's numbers (None unless the protocol is `published`), the adaptation gain,
    headroom, the normalised score (None for cells without headroom and incomplete cells), and `overlap`: the ways in
    which training data and tasks overlap, see `icrl4aht_baselines.training.seen.OVERLAPS`.
    """
    headroom, normalised, found = cell_headroom(run.protocol), normalised_returns(run), []
    for cell, returns in run.returns.items():
        source, interval, several = run.source(cell), mean_interval(returns.mean), len(returns.mean) > 1
        published = published_cells(run.agent if _is_like_the_papers(run, cell) else "").get(cell.layout, {})
        paper = published.get(cell.family, (None, None))
        found.append(
            {
                "agent": run.agent,
                "protocol": run.protocol,
                "layout": cell.layout,
                "family": cell.family,
                "instances": len(returns.mean),
                "episodes": run.cells[cell].shape[1],
                "mean": interval.mean,
                "std": float(returns.mean.mean(axis=1).std()) if several else None,
                "low": interval.low if several else None,
                "high": interval.high if several else None,
                "published_mean": paper[0],
                "published_std": paper[1],
                "gain": float(returns.gain.mean()),
                "headroom": has_headroom(headroom[cell]) if cell in headroom else None,
                "normalised": float(normalised[cell].mean()) if cell in normalised else None,
                "tasks": cell.kind,
                "seeds": len(source.settings["seeds"]),
                "steps": source.settings["protocol"]["steps"],
                "overlap": " ".join(returns.overlaps),
                "acting": source.detail("acting"),
                "encoder": source.detail("encoder"),
                "variant": "" if run.variant is None else "{} = {}".format(*run.variant),
            }
        )
    return found


class Headline(NamedTuple):
    """Summary of a run's results on one kind of tasks.

    The numbers are means over the cells with headroom that were played completely, or over all cells played if there
    is none. Intervals are bootstraps over the instances within each cell.

    Attributes:
        label: the run's label with marks for overlap of its training data with these tasks.
        protocol: name of the protocol.
        tasks: the cells of the means in words, such as "12 test cells with headroom, of 16 played".
        score: normalised score; None without a cell with headroom.
        mean: return of an episode.
        gain: return of the last minus that of the first episodes; None for one episode.
        change: returns of both in words, such as "18.7 in the first, 17.4 in the last 20 episodes".
        paper: published method -> its normalised score in the same cells; empty unless the results are of the paper's
            protocol.
        why_no_score: reason for a missing score, as a sentence; empty if there is a score.
        overlaps: kinds of overlap of the training data with these tasks.
    """

    label: str
    protocol: str
    tasks: str
    score: MeanInterval | None
    mean: MeanInterval
    gain: MeanInterval | None
    change: str
    paper: dict[str, float]
    why_no_score: str
    overlaps: tuple[str, ...]

    @property
    def text(self) -> str:
        """The summary as sentences for the console and Markdown."""
        parts = [f"normalised score {self.score.text(2)}"] if self.score else []
        parts.append(f"return {self.mean.text()}")
        parts += [f"gain {self.gain.text(sign='+')}: {self.change}"] if self.gain else []
        text = f"{self.label} ({self.protocol}), {self.tasks}: {'; '.join(parts)}."
        text += " Parentheses: 95 % intervals." if self.mean.range() else ""
        stated = ", ".join(f"{name} {value:z.2f}" for name, value in self.paper.items())
        text += f" The paper's normalised score in these cells: {stated}." if stated else ""
        return f"{text} {self.why_no_score}".rstrip()


def find_headlines(run: EvaluationRun) -> list[Headline]:
    """Return a run's summaries, one for each kind of tasks that was played, test tasks first."""
    normalised, found = normalised_returns(run), []
    for kind in TASK_KINDS:
        played = [cell for cell in run.returns if cell.kind == kind]
        scored = [cell for cell in played if cell in normalised]
        if not played:
            continue
        cells = scored or played
        returns, episodes = [run.returns[cell] for cell in cells], min(run.cells[cell].shape[1] for cell in cells)
        first, last = (mean_of(getattr(of, end) for of in returns) for end in ("first", "last"))
        ends = f"{end_episodes(episodes)} episodes" if end_episodes(episodes) > 1 else "episode"
        counted, overlaps = counted_noun(len(cells), f"{kind} cell"), run.overlaps(cells)
        stated = [paper_scores(run, cell) for cell in scored]
        methods = [name for name in paper_methods(run) if stated and all(name in of_cell for of_cell in stated)]
        found.append(
            Headline(
                label=run.label + overlap_marks(overlaps),
                protocol=run.protocol,
                tasks=f"{counted} with headroom, of {len(played)} played" if scored else counted,
                score=mean_interval(*(normalised[cell] for cell in scored)) if scored else None,
                mean=mean_interval(*(of.mean for of in returns)),
                gain=mean_interval(*(of.gain for of in returns)) if episodes > 1 else None,
                change=f"{first:z.1f} in the first, {last:z.1f} in the last {ends}",
                paper={name: float(np.mean([of_cell[name] for of_cell in stated])) for name in methods},
                why_no_score="" if scored else _why_no_score(run, kind, played),
                overlaps=overlaps,
            )
        )
    return found


def mean_of(cells: Iterable[np.ndarray]) -> float:
    """Return the mean of the cells' means."""
    return float(np.mean([values.mean() for values in cells]))


def _why_no_score(run: EvaluationRun, kind: str, cells: Sequence[ResultCell]) -> str:
    if kind != "test":
        return f"No score: reference returns exist for test tasks only, and these are {kind} tasks."
    if any(run.is_complete(cell) and run.is_comparable(cell) for cell in cells):
        return "No score: no cell that was played completely has headroom."
    return f"No score: it needs all published tasks of a cell, in episodes of {KEPT_STEPS} steps."


class TableScore(NamedTuple):
    """Score of an agent on a group of cells, one entry of a table.

    Attributes:
        text: mean, std over the instances of a single cell or over cells, and marks of overlaps; a dash if nothing was
            played.
        notes: further numbers as text: what is missing, the paper's numbers, normalised score, gain.
        is_flat: whether no cell that was measured has headroom.
        overlaps: the ways in which training data and tasks overlap, see `icrl4aht_baselines.training.seen.OVERLAPS`.
    """

    text: str = "–"
    notes: Sequence[str] = ()
    is_flat: bool = False
    overlaps: tuple[str, ...] = ()


def table_score(
    cells: Sequence[ResultCell], run: EvaluationRun | None, protocol: str, published: Published | None = None
) -> TableScore:
    """Return a run's score on a group of cells.

    Args:
        cells: the group.
        run: None if the agent was not run.
        protocol: of the run.
        published: the paper's mean and std; left out if a cell was not played, or with another episode length.
    """
    headroom, played = cell_headroom(protocol), [cell for cell in cells if run and cell in run.cells]
    measured = [has_headroom(headroom[cell]) for cell in cells if cell in headroom]
    is_flat = bool(measured) and not any(measured)
    std = f" ± {published[1]:z.1f}" if published and published[1] is not None else ""
    paper = [f"paper {published[0]:z.1f}{std}"] if published else []
    if run is None or not played:
        return TableScore(notes=paper, is_flat=is_flat)
    means = [run.returns[cell].mean.mean(axis=1) for cell in played]
    values = means[0] if len(cells) == 1 else np.array([of_cell.mean() for of_cell in means])
    std = f" ± {values.std():z.1f}" if len(values) > 1 else ""
    complete = all(cell.kind != "test" or run.is_complete(cell) for cell in played)
    counts = f"{len(means[0])} of {counted_noun(published_instances(cells[0]), 'instance')}"
    scores = [score for cell, score in normalised_returns(run).items() if cell in played]
    overlaps = run.overlaps(played)
    notes = [
        f"{len(played)} of {len(cells)} cells" if len(played) < len(cells) else "",
        "" if complete else counts if len(cells) == 1 else "incomplete cells",
        *(paper if len(played) == len(cells) and all(map(run.is_comparable, played)) else []),
        f"normalised {mean_of(scores):z.2f}" if scores else "",
        f"gain {mean_of(run.returns[cell].gain for cell in played):+z.1f}",
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


def published_score(agent: EvaluationRun | str, cells: Sequence[ResultCell]) -> Published | None:
    """Return the paper's mean and std of a cell, of a layout's four cells or of a track's cells; None of other groups.

    The paper's text states the means of some contexts, and its tables are of K = 500 and the small size.

    Args:
        agent: name of a published method, or a run of it.
        cells: the group.
    """
    name, variant = (agent, None) if isinstance(agent, str) else (agent.agent, agent.variant)
    layouts, families = (tuple(dict.fromkeys(cell[part] for cell in cells)) for part in (0, 1))
    if variant and variant[1] not in (500, "small"):
        stated = read_published()["contexts"]["methods"].get(name, {}).get(layouts[0], {}).get(str(variant[1]))
        return (stated, None) if stated is not None and (len(layouts), families) == (1, HEURISTICS) else None
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
