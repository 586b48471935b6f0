"""The numbers that a report opens with: score, gain and return of a run, and the paper's score in the same cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrl4aht_baselines.report.intervals import MeanInterval, mean_of_cells
from icrl4aht_baselines.report.overlap import overlap_marks
from icrl4aht_baselines.report.results import (
    GROUP_TEXTS,
    EvaluationRun,
    end_episodes,
    group_of,
    normalise,
    normalised_score,
    normalized_return,
    published_cells,
)
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.reference_returns import Cell, has_headroom, read_headroom
from icrl4aht_data.utils.text import counted_noun

PAPER_METHODS = ("AD", "DPT")
"""The paper's methods that agents are compared with which the paper does not have."""


class Headline(NamedTuple):
    """Summary of a run's results on one kind of tasks.

    The numbers are means over the cells with headroom that were played completely, or over all cells played if there
    is none. Intervals are bootstraps over the instances within each cell.

    Attributes:
        run: the results.
        kind: kind of the tasks, see `results.group_of`.
        cells: the cells of the means.
        played: number of cells of this kind that were played.
        score: headroom-normalised score, (return - stay) / (oracle - stay); None without a cell with headroom.
        mean: return of an episode.
        gain: return of the last 20 episodes minus that of the first 20, see `EvaluationRun.ends`; None for one episode.
        ends: return of the first and of the last of these episodes.
        paper: published method -> its headroom-normalised score in the same cells; empty unless the results are of the
            paper's protocol.
    """

    run: EvaluationRun
    kind: str
    cells: tuple[Cell, ...]
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
        of_kind = f"{self.kind} cell"
        if self.score is None:
            return counted_noun(len(self.cells), of_kind)
        return f"{counted_noun(len(self.cells), of_kind)} with headroom, of {self.played} played"

    @property
    def has_interval(self) -> bool:
        """Whether a cell has several instances, without which there is no interval."""
        return any(len(self.run.cells[cell]) > 1 for cell in self.cells)

    @property
    def compared_episodes(self) -> int:
        """Number of episodes at each end of a task that the gain compares."""
        return min(end_episodes(self.run.cells[cell].shape[1]) for cell in self.cells)

    @property
    def change(self) -> str:
        """Returns at both ends of a task in words, such as "18.7 in the first, 17.4 in the last 20 episodes"."""
        first, last = self.ends
        count = self.compared_episodes
        return f"{first:z.1f} in the first, {last:z.1f} in the last {f'{count} episodes' if count > 1 else 'episode'}"

    @property
    def why_no_score(self) -> str:
        """Reason for which there is no score, as a sentence; empty if there is one."""
        if self.score is not None:
            return ""
        if self.kind != "test":
            return f"No score: reference returns exist for test tasks only, and these are {self.kind} tasks."
        if any(self.run.is_complete(cell) and self.run.has_usual_steps(cell) for cell in self.cells):
            return "No score: no cell that was played completely has headroom."
        return f"No score: it needs all published tasks of a cell, in episodes of {KEPT_STEPS} steps."


def find_headlines(run: EvaluationRun) -> list[Headline]:
    """Returns a run's summaries, one for each kind of tasks that was played, test tasks first."""
    kinds = [kind for kind in ("test", *GROUP_TEXTS) if any(group_of(cell) == kind for cell in run.cells)]
    return [_headline(run, kind) for kind in kinds]


def _headline(run: EvaluationRun, kind: str) -> Headline:
    headroom = read_headroom(run.protocol)
    played = [cell for cell in run.cells if group_of(cell) == kind]
    scored = [cell for cell in played if normalised_score(run, cell, headroom) is not None]
    cells = scored or played
    ends = [run.ends(cell) for cell in cells]
    several = all(run.cells[cell].shape[1] > 1 for cell in cells)
    scores = [normalise(run.means(cell), headroom[cell]) for cell in scored]
    return Headline(
        run,
        kind,
        tuple(cells),
        len(played),
        mean_of_cells(scores) if scores else None,
        mean_of_cells([run.means(cell) for cell in cells]),
        mean_of_cells([last - first for first, last in ends]) if several else None,
        (float(np.mean([first.mean() for first, _ in ends])), float(np.mean([last.mean() for _, last in ends]))),
        _mean_paper_scores(run, scored),
    )


def _mean_paper_scores(run: EvaluationRun, cells: Sequence[Cell]) -> dict[str, float]:
    """Returns the mean of `paper_scores` over some cells for the methods that have all of them."""
    of_cells = [paper_scores(run, cell) for cell in cells]
    complete = [name for name in paper_methods(run) if of_cells and all(name in scores for scores in of_cells)]
    return {name: float(np.mean([scores[name] for scores in of_cells])) for name in complete}


def paper_methods(run: EvaluationRun) -> tuple[str, ...]:
    """Returns the names of the paper's methods that a run is compared with.

    This is the run's own method if the paper has results of it, or else AD and DPT.
    """
    return (run.agent,) if published_cells(run.agent) else PAPER_METHODS


def paper_scores(run: EvaluationRun, cell: Cell) -> dict[str, float]:
    """Returns the normalised scores of published methods in a cell with headroom.

    Empty if the results are not of the paper's protocol, tasks and episode length, or of a sweep.
    """
    references = read_headroom(run.protocol).get(cell)
    if run.variant or not run.is_like_the_papers(cell) or references is None or not has_headroom(references):
        return {}
    layout, family = cell
    stated = {name: published_cells(name).get(layout, {}).get(family) for name in paper_methods(run)}
    scores = {name: found and normalized_return(found[0], references) for name, found in stated.items()}
    return {name: score for name, score in scores.items() if score is not None}


def headline_text(headline: Headline) -> str:
    """Returns a summary as sentences for the console and Markdown."""
    score, gain = headline.score, headline.gain
    parts = [] if score is None else [f"normalised score {score.mean:z.2f}{_interval(headline, score, 2)}"]
    parts.append(f"return {headline.mean.mean:z.1f}{_interval(headline, headline.mean, 1)}")
    if gain is not None:
        parts.append(f"gain {gain.mean:+z.1f}{_interval(headline, gain, 1)}: {headline.change}")
    text = f"{headline.label} ({headline.run.protocol}), {headline.tasks}: {'; '.join(parts)}."
    if headline.has_interval:
        text += " Parentheses: 95 % intervals."
    if headline.paper:
        stated = ", ".join(f"{name} {value:z.2f}" for name, value in headline.paper.items())
        text += f" The paper's normalised score in these cells: {stated}."
    return f"{text} {headline.why_no_score}".rstrip()


def _interval(headline: Headline, found: MeanInterval, digits: int) -> str:
    return f" ({found.low:z.{digits}f} to {found.high:z.{digits}f})" if headline.has_interval else ""
