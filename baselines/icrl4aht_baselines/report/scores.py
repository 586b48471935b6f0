"""Scores relative to best responses, differences between agents, and the summary of a report.

For a task, R is the mean return of the agent, S that of the ego `stay`, and B that of the best response. The score of a
layout is N = sum(R - S) / sum(B - S) over its tasks; the score of several layouts is the mean of their N. A result cell
(layout and teammate family) has headroom if its mean of B - S is at least `LEAST_HEADROOM`; only tasks of such cells
are used.

Shapes: T training runs, U tasks of a cell, S seeds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from icrl4aht_baselines.evaluate.evaluator import ControlledResults
from icrl4aht_baselines.evaluate.protocols import CONTROLS, EVALUATION_SPLITS, bundled_tasks
from icrl4aht_baselines.report.results import (
    EPISODE_BLOCKS,
    TASK_KINDS,
    AgentReturns,
    CellReturns,
    EvaluationRun,
    ResultCell,
    bundled_tasks_by_id,
    cell_of,
    mean_over_cells,
    sorted_cells,
    task_label,
)
from icrl4aht_baselines.report.statistics import (
    LEAST_UNITS,
    MeanInterval,
    Stratum,
    interquartile_mean,
    ratio_interval,
)
from icrl4aht_baselines.training.seen import overlap_marks
from icrl4aht_data.benchmark.best_responses import best_responses, read_best_responses
from icrl4aht_data.benchmark.facts import KEPT_STEPS, LAYOUT_NAMES, LEAST_HEADROOM, PREFERENCE, TRACKS
from icrl4aht_data.benchmark.reference_returns import (
    has_headroom,
    read_reference_returns,
    same_behaviour_tasks,
    stay_returns,
)
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_noun


class TaskScale(NamedTuple):
    """Reference returns S and B of a task: a return of S is a score of 0, a return of B is a score of 1.

    Attributes:
        stay: S, mean return of the ego `stay`.
        best: B, mean return of the best response.
        behaviour: name of the teammate's behaviour; teammates that behave the same have the same name.
    """

    stay: float
    best: float
    behaviour: str


class CellScale(NamedTuple):
    """Reference returns of the tasks of a result cell.

    Attributes:
        tasks: label of a task, see `results.task_label` -> reference returns of the task.
    """

    tasks: Mapping[str, TaskScale]

    @property
    def stay(self) -> float:
        """Mean return of the ego `stay` over the tasks."""
        return float(np.mean([scale.stay for scale in self.tasks.values()]))

    @property
    def best(self) -> float:
        """Mean return of the best responses over the tasks."""
        return float(np.mean([scale.best for scale in self.tasks.values()]))

    @property
    def has_headroom(self) -> bool:
        """Whether best responses earn at least `LEAST_HEADROOM` more than the ego `stay`."""
        return self.best - self.stay >= LEAST_HEADROOM


CellScales = Mapping[ResultCell, CellScale]
"""Result cell -> reference returns, for the cells whose tasks all have best responses."""


@cache
def bundled_ids_by_cell() -> dict[ResultCell, list[str]]:
    """Return the ids of the test and validation tasks of both benchmark tracks, and of the test tasks of the track
    `preference`, by result cell."""
    published = [task for split in EVALUATION_SPLITS for task in bundled_tasks_by_id(split).values()]
    found = grouped([*published, *bundled_tasks(PREFERENCE, "test")], cell_of)
    return {cell: [task.task_id for task in found[cell]] for cell in sorted_cells(found)}


def behaviour_names() -> dict[str, str]:
    """Return the name of the teammate's behaviour in each task, by task label.

    The name of a behaviour is the id of the first task with this behaviour. The result covers the package's test tasks
    and all tasks with best responses.
    """
    groups = [*same_behaviour_tasks(), *(best.tasks for best in best_responses().values())]
    return {task_label(task): group[0] for group in groups for task in group}


def cell_scales(protocol: str) -> dict[ResultCell, CellScale]:
    """Return the reference returns of each result cell under a protocol, if all its tasks have best responses.

    The test cells of a layout are left out if the layout has a test cell without best responses in which the oracle
    earns over 1 more than `stay`. All cells of the track `preference` are left out if any lacks one.
    """
    measured, stays, names = best_responses(protocol), stay_returns(protocol), behaviour_names()
    found: dict[ResultCell, CellScale] = {}
    for cell, tasks in bundled_ids_by_cell().items() if measured else ():
        if all(task in measured and task in stays for task in tasks):
            scales = {
                task_label(task): TaskScale(stays[task], measured[task].best, names[task_label(task)]) for task in tasks
            }
            found[cell] = CellScale(scales)
    wanted = (ResultCell(*cell) for cell, egos in read_reference_returns(protocol).items() if has_headroom(egos))
    unfinished = {cell.layout for cell in wanted if cell not in found}
    own = [cell for cell in bundled_ids_by_cell() if cell.kind == PREFERENCE]
    unfinished |= {cell.layout for cell in own} if any(cell not in found for cell in own) else set()
    return {
        cell: scale
        for cell, scale in found.items()
        if cell.kind not in ("test", PREFERENCE) or cell.layout not in unfinished
    }


def add_scales(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of results with additional columns `stay` and `best`, the reference returns S and B of each task.

    Unknown values are empty. Under the control `swapped`, only the block of the last episodes has values, because
    another teammate plays the earlier episodes. Under a protocol that swaps teammates, all values are empty.
    """
    scaled = table.assign(stay=np.nan, best=np.nan)
    has_scale = (table["control"] != "swapped") | (table["block"] == "last 20")
    for protocol in table["protocol"].unique():
        own = has_scale & (table["protocol"] == protocol)
        bests = {task: response.best for task, response in best_responses(protocol).items()}
        for column, values in (("stay", stay_returns(protocol)), ("best", bests)):
            by_label = {task_label(task): value for task, value in values.items()}
            scaled.loc[own, column] = table.loc[own, "task"].map(by_label)
    return scaled


