"""Checks of a release's index against its tasks, totals and shard names, and checks of meta/provenance.json."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import islice
from operator import attrgetter, eq, ge, le, lt
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import SCRIPTED_SOURCES, kind_family
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import Report
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.info import ReleaseInfo, layout_statistics, make_info
from icrl4aht_data.format.provenance import Provenance, ProvenanceByTask
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, PROVENANCE, TASKS, Entry
from icrl4aht_data.utils.files import json_hash, read_json, resolve_inside
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_noun

_ROUNDING = 1e-3  # tolerance between the mean returns in `Provenance.filter` and in the index
_NAMED = 100  # maximum number of missing shards to report for each shard in the index
_OF_A_TASK = (
    *("track", "split", "layout", "teammate_family", "teammate_kind", "seed", "source"),
    *("expert_return", "expert_return_sampled", "expert_step", "label_view"),
)
"""Index fields that are equal for all histories of a task."""
_described = attrgetter("track", "split", "teammate_kind", "teammate_family", "seed")


def check_index(
    index: Index, tasks: list[Task], played: Iterable[Task], provenance: ProvenanceByTask | None, report: Report
) -> None:
    """Check that the index, the tasks, the totals and the names of shards agree.

    Args:
        index: the release's index.
        tasks: the release's tasks.
        played: the release's tasks; a task with several teammates appears once for each teammate.
        provenance: task id -> record of how the task's histories were made; None if unreadable.
        report: receives the problems.
    """
    _check_tasks(index, tasks, report)
    _check_disjoint_teammates(played, report)
    if not index.entries:
        report.add(HISTORIES, "no histories")
    for task in index.info.left_out:
        if index.entries.matches("task_id", [task.task_id]).any():
            report.add(INFO, f"left_out: task {task.task_id!r} has histories in the index")
    _check_info(index, tasks, provenance, report)
    shards = index.values("shard")
    for stem, count in dict.fromkeys(tuple(shard.removesuffix(".h5").rsplit("-", 3)[::3]) for shard in shards):
        names = (f"{stem}-{number:05}-of-{count}.h5" for number in range(int(count)))
        for name in islice((name for name in names if name not in shards), _NAMED):
            report.add(name, "names of other shards imply this shard, but no history of the index is in it")


def _check_tasks(index: Index, tasks: list[Task], report: Report) -> None:
    by_id = {task.task_id: task for task in tasks}
    has_tasks = bool(tasks) or index.info.kind in KINDS
    streams: set[tuple[str, int, int]] = set()
    first: dict[str, Entry] = {}
    for entry in index.entries:
        where, stream = f"history {entry.history_id}:", (entry.task_id, entry.learner, entry.env_idx)
        task, other = by_id.get(entry.task_id), first.setdefault(entry.task_id, entry)
        if unlike := [name for name in _OF_A_TASK if getattr(entry, name) != getattr(other, name)]:
            report.add(HISTORIES, f"histories {other.history_id} and {entry.history_id} of one task differ in {unlike}")
        firsts = [episode for episode, _ in entry.teammate_of_episode or ((0, ""),)]
        if firsts[0] != 0 or firsts != sorted(set(firsts)) or firsts[-1] >= entry.episodes:
            expected = f"expected ascending episodes from 0 to {entry.episodes - 1} at most"
            report.add(HISTORIES, f"{where} teammate_of_episode: {expected}, found {firsts}")
        if not has_tasks and entry.seed != -1:
            report.add(HISTORIES, f"{where} seed: expected -1 without tasks, found {entry.seed}")
        if kind_family(entry.teammate_kind) not in (None, entry.teammate_family):
            problem = f"teammate_kind {entry.teammate_kind!r} is of another family than {entry.teammate_family}"
            report.add(HISTORIES, f"{where} {problem}")
        if task is None and has_tasks:
            report.add(TASKS, f"{where} its task {entry.task_id!r} is missing")
        elif task is not None and (task.layout.name, *_described(task)) != (entry.layout, *_described(entry)):
            report.add(TASKS, f"{where} index and task {entry.task_id!r} disagree")
        if stream in streams:
            of = f"learner {entry.learner} of " if entry.learner else ""
            report.add(HISTORIES, f"{where} stream {entry.env_idx} of {of}its task appears twice")
        streams.add(stream)
    for task_id in sorted(by_id.keys() - first.keys()):
        report.add(TASKS, f"task {task_id!r} has no history")


def _check_disjoint_teammates(tasks: Iterable[Task], report: Report) -> None:
    """Check that no task of another split has the teammate of a training task on the same track and layout."""
    seen: dict[tuple[str, ...], str] = {}
    for task in sorted(tasks, key=lambda task: task.split != "train"):  # training tasks come first
        key = (task.track, task.layout.name, task.teammate_kind, json_hash(task.teammate["theta"]))
        if task.split == "train":
            seen[key] = task.task_id
        elif key in seen:
            report.add(TASKS, f"task {task.task_id!r} ({task.split}) has the teammate of {seen[key]!r} (train)")


def _check_info(index: Index, tasks: list[Task], provenance: ProvenanceByTask | None, report: Report) -> None:
    """Check the totals and statistics in meta/info.json against the index."""
    root, info, shards = index.root, index.info, index.values("shard")
    entries = list(index.entries)
    described = make_info(info.kind, info.data_version, info.environment.kept_steps, entries, info.format_version)
    described = replace(described, left_out=info.left_out, shards=info.shards)
    if info.shards.keys() != set(shards):
        report.add(INFO, f"shards: expected {sorted(shards)}, found {sorted(info.shards)}")
    elif report.ok and provenance is not None:
        described = replace(described, statistics=layout_statistics(described, entries, tasks, provenance))
    found = read_json(resolve_inside(root, INFO))  # read as plain JSON, to find unknown fields
    for name in sorted(found.keys() - {field.name for field in fields(ReleaseInfo)}):
        report.add(INFO, f"{name}: an unknown field")
    for name, expected in described.to_json().items():
        if found.get(name) != expected:
            report.add(INFO, f"{name}: expected {expected!r}, found {found.get(name)!r}")


def check_provenance(index: Index, tasks: Sequence[Task], provenance: Mapping[str, Provenance], report: Report) -> None:
    """Check each task's provenance (learners, environment streams, filter, noise, expert) against index and tasks.

    Args:
        index: the release's index.
        tasks: the release's tasks; empty if the release has only the names of its tasks.
        provenance: task id -> record of how the task's histories were made.
        report: receives the problems.
    """
    members = grouped(index.entries, lambda entry: entry.task_id)
    seeds = {task.task_id: task.seed for task in tasks}
    for task_id in sorted(provenance.keys() - members.keys()):
        report.add(PROVENANCE, f"task {task_id!r}: has no history")
    for task_id, entries in members.items():
        if task_id not in provenance:
            report.add(PROVENANCE, f"task {task_id!r}: missing")
            continue
        for fault in _contradictions(provenance[task_id], entries, seeds.get(task_id)):
            report.add(PROVENANCE, f"task {task_id!r}: {fault}")
        for entry in entries:
            for name, expected in provenance[task_id].entry_fields(entry.episodes, entry.has_expert_actions).items():
                if (value := getattr(entry, name)) != expected:
                    where = f"history {entry.history_id}: {name}"
                    report.add(HISTORIES, f"{where} {value}, but {PROVENANCE} has {expected} of its task")


def _contradictions(made: Provenance, entries: Sequence[Entry], seed: int | None) -> Iterator[str]:
    """Yield each contradiction within a task's provenance, or with the index entries or the task's seed."""
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
    # Checks are (name, value, relation, bound, text of the bound). Checks with value or bound None are skipped.
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
        after, is_close = made.filter.after, partial(math.isclose, rel_tol=0, abs_tol=_ROUNDING)
        checks.append(("filter.before.streams", made.filter.before.streams, eq, recorded, "{}"))
        checks.append(("filter.after.streams", after.streams, eq, kept, "{}"))
        for name in ("return_start", "return_end") if after.streams == count else ():
            mean = np.mean([getattr(entry, name) for entry in entries])
            checks.append((f"filter.after.{name}", getattr(after, name), is_close, mean, "the index's {:.3f}"))
    for name, value, relation, bound, words in checks:
        if value is not None and bound is not None and not relation(value, bound):
            yield f"{name}: expected {words.format(bound)}, found {value!r}"
