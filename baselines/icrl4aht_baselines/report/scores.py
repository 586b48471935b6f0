"""Scores: of one cell, of groups of cells as the rows of tables, and the numbers that a report opens with.

The score of a single cell is the mean over its instances, that of several cells the mean over the cells. A normalised
score is (return - stay) / (oracle - stay), of cells with headroom that were played completely.

Shapes: U instances of a cell.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np

from icrl4aht_baselines.report.results import (
    CELL_COLUMNS,
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    EvaluationRun,
    ResultCell,
    end_episodes,
    instances_range,
    published_cells,
    published_instances,
    read_published,
)
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.seen import describe_overlap, overlap_marks
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


class CellScore(NamedTuple):
    """Score of a run in one cell.

    Attributes:
        means: mean return of each instance, float64 (U,), over seeds and episodes.
        first, last: mean return of each instance in its first and last episodes, see `results.BLOCKS`.
        references: reference ego -> its mean return in the cell; None where it was not measured.
        normalised: normalised score of each instance; None without headroom or if the cell was not played completely.
        published: the paper's mean and std of the agent in this cell; None if it has none of these conditions.
        overlaps: names of the overlaps with the training data.
    """

    means: np.ndarray
    first: np.ndarray
    last: np.ndarray
    references: Mapping[str, float] | None
    normalised: np.ndarray | None
    published: Published | None
    overlaps: tuple[str, ...]

    @property
    def gain(self) -> float:
        """Mean return of the last episodes minus that of the first (paper, App. F)."""
        return float((self.last - self.first).mean())

    @property
    def has_headroom(self) -> bool | None:
        """Whether the cell has headroom; None where it was not measured."""
        return None if self.references is None else has_headroom(self.references)


@lru_cache(maxsize=256)
def cell_scores(run: EvaluationRun) -> dict[ResultCell, CellScore]:
    """Return the scores of a run in its cells, in their order."""
    # Means over the seeds, a row for each task and a column for each block.
    table = run.table.pivot_table(index=[*CELL_COLUMNS, "task"], columns="block", values="return", sort=False)
    by_cell = {ResultCell(*map(str, key)): rows for key, rows in table.groupby(level=CELL_COLUMNS, sort=False)}
    headroom, stated = cell_headroom(run.protocol), {} if run.variant else published_cells(run.agent)
    found = {}
    for cell in run.cells:
        means, first, last = (by_cell[cell][name].to_numpy() for name in ("mean", "first", "last"))
        references = headroom.get(cell)
        scored = references if references and has_headroom(references) and run.is_comparable(cell) else None
        found[cell] = CellScore(
            means,
            first,
            last,
            references,
            normalise(means, scored) if scored else None,
            stated.get(cell.layout, {}).get(cell.family) if run.is_like_the_papers(cell) else None,
            run.overlaps([cell]),
        )
    return found


def cell_headroom(protocol: str) -> dict[ResultCell, dict[str, float]]:
    """Return test cell -> reference ego -> mean return; empty if none was measured under this protocol."""
    return {ResultCell(*cell): references for cell, references in read_headroom(protocol).items()}


def open_cells(protocol: str) -> list[ResultCell]:
    """Return the test cells with headroom under a protocol, in the paper's order."""
    measured = cell_headroom(protocol)
    return sorted((cell for cell in measured if has_headroom(measured[cell])), key=lambda cell: cell.order)


def normalise(returns: Returns, references: Mapping[str, float]) -> Returns:
    """Return (return - stay) / (oracle - stay), for returns in a cell with headroom."""
    return (returns - references["stay"]) / (references["oracle"] - references["stay"])


