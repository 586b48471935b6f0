"""Checks of meta/provenance.json against the tasks and the index."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter, eq, ge, le, lt
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import SCRIPTED_SOURCES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import Report
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import HISTORIES, PROVENANCE, Entry
from icrl4aht_data.utils.files import json_hash
from icrl4aht_data.utils.text import counted_noun

_ROUNDING = 1e-3  # tolerance of the mean returns that a stream filter records


def check_provenance(index: Index, tasks: Sequence[Task], provenance: Mapping[str, Provenance], report: Report) -> None:
    """Check the provenance of each task: learners, streams, filter, noise and expert.

    Args:
        index: the release's index.
        tasks: its tasks; none in a release that knows them by name only.
        provenance: task id -> how its histories were made.
        report: receives the problems.
    """
    members: dict[str, list[Entry]] = defaultdict(list)
    for entry in index.entries:
        members[entry.task_id].append(entry)
    seeds = {task.task_id: task.seed for task in tasks}
    for task_id in provenance.keys() - members.keys():
        report.add(PROVENANCE, f"task {task_id!r}: has no history")
    for task_id, entries in members.items():
        if task_id not in provenance:
            report.add(PROVENANCE, f"task {task_id!r}: missing")
            continue
        for fault in _faults(provenance[task_id], entries, seeds.get(task_id)):
            report.add(PROVENANCE, f"task {task_id!r}: {fault}")
        for entry in entries:
            for name, expected in provenance[task_id].entry_fields(entry.episodes).items():
                if (value := getattr(entry, name)) != expected:
                    where = f"history {entry.history_id}: {name}"
                    report.add(HISTORIES, f"{where} {value}, but {PROVENANCE} has {expected} of its task")


def _faults(made: Provenance, entries: Sequence[Entry], seed: int | None) -> Iterator[str]:
    """Yield contradictions within a provenance, and to the index and the task's seed."""
    first, count = entries[0], len(entries)
    if first.source in SCRIPTED_SOURCES and made.expert and made.expert.policy_sha256:
        labeller = made.expert.policy_sha256
        yield f"expert.policy_sha256: expected null, as the script labels {first.source} histories, found {labeller}"
    names = made.suite and made.suite.algorithms.get(first.layout)
    if names is not None and first.teammate_kind not in names:
        yield f"suite.algorithms: {names}, but the teammate is of {first.teammate_kind}"
    recorded, kept, learners, noise = made.streams_recorded, made.streams_kept, made.learners or 1, made.noise or {}
    environments: int | None = made.ego["environments"] if made.ego else None
    episodes = noise.get("episodes")
    stream, learner = (max(entries, key=attrgetter(name)) for name in ("env_idx", "learner"))
    other = next((entry for entry in entries if entry.episodes != episodes), first)
    # Name, value, relation, bound, and the bound in words; a value or bound that is None is unknown.
    checks: list[tuple[str, Any, Callable[[Any, Any], bool], Any, str]] = [
        ("seed", made.seed, eq, seed, "the task's {}"),
        ("ego_hash", made.ego_hash, eq, made.ego and json_hash(made.ego), "{} of `ego`"),
        ("source", made.source, eq, first.source, "{!r} as in the index"),
        ("noise.histories", noise.get("histories"), ge, count, "at least the {} of the index"),
        ("noise.episodes", episodes, eq, other.episodes, f"the {{}} of history {other.history_id}"),
        (f"history {learner.history_id}: learner", learner.learner, lt, learners, "less than the {} learners"),
        (f"history {stream.history_id}: env_idx", stream.env_idx, lt, recorded, "less than the {} recorded streams"),
        ("streams_recorded", recorded, ge, count, "at least the {} histories of the index"),
        ("streams_kept", kept, ge, count, "at least the {} histories of the index"),
        ("streams_kept", kept, le, recorded, "at most the {} recorded ones"),
    ]
    if environments is not None:
        words = f"{{}}, {environments} of each of {counted_noun(learners, 'learner')}"
        checks.append(("streams_recorded", recorded, eq, learners * environments, words))
        if learners > 1:
            name = f"history {stream.history_id}: env_idx"
            checks.append((name, stream.env_idx, lt, environments, "less than the {} environments of a learner"))
    if made.filter is not None:
        after = made.filter.after
        checks.append(("filter.before.streams", made.filter.before.streams, eq, recorded, "{}"))
        checks.append(("filter.after.streams", after.streams, eq, kept, "{}"))
        for name in ("return_start", "return_end") if after.streams == count else ():
            mean = np.mean([getattr(entry, name) for entry in entries])
            checks.append((f"filter.after.{name}", getattr(after, name), _is_close, mean, "the index's {:.3f}"))
    for name, value, relation, bound, words in checks:
        if value is not None and bound is not None and not relation(value, bound):
            yield f"{name}: expected {words.format(bound)}, found {value!r}"


def _is_close(value: float, mean: float) -> bool:
    return abs(value - mean) <= _ROUNDING
