"""Layouts and teammates in a model's training data, and their overlap with the tasks of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from msgspec import Struct, ValidationError, convert

from icrl4aht_data.benchmark.facts import KIND_FAMILIES, TEAMMATE_PLUGINS, all_families
from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.format.layouts_file import is_generated
from icrl4aht_data.overcooked.layouts import get_layout

TRAINED_ON = "trained_on"
"""Key of the record of training data, in a run's config.json and in the `details` of evaluation settings."""

TASKS_SOURCE = "tasks"
"""Value of `source` in a record of training data, for teammates that a model played with without histories."""


class SeenInTraining(NamedTuple):
    """Layouts and teammates that a model was trained with, in histories or by playing.

    Attributes:
        layouts: names of the layouts.
        teammates: kind of teammate, such as "utility_greedy" or "fcp" -> ids of the teammates of this kind, see
            `tasks.teammate_id`; None if the ids are not known.
    """

    layouts: tuple[str, ...] = ()
    teammates: Mapping[str, tuple[str, ...] | None] = {}


class _Entry(Struct):
    """Entry of a record of training data, see `histories.training_record`."""

    layout: str
    family: str
    algorithm: str | None = None
    teammates: list[str] | None = None


def parse_training_record(entries: Any, where: str) -> SeenInTraining:
    """Return the layouts and teammates that a record of training data states.

    Args:
        entries: JSON list of entries with `layout` and `family`, usually also `algorithm` (kind of a heuristic, or
            algorithm of a learned teammate) and `teammates` (ids, see `tasks.teammate_id`); empty for an agent that
            was not trained.
        where: origin of the record, for messages.

    Raises:
        OptionError: if the record has another form, or an unknown layout, family or algorithm.
    """
    expected = (
        f"{where}: {TRAINED_ON}: expected a layout, a family ({', '.join(all_families())}), perhaps an algorithm of "
        f"this family and a list of teammates' ids"
    )
    try:
        read = convert(entries, list[_Entry])
    except ValidationError as error:
        raise OptionError(f"{expected}; found {str(entries)[:200]!r} ({error})") from error
    seen: dict[str, tuple[str, ...] | None] = {}
    layouts = []
    for entry in read:
        kinds = [kind for kind, family in KIND_FAMILIES.items() if family == entry.family]
        kinds = kinds or [name for name in TEAMMATE_PLUGINS.names if name == entry.family]
        if not kinds or entry.algorithm not in (None, *kinds):
            raise OptionError(f"{expected}; found {entry}")
        try:  # generated layouts may be unknown in this process, and the layout track does not test on them
            layouts.append(entry.layout if is_generated(entry.layout) else get_layout(entry.layout).name)
        except UnknownNameError as error:
            raise OptionError(f"{where}: {TRAINED_ON}: {error}") from error
        for kind in [entry.algorithm] if entry.algorithm else kinds:
            ids, known = entry.teammates, seen.get(kind, ())
            seen[kind] = None if ids is None or known is None else tuple(sorted({*known, *ids}))
    return SeenInTraining(tuple(dict.fromkeys(layouts)), seen)


OVERLAPS = {
    "teammate": ("‡", "the agent was trained with one of these very teammates"),
    "family": (
        "†",
        "the agent was trained with other teammates of this family, or of this algorithm if they are learned; members "
        "of a family may act alike, so this score does not show how the agent plays with unknown kinds of teammates",
    ),
    "layout": ("§", "the agent was trained on this layout, which the track uses only for tests"),
    "unknown": ("?", "unknown training data: nothing says what the agent was trained on"),
}
"""Kind of overlap of training data and evaluated tasks -> its mark behind a score, and the meaning of the mark."""


def sorted_overlaps(names: Iterable[str]) -> tuple[str, ...]:
    """Return kinds of overlap in the order of `OVERLAPS`, without repetitions."""
    found = set(names)
    return tuple(name for name in OVERLAPS if name in found)


def find_overlaps(tasks: Iterable[Task], seen: SeenInTraining | None) -> tuple[str, ...]:
    """Return the kinds of overlap between tasks and training data, in the order of `OVERLAPS`.

    Args:
        tasks: tasks that an agent was evaluated on.
        seen: layouts and teammates in the agent's training; None if they are not known.
    """
    if seen is None:
        return ("unknown",)
    found = set()
    for task in tasks:
        if task.teammate_kind in seen.teammates:
            known = teammate_id(task.teammate) in (seen.teammates[task.teammate_kind] or ())
            found.add("teammate" if known else "family")
        # Only test tasks of the layout track are on layouts that are reserved for tests.
        if (task.track, task.split) == ("layout", "test") and task.layout.name in seen.layouts:
            found.add("layout")
    return sorted_overlaps(found)


def overlap_marks(overlaps: Iterable[str]) -> str:
    """Return the symbols for kinds of overlap as text, such as " †§"; an empty string without overlap."""
    marks = "".join(OVERLAPS[name][0] for name in sorted_overlaps(overlaps))
    return f" {marks}" if marks else ""


def overlap_legend(overlaps: Iterable[str]) -> list[str]:
    """Return a line for each kind of overlap, with its symbol and meaning, in the order of `OVERLAPS`."""
    return [" ".join(OVERLAPS[name]) for name in sorted_overlaps(overlaps)]


def describe_overlap(overlaps: Iterable[str]) -> str:
    """Return a sentence that describes kinds of overlap with the training data."""
    texts = "; ".join(OVERLAPS[name][1] for name in sorted_overlaps(overlaps))
    return f"Overlap with the training data: {texts}." if texts else "No overlap with the training data."


def describe_training(seen: SeenInTraining | None) -> str:
    """Return text on layouts and teammates in training, such as "demo_wide; with utility_greedy (1), fcp (5)"."""
    if seen is None:
        return "unknown"
    if not seen.layouts and not seen.teammates:
        return "not trained"
    kinds = [f"{kind} ({'number unknown' if ids is None else len(ids)})" for kind, ids in seen.teammates.items()]
    return f"{', '.join(seen.layouts)}; with {', '.join(kinds)}"
