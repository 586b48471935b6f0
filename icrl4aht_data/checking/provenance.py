"""Checks of meta/provenance.json against the tasks and the index."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import Report
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.provenance import Provenance, StreamReturns
from icrl4aht_data.format.schema import HISTORIES, PROVENANCE, Entry
from icrl4aht_data.utils.files import json_hash

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
        _check_experts(provenance[task_id], entries, report)


def _check_experts(found: Provenance, entries: Sequence[Entry], report: Report) -> None:
    """Check that index and provenance have the same returns and steps of the expert."""
    for entry in entries:
        for name, expected in found.entry_fields().items():
            if (value := getattr(entry, name)) != expected:
                where = f"history {entry.history_id}: {name}"
                report.add(HISTORIES, f"{where} {value}, but {PROVENANCE} has {expected} of its task")


def _faults(found: Provenance, entries: Sequence[Entry], seed: int | None) -> Iterator[str]:
    """Yield contradictions within a provenance, and to the index and the task's seed."""
    if None not in (seed, found.seed) and found.seed != seed:
        yield f"seed: expected the task's {seed}, found {found.seed}"
    if found.ego is not None and found.ego_hash not in (None, json_hash(found.ego)):
        yield f"ego_hash: expected {json_hash(found.ego)} of `ego`, found {found.ego_hash}"
    if found.source not in (None, entries[0].source):
        yield f"source: expected {entries[0].source!r} as in the index, found {found.source!r}"
    names = found.suite and found.suite.algorithms.get(entries[0].layout)
    if names is not None and entries[0].teammate_kind not in names:
        yield f"suite.algorithms: {names}, but the teammate is of {entries[0].teammate_kind}"
    yield from _noise_faults(found, entries)
    yield from _learner_faults(found, entries)
    yield from _stream_faults(found, entries)


def _noise_faults(found: Provenance, entries: Sequence[Entry]) -> Iterator[str]:
    """Check the numbers of noise histories and of their episodes, and that their expert is the script."""
    labeller = found.expert and found.expert.policy_sha256
    if entries[0].source == "noise" and labeller:
        yield f"expert.policy_sha256: expected null, as the script labels noise histories, found {labeller}"
    histories, episodes = ((found.noise or {}).get(name) for name in ("histories", "episodes"))
    if histories is not None and histories < len(entries):
        yield f"noise.histories: expected at least the {len(entries)} of the index, found {histories}"
    for entry in entries:
        if episodes not in (None, entry.episodes):
            yield f"noise.episodes: expected the {entry.episodes} of history {entry.history_id}, found {episodes}"
            return


def _learner_faults(found: Provenance, entries: Sequence[Entry]) -> Iterator[str]:
    """Check the numbers of learners and environments against the recorded streams and the index."""
    learners = found.learners or 1
    last = max(entries, key=lambda entry: entry.learner)
    if last.learner >= learners:
        yield f"history {last.history_id}: learner {last.learner}, but learners are {learners}"
    if found.ego is None:
        return
    environments = found.ego["environments"]
    if found.streams_recorded not in (None, learners * environments):
        each = f"the learner's {environments}" if learners == 1 else f"{environments} of each of {learners} learners'"
        yield f"streams_recorded: expected {each} environments, found {found.streams_recorded}"
    last = max(entries, key=lambda entry: entry.env_idx)
    if learners > 1 and last.env_idx >= environments:
        yield f"history {last.history_id}: env_idx {last.env_idx}, but a learner has {environments} environments"


def _stream_faults(found: Provenance, entries: Sequence[Entry]) -> Iterator[str]:
    recorded, kept = found.streams_recorded, found.streams_kept
    for name, value in (("streams_recorded", recorded), ("streams_kept", kept)):
        if value is not None and value < len(entries):
            yield f"{name}: expected at least the {len(entries)} histories of the index, found {value}"
    if recorded is not None and kept is not None and kept > recorded:
        yield f"streams_kept: expected at most the {recorded} recorded ones, found {kept}"
    last = max(entries, key=lambda entry: entry.env_idx)
    if recorded is not None and last.env_idx >= recorded:
        yield f"history {last.history_id}: env_idx {last.env_idx}, but {recorded} streams were recorded"
    if found.filter is None:
        return
    for name, side, streams in (("before", found.filter.before, recorded), ("after", found.filter.after, kept)):
        if streams is not None and side.streams != streams:
            yield f"filter.{name}.streams: expected {streams}, found {side.streams}"
    if found.filter.after.streams == len(entries):
        yield from _filter_faults(found.filter.after, entries)


def _filter_faults(after: StreamReturns, entries: Iterable[Entry]) -> Iterator[str]:
    """Check the mean returns of the kept streams against the index."""
    members = list(entries)
    for name in ("return_start", "return_end"):
        mean, said = np.mean([getattr(entry, name) for entry in members]), getattr(after, name)
        if not abs(mean - said) <= _ROUNDING:
            yield f"filter.after.{name}: the index gives {mean:.3f}, found {said}"
