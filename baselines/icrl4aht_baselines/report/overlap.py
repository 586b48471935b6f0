"""Overlap of training data and tasks: marks for results with teammates or on layouts that were in training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from icrl4aht_baselines.training.seen import SeenInTraining
from icrl4aht_data.benchmark.tasks import Task, teammate_id


class OverlapKind(NamedTuple):
    """One way in which the training data and the tasks of an evaluation overlap.

    Attributes:
        mark: character behind a score.
        meaning: explanation of the mark, for the reader of a table.
    """

    mark: str
    meaning: str


OVERLAPS = {
    "teammate": OverlapKind("‡", "the agent was trained with one of these very teammates"),
    "family": OverlapKind(
        "†",
        "the agent was trained with other teammates of this family, or of this algorithm if they are learned; members "
        "of a family may act alike, so this is no result with unknown kinds of teammates",
    ),
    "layout": OverlapKind("§", "the agent was trained on this layout, which the track reserves for tests"),
    "unknown": OverlapKind("?", "unknown training data: nothing says what the agent was trained on"),
}
"""Name in reports -> kind of overlap, in the order of marks."""


def find_overlaps(tasks: Iterable[Task], seen: SeenInTraining | None) -> tuple[str, ...]:
    """Returns the names of the kinds of overlap between tasks and training data, in the order of `OVERLAPS`.

    Args:
        tasks: tasks that an agent was evaluated on.
        seen: what it was trained on; None if that is not known.
    """
    if seen is None:
        return ("unknown",)
    found = set()
    for task in tasks:
        if task.teammate_kind in seen.teammates:
            found.add("teammate" if _is_known(task, seen) else "family")
        if _is_layout_test(task) and task.layout.name in seen.layouts:
            found.add("layout")
    return tuple(name for name in OVERLAPS if name in found)


def _is_known(task: Task, seen: SeenInTraining) -> bool:
    return teammate_id(task.teammate) in (seen.teammates[task.teammate_kind] or ())


def _is_layout_test(task: Task) -> bool:
    """Returns whether the task's layout must not be in training; the other tasks are on training layouts by design."""
    return task.track == "layout" and task.split == "test"


def overlap_marks(overlaps: Iterable[str]) -> str:
    """Returns the marks of kinds of overlap, such as " †§"; empty if there is none."""
    found = set(overlaps)
    marks = "".join(kind.mark for name, kind in OVERLAPS.items() if name in found)
    return f" {marks}" if marks else ""


def overlap_legend(overlaps: Iterable[str]) -> list[str]:
    """Returns an explanation of each mark, such as "† ...", in the order of `OVERLAPS`."""
    found = set(overlaps)
    return [f"{kind.mark} {kind.meaning}" for name, kind in OVERLAPS.items() if name in found]


def describe_overlap(tasks: Sequence[Task], seen: SeenInTraining | None) -> str:
    """Returns sentences on the training data of an agent and the tasks of one group that it was evaluated on."""
    if seen is None:
        return "Unknown training data."
    if not seen.teammates and not seen.layouts:
        return "Not trained."
    kinds = list(dict.fromkeys(task.teammate_kind for task in tasks))
    shared = [kind for kind in kinds if kind in seen.teammates]
    same = sum(_is_known(task, seen) for task in tasks if task.teammate_kind in seen.teammates)
    parts = []
    if shared:
        which = _describe_identity(same, tasks, shared, seen)
        parts.append(f"Trained with teammates of kind {', '.join(shared)}: {which}.")
    else:
        parts.append(f"No teammate of kind {', '.join(kinds)} was in training.")
    if any(_is_layout_test(task) for task in tasks):
        on_layout = any(task.layout.name in seen.layouts for task in tasks)
        parts.append("This layout was in training." if on_layout else "This layout was not in training.")
    return " ".join(parts)


def _describe_identity(same: int, tasks: Sequence[Task], shared: Sequence[str], seen: SeenInTraining) -> str:
    if same:
        return f"{same} of these {len(tasks)} themselves"
    if any(seen.teammates[kind] is None for kind in shared):
        return "which ones is not recorded"
    return "others than these"


def describe_training(seen: SeenInTraining | None) -> str:
    """Returns layouts and teammates in training as text, such as "demo_wide; with utility_greedy (1), fcp (5)"."""
    if seen is None:
        return "unknown"
    if not seen.layouts and not seen.teammates:
        return "not trained"
    kinds = [f"{kind} ({'number unknown' if ids is None else len(ids)})" for kind, ids in seen.teammates.items()]
    return f"{', '.join(seen.layouts)}; with {', '.join(kinds)}"