def cells_with_headroom(scales: CellScales, track: str | None = None) -> list[ResultCell]:
    """Return the test cells with headroom of a track, by default of both published tracks, in the paper's order."""
    kind = PREFERENCE if track == PREFERENCE else "test"
    cells = sorted_cells(cell for cell, scale in scales.items() if scale.has_headroom and cell.kind == kind)
    return [cell for cell in cells if track in (None, PREFERENCE) or cell.layout in TRACKS[track]["test"]]


def known_headroom(protocol: str) -> dict[ResultCell, bool]:
    """Return whether each result cell has headroom, judged by best responses if known, otherwise by the oracle."""
    egos = {ResultCell(*cell): has_headroom(of_cell) for cell, of_cell in read_reference_returns(protocol).items()}
    return egos | {cell: scale.has_headroom for cell, scale in cell_scales(protocol).items()}


class Score(NamedTuple):
    """Score of an agent on some result cells with headroom.

    Attributes:
        total: mean of N over the layouts.
        middle: interquartile mean of (R - S) / (B - S) over the teammates' behaviours with headroom.
        worst: layout and family of the behaviour with the lowest value of (R - S) / (B - S), and this value.
        regret: mean of B - R over the tasks.
    """

    total: MeanInterval
    middle: MeanInterval
    worst: tuple[str, float]
    regret: float

    @property
    def text(self) -> str:
        """The score as text for the summary of a report."""
        return (
            f"score {self.total.text(2)}, interquartile mean {self.middle.mean:z.2f}, worst teammate "
            f"{self.worst[1]:z.2f} ({self.worst[0]}), regret {self.regret:z.1f}"
        )


def find_score(returns: AgentReturns, cells: Sequence[ResultCell], scales: CellScales) -> Score | None:
    """Return an agent's score on some result cells (layout, family of teammates, kind of tasks).

    The result is None if there are no cells, or a cell has no headroom or was not played completely.
    """
    if not cells or not all(is_scored(returns.get(cell), scales.get(cell)) for cell in cells):
        return None
    parts, values, labels, regrets = [], [], [], []
    for cell in cells:
        gains, spans, names = _gains_and_scales(returns[cell], scales[cell])
        parts.append((gains, spans, names))
        regrets.append(spans - gains.mean(axis=(0, 2)))
        of_cell = []
        for name in dict.fromkeys(names):
            own = [number for number, other in enumerate(names) if other == name]
            if spans[own].mean() >= LEAST_HEADROOM:
                of_cell.append(float(gains[:, own].mean() / spans[own].mean()))
        if of_cell:
            values.append(np.array(of_cell))
            labels.append(f"{cell.layout} {cell.family}")
    worst, label = min((of_cell.min(), label) for of_cell, label in zip(values, labels, strict=True))
    return Score(
        total=ratio_interval(_strata_by_layout(cells, parts)),
        middle=interquartile_mean(*values),
        worst=(label, float(worst)),
        regret=float(np.concatenate(regrets).mean()),
    )


