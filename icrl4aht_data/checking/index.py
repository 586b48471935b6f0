"""Checks of a release's index against its tasks, its meta/info.json and the names of its shards."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import Report
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.info import describe, shard_sizes
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, PROVENANCE, TASKS, Entry
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.paths import resolve_inside
from icrl4aht_data.writing.statistics import layout_statistics

_NAMED = 100  # missing shards of one set that are reported


def check_index(index: Index, tasks: list[Task], chosen: set[str], report: Report) -> None:
    """Check that index, tasks, totals and shard names agree.

    Args:
        index: the release's index.
        tasks: its tasks.
        chosen: the files that are verified; statistics can be recomputed only if all shards are among them.
        report: receives the problems.
    """
    _check_tasks(index, tasks, report)
    _check_disjoint_teammates(tasks, report)
    if not index.entries:
        report.add(HISTORIES, "no histories")
    _check_info(index, tasks, chosen, report)
    _check_experts(index, report)
    shards = {entry.shard for entry in index.entries}
    for shard in shards:
        stem, count = shard.removesuffix(".h5").split("-")[0], int(shard.removesuffix(".h5").split("-")[-1])
        names = (f"{stem}-{number:05}-of-{count:05}.h5" for number in range(count))
        for name in islice((name for name in names if name not in shards), _NAMED):
            report.add(name, f"the name of {shard} implies this shard, but no history of the index is in it")


def _check_tasks(index: Index, tasks: list[Task], report: Report) -> None:
    by_id = {task.task_id: task for task in tasks}
    has_tasks = bool(tasks) or index.info.kind in KINDS
    streams: set[tuple[str, int]] = set()
    for entry in index.entries:
        task = by_id.get(entry.task_id)
        if task is None and has_tasks:
            report.add(TASKS, f"history {entry.history_id}: its task {entry.task_id!r} is missing")
        elif task is not None and not _describes(task, entry):
            report.add(TASKS, f"history {entry.history_id}: index and task {entry.task_id!r} disagree")
        if (entry.task_id, entry.env_idx) in streams:
            report.add(HISTORIES, f"history {entry.history_id}: stream {entry.env_idx} of its task appears twice")
        streams.add((entry.task_id, entry.env_idx))
    for task_id in by_id.keys() - {task_id for task_id, _ in streams}:
        report.add(TASKS, f"task {task_id!r} has no history")


def _describes(task: Task, entry: Entry) -> bool:
    names = ("track", "split", "teammate_kind", "teammate_family", "seed")
    return task.layout.name == entry.layout and all(getattr(task, name) == getattr(entry, name) for name in names)


def _check_experts(index: Index, report: Report) -> None:
    """Check that the index has the returns and steps of experts that the provenance has."""
    try:
        provenance = read_provenance(resolve_inside(index.root, PROVENANCE))
    except Icrl4ahtError as error:
        if report.ok:  # otherwise it is reported already
            report.add(PROVENANCE, str(error))
        return
    fields = {task_id: of_task.entry_fields() for task_id, of_task in provenance.items()}
    for entry in index.entries:
        for name, expected in fields.get(entry.task_id, Provenance().entry_fields()).items():
            if (found := getattr(entry, name)) != expected:
                where = f"history {entry.history_id}: {name}"
                report.add(HISTORIES, f"{where} {found}, but {PROVENANCE} has {expected} of its task")


def _check_disjoint_teammates(tasks: list[Task], report: Report) -> None:
    """Check that no teammate of a training task is one of a test task on the same track."""
    seen: dict[tuple[str, str, str], str] = {}
    for task in sorted(tasks, key=lambda task: task.split, reverse=True):  # train before test
        key = (task.track, task.layout.name, json.dumps(task.teammate, sort_keys=True))
        if task.split == "train":
            seen[key] = task.task_id
        elif key in seen:
            report.add(TASKS, f"task {task.task_id!r} ({task.split}) has the teammate of {seen[key]!r} (train)")


def _check_info(index: Index, tasks: list[Task], chosen: set[str], report: Report) -> None:
    """Check that meta/info.json has the totals of the index and, if all shards are here and valid, their statistics."""
    root, info, shards = index.root, index.info, index.values("shard")
    kept_steps = info.environment.kept_steps
    described = describe(info.kind, info.data_version, kept_steps, list(index.entries), info.format_version)
    if report.ok and report.level != "quick" and all(name in chosen and (root / name).is_file() for name in shards):
        try:
            provenance = read_provenance(resolve_inside(root, PROVENANCE))
            sizes = shard_sizes(root, index.entries)
            statistics = layout_statistics(index.entries, tasks, provenance, kept_steps, sizes)
            described = replace(described, shards=sizes, statistics=statistics)
        except (Icrl4ahtError, OSError) as error:
            report.add(INFO, f"statistics cannot be computed from {PROVENANCE} and the shards: {error}")
    elif info.shards.keys() != set(shards):
        report.add(INFO, f"shards: expected {sorted(shards)}, found {sorted(info.shards)}")
    found = parse_json(read_text(resolve_inside(root, INFO)))  # also fields that `ReleaseInfo` does not have
    for name, expected in described.to_json().items():
        if found.get(name) != expected:
            report.add(INFO, f"{name}: expected {expected!r}, found {found.get(name)!r}")