def rows(run: EvaluationRun) -> list[dict[str, Any]]:
    """Return one row per cell of a run.

    A row has the agent, the conditions of the evaluation, mean return, std and 95 % interval over the instances (None
    for a single instance), the paper's numbers (None unless the protocol is `published`), the adaptation gain,
    headroom, the normalised score (None for cells without headroom and incomplete cells), and `overlap`: the ways in
    which training data and tasks overlap, see `icrl4aht_baselines.training.seen.OVERLAPS`.
    """
    found = []
    for cell, score in cell_scores(run).items():
        source, several = run.source(cell), len(score.means) > 1
        interval, published = mean_interval(score.means), score.published or (None, None)
        found.append(
            {
                "agent": run.agent,
                "protocol": run.protocol,
                "layout": cell.layout,
                "family": cell.family,
                "instances": len(score.means),
                "episodes": run.cells[cell].shape[1],
                "mean": interval.mean,
                "std": float(score.means.std()) if several else None,
                "low": interval.low if several else None,
                "high": interval.high if several else None,
                "published_mean": published[0],
                "published_std": published[1],
                "gain": score.gain,
                "headroom": score.has_headroom,
                "normalised": None if score.normalised is None else float(score.normalised.mean()),
                "tasks": cell.kind,
                "seeds": len(source.settings["seeds"]),
                "steps": source.settings["protocol"]["steps"],
                "overlap": " ".join(score.overlaps),
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
        run: the results.
        kind: kind of the tasks, one of `TASK_KINDS`.
        cells: the cells of the means.
        played: number of cells of this kind that were played.
        score: normalised score; None without a cell with headroom.
        mean: return of an episode.
        gain: return of the last minus that of the first episodes; None for one episode.
        ends: return of the first and of the last of these episodes.
        paper: published method -> its normalised score in the same cells; empty unless the results are of the paper's
            protocol.
    """

    run: EvaluationRun
    kind: str
    cells: tuple[ResultCell, ...]
    played: int
    score: MeanInterval | None
    mean: MeanInterval
    gain: MeanInterval | None
    ends: tuple[float, float]
    paper: dict[str, float]

    @property
    def label(self) -> str:
        """The run's label with marks for overlap of its training data with these tasks."""
        return self.run.label + overlap_marks(self.run.overlaps(self.cells))

    @property
    def tasks(self) -> str:
        """The cells of the means in words, such as "12 test cells with headroom, of 16 played"."""
        counted = counted_noun(len(self.cells), f"{self.kind} cell")
        return counted if self.score is None else f"{counted} with headroom, of {self.played} played"

    @property
    def has_interval(self) -> bool:
        """Whether a cell has several instances, without which there is no interval."""
        return any(len(self.run.cells[cell]) > 1 for cell in self.cells)

    @property
    def change(self) -> str:
        """Returns at both ends of a task in words, such as "18.7 in the first, 17.4 in the last 20 episodes"."""
        count = min(end_episodes(self.run.cells[cell].shape[1]) for cell in self.cells)
        episodes = f"{count} episodes" if count > 1 else "episode"
        return f"{self.ends[0]:z.1f} in the first, {self.ends[1]:z.1f} in the last {episodes}"

    @property
    def why_no_score(self) -> str:
        """Reason for a missing score, as a sentence; empty if there is a score."""
        if self.score is not None:
            return ""
        if self.kind != "test":
            return f"No score: reference returns exist for test tasks only, and these are {self.kind} tasks."
        if any(self.run.is_comparable(cell) for cell in self.cells):
            return "No score: no cell that was played completely has headroom."
        return f"No score: it needs all published tasks of a cell, in episodes of {KEPT_STEPS} steps."

    @property
    def text(self) -> str:
        """The summary as sentences for the console and Markdown."""

        def interval(found: MeanInterval, digits: int) -> str:
            return f" ({found.low:z.{digits}f} to {found.high:z.{digits}f})" if self.has_interval else ""

        parts = [f"normalised score {self.score.mean:z.2f}{interval(self.score, 2)}"] if self.score else []
        parts.append(f"return {self.mean.mean:z.1f}{interval(self.mean, 1)}")
        if self.gain is not None:
            parts.append(f"gain {self.gain.mean:+z.1f}{interval(self.gain, 1)}: {self.change}")
        text = f"{self.label} ({self.run.protocol}), {self.tasks}: {'; '.join(parts)}."
        text += " Parentheses: 95 % intervals." if self.has_interval else ""
        if self.paper:
            stated = ", ".join(f"{name} {value:z.2f}" for name, value in self.paper.items())
            text += f" The paper's normalised score in these cells: {stated}."
        return f"{text} {self.why_no_score}".rstrip()


def find_headlines(run: EvaluationRun) -> list[Headline]:
    """Return a run's summaries, one for each kind of tasks that was played, test tasks first."""
    scores, found = cell_scores(run), []
    for kind in TASK_KINDS:
        played = [cell for cell in scores if cell.kind == kind]
        scored = [cell for cell in played if scores[cell].normalised is not None]
        cells = [scores[cell] for cell in scored or played]
        if not cells:
            continue
        normalised = [score.normalised for score in cells if score.normalised is not None]
        several = all(run.cells[cell].shape[1] > 1 for cell in scored or played)
        of_cells = [paper_scores(run, cell) for cell in scored]
        stated = [name for name in paper_methods(run) if of_cells and all(name in of_cell for of_cell in of_cells)]
        headline = Headline(
            run,
            kind,
            tuple(scored or played),
            len(played),
            mean_interval(*normalised) if scored else None,
            mean_interval(*(score.means for score in cells)),
            mean_interval(*(score.last - score.first for score in cells)) if several else None,
            (float(np.mean([score.first.mean() for score in cells])), float(np.mean([s.last.mean() for s in cells]))),
            {name: float(np.mean([of_cell[name] for of_cell in of_cells])) for name in stated},
        )
        found.append(headline)
    return found


def paper_methods(run: EvaluationRun) -> tuple[str, ...]:
    """Return the run's own method if the paper has results of it, or else AD and DPT."""
    return (run.agent,) if published_cells(run.agent) else PAPER_METHODS


def paper_scores(run: EvaluationRun, cell: ResultCell) -> dict[str, float]:
    """Return the normalised scores of published methods in a cell with headroom.

    Empty if the results are not of the paper's protocol, tasks and episode length, or of a sweep.
    """
    references = cell_headroom(run.protocol).get(cell)
    if run.variant or not run.is_like_the_papers(cell) or references is None or not has_headroom(references):
        return {}
    stated = {name: published_cells(name).get(cell.layout, {}).get(cell.family) for name in paper_methods(run)}
    return {name: normalise(found[0], references) for name, found in stated.items() if found}


class GroupScore(NamedTuple):
    """Score of an agent on a group of cells, one entry of a table.

    Attributes:
        played: (number of cells played, number of cells).
        measured: (number of measured cells with headroom, number of measured cells).
        published: the paper's mean and std; None under other protocols than the paper's.
        mean: mean return; None if nothing was played.
        std: standard deviation over the instances of a single cell, or over cells; None if there is only one.
        normalised: normalised score, mean over the complete cells with headroom.
        gain: mean gain over the cells played; None if nothing was played.
        shortfall: instances played, if they are not the published ones, such as "1 of 5 instances"; usually empty.
        overlaps: the ways in which training data and tasks overlap, see `icrl4aht_baselines.training.seen.OVERLAPS`.
        details: what the score is of, with the conditions of the evaluation and the training of the agent; sentences.
    """

    played: tuple[int, int]
    measured: tuple[int, int] = (0, 0)
    published: Published | None = None
    mean: float | None = None
    std: float | None = None
    normalised: float | None = None
    gain: float | None = None
    shortfall: str = ""
    overlaps: tuple[str, ...] = ()
    details: str = ""

    @property
    def is_flat(self) -> bool:
        """Whether no cell that was measured has headroom."""
        return self.measured[1] > 0 and self.measured[0] == 0

    @property
    def text(self) -> str:
        """Mean, std and marks of overlaps as text; a dash if nothing was played."""
        if self.mean is None:
            return "–"
        std = "" if self.std is None else f" ± {self.std:z.1f}"
        return f"{self.mean:z.1f}{std}{overlap_marks(self.overlaps)}"

    @property
    def notes(self) -> list[str]:
        """Further numbers as text."""
        played, total = self.played
        std = f" ± {self.published[1]:z.1f}" if self.published and self.published[1] is not None else ""
        notes = [
            f"{played} of {total} cells" if 0 < played < total else "",
            self.shortfall,
            f"paper {self.published[0]:z.1f}{std}" if self.published else "",
            "" if self.normalised is None else f"normalised {self.normalised:z.2f}",
            "" if self.gain is None else f"gain {self.gain:+z.1f}",
            "no headroom" if self.is_flat and self.mean is not None else "",
        ]
        return [note for note in notes if note]


def group_score(
    cells: Sequence[ResultCell], run: EvaluationRun | None, protocol: str, published: Published | None = None
) -> GroupScore:
    """Return a run's score on a group of cells.

    Args:
        cells: the group.
        run: None if the agent was not run.
        protocol: of the run.
        published: the paper's mean and std; left out if a played cell has another protocol or episode length.
    """
    headroom = cell_headroom(protocol)
    measured = [has_headroom(headroom[cell]) for cell in cells if cell in headroom]
    scores = {cell: score for cell, score in cell_scores(run).items() if cell in cells} if run else {}
    empty = GroupScore((len(scores), len(cells)), (sum(measured), len(measured)), published)
    if run is None or not scores:
        return empty
    means = [score.means for score in scores.values()]
    values = means[0] if len(cells) == 1 else np.array([of_cell.mean() for of_cell in means])
    normalised = [score.normalised.mean() for score in scores.values() if score.normalised is not None]
    details = [f"{cell.layout}, {cell.group}: {run.source(cell).conditions}." for cell in scores]
    overlaps = run.overlaps(scores)
    return empty._replace(
        published=published if len(scores) == len(cells) and all(map(run.is_like_the_papers, scores)) else None,
        mean=float(values.mean()),
        std=float(values.std()) if len(values) > 1 else None,
        normalised=float(np.mean(normalised)) if normalised else None,
        gain=float(np.mean([score.gain for score in scores.values()])),
        shortfall=_shortfall(run, list(scores)),
        overlaps=overlaps,
        details=" ".join([*["Mean over cells:"] * (len(cells) > 1), *details, describe_overlap(overlaps)]),
    )


def _shortfall(run: EvaluationRun, cells: Sequence[ResultCell]) -> str:
    if all(map(run.is_complete, cells)):
        return ""
    played = instances_range(len(run.cells[cell]) for cell in cells)
    total = published_instances(cells[0])
    if len(cells) > 1:
        return f"{played} a cell"
    return f"{len(run.cells[cells[0]])} of {counted_noun(total, 'instance')}" if total else played


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
    rows: Mapping[tuple[str, str], list[GroupScore]]
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
        cells = sorted({cell for run in runs for cell in run.cells if cell.kind == kind}, key=lambda cell: cell.order)
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
                scores.append(group_score(group, run, protocol, stated))
            if any(score.mean is not None or score.published for score in scores):
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