def is_scored(returns: CellReturns | None, scale: CellScale | None) -> bool:
    """Return whether a result cell has headroom and all of its tasks with best responses were played."""
    return bool(returns and scale and scale.has_headroom and scale.tasks.keys() <= {*returns.tasks})


def _gains_and_scales(returns: CellReturns, scale: CellScale) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return gains, scales and teammates' behaviours of those tasks of a cell that have a best response.

    A gain is the agent's return minus that of `stay`, for each training run, task and seed; a task's scale is the best
    response's return minus that of `stay`.
    """
    known = [number for number, task in enumerate(returns.tasks) if task in scale.tasks]
    of_task = [scale.tasks[returns.tasks[number]] for number in known]
    stays, bests = (np.array([getattr(one, name) for one in of_task]) for name in ("stay", "best"))
    return returns.blocks["all"][:, known] - stays[:, None], bests - stays, [one.behaviour for one in of_task]


def _pooled_strata(
    cells: Sequence[ResultCell], parts: Sequence[tuple[np.ndarray, np.ndarray, list[str]]]
) -> dict[tuple[str, str], Stratum]:
    """Return (layout, family) -> stratum of behaviours; family is empty for the track `preference`.

    On this track, a cell has one or two tasks, so all tasks of a layout form one stratum.

    Args:
        cells: result cells.
        parts: for each cell, the arguments of `stratum_of_behaviours`.
    """
    pooled = defaultdict(list)
    for cell, part in zip(cells, parts, strict=True):
        pooled[cell.layout, "" if cell.kind == PREFERENCE else cell.family].append(part)
    return {
        key: stratum_of_behaviours(
            np.concatenate([values for values, _, _ in own], axis=1),
            np.concatenate([scales for _, scales, _ in own]),
            [name for _, _, names in own for name in names],
        )
        for key, own in pooled.items()
    }


def _strata_by_layout(
    cells: Sequence[ResultCell], parts: Sequence[tuple[np.ndarray, np.ndarray, list[str]]]
) -> list[list[Stratum]]:
    pooled = _pooled_strata(cells, parts)
    return [[pooled[key] for key in keys] for keys in grouped(pooled, lambda key: key[0]).values()]


def stratum_of_behaviours(values: np.ndarray, scales: np.ndarray, behaviours: Sequence[str]) -> Stratum:
    """Return a stratum for the bootstrap, with behaviours as units, or seeds.

    Units are seeds if fewer than `LEAST_UNITS` behaviours have scales above a tenth of the mean scale.

    Args:
        values: numerators of the tasks, of shape (T, U, S).
        scales: denominators of the tasks, of shape (U,).
        behaviours: name of the teammate's behaviour in each task.
    """
    names, seeds = list(dict.fromkeys(behaviours)), values.shape[2]
    # A resample of behaviours without the only one with headroom would have a denominator of about 0.
    scaled = {name for name, scale in zip(behaviours, scales, strict=True) if scale > 0.1 * scales.mean()}
    if len(scaled) < LEAST_UNITS:
        return Stratum(values.sum(axis=1) / seeds, np.full(seeds, scales.sum() / seeds))
    member = np.array([[name == own for name in names] for own in behaviours], float)
    return Stratum(np.moveaxis(values.mean(axis=2)[..., None] * member, 1, -1).sum(axis=-1), scales @ member)


def mean_return(cells: Iterable[CellReturns]) -> MeanInterval:
    """Return the mean over result cells of an agent's mean return, with its 95 % interval."""
    alike = behaviour_names()
    strata = [
        stratum_of_behaviours(of.blocks["all"], np.ones(len(of.tasks)), [alike.get(task, task) for task in of.tasks])
        for of in cells
    ]
    return ratio_interval([[stratum] for stratum in strata])


def score_difference(
    one: AgentReturns, other: AgentReturns, cells: Sequence[ResultCell], scales: CellScales
) -> MeanInterval:
    """Return the score of one agent minus that of another, paired by task and seed; training runs are not paired."""
    parts, subtracted = [], 0
    for cell in cells:
        both = common_results(one[cell], other[cell], ("tasks", "seeds"))
        first, second = (_gains_and_scales(of, scales[cell]) for of in both)
        parts.append((np.concatenate([first[0], second[0]]), *first[1:]))
        subtracted = len(both[1].trainings)
    return ratio_interval(_strata_by_layout(cells, parts), subtracted=subtracted)


def block_difference(
    one: AgentReturns, other: AgentReturns, cells: Sequence[ResultCell], block: str
) -> MeanInterval | None:
    """Return the mean difference of two agents' returns over result cells, paired by task, seed and training run.

    On the track `preference`, it is the mean over layouts.

    Args:
        one: results of the first agent.
        other: results of the agent that is subtracted.
        cells: cells to compare; cells that only one of the agents played are left out.
        block: name of a block of episodes, see `results.BLOCKS`.

    Returns:
        The difference; None if the agents have no cell in common, or one of them has no such block.
    """
    parts, alike, common = [], behaviour_names(), [cell for cell in cells if cell in one and cell in other]
    for cell in common:
        first, second = common_results(one[cell], other[cell])
        if block not in first.blocks or block not in second.blocks:
            return None
        names = [alike.get(task, task) for task in first.tasks]
        parts.append((first.blocks[block] - second.blocks[block], np.ones(len(names)), names))
    return ratio_interval([[one] for one in _pooled_strata(common, parts).values()]) if parts else None


_AXES = ("trainings", "tasks", "seeds")


def common_results(
    one: CellReturns, other: CellReturns, paired: Sequence[str] = _AXES
) -> tuple[CellReturns, CellReturns]:
    """Return the results of two agents in one result cell, for those tasks, seeds and training runs that both have.

    Args:
        one, other: results of the agents.
        paired: names of the fields in which only values that both agents have are kept; other fields keep all.
    """
    common: dict[str, Any] = {
        axis: tuple(key for key in getattr(one, axis) if key in getattr(other, axis)) for axis in paired
    }

    def select_common(of: CellReturns) -> CellReturns:
        kept = {axis: common.get(axis, getattr(of, axis)) for axis in _AXES}
        places = np.ix_(*([getattr(of, axis).index(key) for key in keys] for axis, keys in kept.items()))
        return of._replace(blocks={name: values[places] for name, values in of.blocks.items()}, **kept)

    return select_common(one), select_common(other)


def scored_cells(run: EvaluationRun, cells: Iterable[ResultCell], scales: CellScales) -> list[ResultCell]:
    """Return the result cells with headroom in which a run played all tasks, in episodes of full length.

    Results of the control `swapped` have no scored cells, because another teammate plays most episodes.
    """
    played = [cell for cell in cells if run.has_full_length(cell) and not run.source(cell).detail(CONTROLS["swapped"])]
    return [cell for cell in played if is_scored(run.returns[cell], scales.get(cell))]


def control_lines(results: ControlledResults, tasks: Sequence[Task]) -> list[str]:
    """Return two lines of text for each track: the benefit M of memory, and the benefit P of the right context.

    M and P are means over layouts and families with 95 % intervals. For the intervals, the teammates' behaviours are
    resampled within each layout and family, or the seeds if there is only one behaviour.

    Args:
        results: results of an ego and its controls.
        tasks: evaluated tasks, in the order of the results.
    """
    alike, last, lines = behaviour_names(), counted_noun(results.last, "last episode"), []
    names = np.array([alike.get(task_label(task.task_id), task.task_id) for task in tasks])
    for track, of_track in grouped(range(len(tasks)), lambda row: tasks[row].track).items():
        cells = grouped(of_track, lambda row: (tasks[row].layout.name, tasks[row].teammate_family)).values()
        texts = []
        for values in (results.memory, results.partner):
            strata = [stratum_of_behaviours(values[None, own], np.ones(len(own)), names[own].tolist()) for own in cells]
            texts.append(ratio_interval([[stratum] for stratum in strata]).text(sign="+"))
        memory, partner = texts
        lines += [
            f"track {track}, benefit M of memory: {memory}, the return minus the return with memory cleared "
            "before each episode",
            f"track {track}, benefit P of the right context: {partner}, the return in the {last} minus the return "
            "in them after episodes with another teammate",
        ]
    return lines


def block_returns_text(cells: Sequence[CellReturns]) -> str:
    """Return text with the mean return in each block of episodes, such as "1: 10.0, 2-5: 12.0".

    Args:
        cells: returns of an agent in several result cells (layout, family of teammates, kind of tasks).
    """
    # Result cells may have different numbers of episodes, so only the episode blocks that every result cell has are
    # shown.
    names = [name for name in EPISODE_BLOCKS if all(name in of.blocks for of in cells)]
    return ", ".join(f"{name}: {mean_over_cells(of.blocks[name] for of in cells):z.1f}" for name in names)


class Headline(NamedTuple):
    """Summary of an evaluation run on one kind of tasks.

    It covers the result cells that have headroom and were played completely, or all cells if there are none.

    Attributes:
        label: label of the run, with symbols for overlap of its training data with the tasks.
        protocol: name of the protocol.
        tasks: text on the cells, such as "12 test cells with headroom, of 16 played".
        score: score of the agent; None without cells with headroom.
        mean: mean return over the cells.
        blocks: text with the mean returns in blocks of episodes; empty for tasks of one episode.
        why_no_score: sentence with the reason for a missing score; empty if there is a score.
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
        """The summary as text for the console and Markdown."""
        parts = [self.score.text] if self.score else []
        parts.append(f"return {self.mean.text()}")
        parts += [f"in episodes {self.blocks}"] if self.blocks else []
        text = f"{self.label} ({self.protocol}), {self.tasks}: {'; '.join(parts)}."
        text += " Ranges in parentheses: 95 % intervals." if self.mean.interval_text() else ""
        return f"{text} {self.why_no_score}".rstrip()


def find_headlines(run: EvaluationRun) -> list[Headline]:
    """Return a summary of a run for each kind of task that was played, with test tasks first.

    Validation tasks on published layouts and on other layouts have separate summaries.
    """
    scales, found = cell_scales(run.protocol), []
    # Validation tasks have scores only on published layouts, so those on other layouts have a summary of their own.
    groups = grouped(
        run.returns, lambda cell: (cell.kind, cell.kind == "validation" and cell.layout not in LAYOUT_NAMES)
    )
    for kind, is_other in sorted(groups, key=lambda key: ([*TASK_KINDS].index(key[0]), key[1])):
        played = groups[kind, is_other]
        scored = scored_cells(run, played, scales)
        cells = scored or played
        returns, counted = [run.returns[cell] for cell in cells], counted_noun(len(cells), f"{kind} cell")
        counted += " on other layouts" if is_other else ""
        overlaps = run.overlaps(cells)
        found.append(
            Headline(
                label=run.label + overlap_marks(overlaps),
                protocol=run.protocol,
                tasks=f"{counted} with headroom, of {len(played)} played" if scored else counted,
                score=find_score(run.returns, scored, scales),
                mean=mean_return(returns),
                blocks=block_returns_text(returns) if min(run.cells[cell].shape[1] for cell in cells) > 1 else "",
                why_no_score="" if scored else _missing_score_reason(run, played, scales),
                overlaps=overlaps,
            )
        )
    return found


def _missing_score_reason(run: EvaluationRun, cells: Sequence[ResultCell], scales: CellScales) -> str:
    measured, known = read_best_responses(), [cell for cell in cells if cell in scales]
    if measured.behaviours and run.protocol != measured.protocol:
        return f"No score: best responses were measured under protocol {measured.protocol}."
    if not known:
        return "No score: no best response measured."
    if any(run.source(cell).detail(CONTROLS["swapped"]) for cell in known):
        return "No score: in this control, another teammate plays most episodes."
    if not any(scales[cell].has_headroom for cell in known):
        return f"No score: no best response earns {LEAST_HEADROOM:g} more than `stay` in these cells."
    return f"No score: it needs all tasks of a cell with a best response, in episodes of {KEPT_STEPS} steps."
