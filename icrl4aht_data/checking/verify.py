"""Verification of releases: hashes, checksums, counts and ranges; at level "deep" also rendering and replay.

A release of observations cannot be replayed: level "deep" checks only that each observation matches the layout.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.checking.files import check_files, check_references, check_remote_sizes
from icrl4aht_data.checking.index import check_index, check_provenance
from icrl4aht_data.checking.report import Level, NamedProgress, Report
from icrl4aht_data.checking.shards import check_chunks, check_history, check_structure
from icrl4aht_data.clients import check_credentials, without_credentials
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import EmptySelectionError, Icrl4ahtError, UnknownNameError, check_choice
from icrl4aht_data.fetch import ReleaseLocation, Remote, check_root, chosen_files, open_root
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.provenance import Provenance, ProvenanceByTask, read_provenance
from icrl4aht_data.format.schema import KINDS, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.selection import FilterValues
from icrl4aht_data.reading.shard import ChunkCache, Shard
from icrl4aht_data.utils.files import resolve_inside
from icrl4aht_data.utils.groups import grouped

_NOT_RECOMPUTED = {
    "references": "returns of reference egos, of {} tasks: taken from meta/provenance.json, not measured again",
    "nearest_test": "nearest test teammates, of {} tasks: taken from meta/provenance.json, not measured again",
    "swaps": "changes of teammates, of {} tasks: taken from meta/provenance.json, not compared with their actions",
    "noise": "noise schedules, of {} tasks: taken from meta/provenance.json, not compared with the actions",
}
"""Provenance field whose values verification cannot recompute -> note in the report."""


def verify_release(
    root: str | Path | None = None,
    *,
    level: Level = "full",
    advance: NamedProgress = lambda what, done, total: None,
    **wanted: FilterValues,
) -> Report:
    """Verify a release and return a report; problems of the release are reported, not raised.

    Args:
        root: a release folder, or an address as in `load_icrl4aht`; the bundled mini release by default. Files of a
            remote release are downloaded before they are checked, except at level "quick".
        level: "quick" checks names, sizes and the index, but reads no arrays. "full" checks every byte, count and
            range. "deep" also checks that observations match the states, that every recorded state and reward follows
            from the previous step under the rules, and that every episode starts in a possible initial state. Without
            state records, "deep" only checks that every observation shows the layout, and adds a note to the report.
        advance: called with the name of a stage, the number of items done, and their total.
        wanted: filters on index fields as in `load_icrl4aht`; only shards with matching histories are checked. For a
            partially downloaded release, give the filters of the download.

    Raises:
        UnknownNameError: if `level` or a name in `wanted` does not exist.
        EmptySelectionError: if no history matches `wanted`.
        OptionError: if `root` is neither a path nor an address, or an address has a user name or password that is not
            percent-encoded.
    """
    check_choice("level", level, get_args(Level))
    root = MINI if root is None else root
    check_root(root)
    check_credentials(str(root))
    report = Report(without_credentials(str(root)), level)
    try:
        origin = open_root(root)
    except Icrl4ahtError as error:
        report.add(".", str(error))
        return report
    if not origin.folder.is_dir():
        report.add(".", f"{origin.folder}: no such folder; give the folder or the address of a release")
        return report
    report.root = str(origin)
    try:
        _verify(origin, report, advance, wanted)
    except (Icrl4ahtError, OSError) as error:
        if isinstance(error, (EmptySelectionError, UnknownNameError)) and any(wanted.values()):
            raise  # wrong arguments are errors of the caller, not of the release
        report.add("meta", str(error))
    return report


def _verify(origin: ReleaseLocation, report: Report, advance: NamedProgress, wanted: dict[str, FilterValues]) -> None:
    listed: Mapping[str, str] = {}
    try:
        listed = read_manifest(origin.folder)
    except Icrl4ahtError as error:
        report.add(MANIFEST, str(error))
    chosen, unreadable = set(listed), None
    try:
        chosen = chosen_files(origin, **wanted)
    except (EmptySelectionError, UnknownNameError):
        raise
    except Icrl4ahtError as error:  # reported after the damaged files, which may have caused this error
        unreadable = error
    if report.level != "quick":
        origin.fetch(sorted(chosen))
    check_files(origin, listed, chosen, report, advance)
    if unreadable is not None:
        report.add("meta", str(unreadable))
        return
    index, tasks = read_index(origin.folder), read_tasks(resolve_inside(origin.folder, TASKS))
    report.replayed = report.level == "deep" and index.info.kind in KINDS
    if report.level == "deep" and not report.replayed:
        report.notes.append("nothing was replayed: without state records, steps cannot be compared with the rules")
    provenance = None
    try:
        provenance = read_provenance(resolve_inside(origin.folder, PROVENANCE))
    except Icrl4ahtError as error:
        if PROVENANCE not in report.files_at_fault:
            report.add(PROVENANCE, str(error))
    made = provenance or ProvenanceByTask()
    played = [one for task in tasks for one in made.of(task.task_id).played_tasks(task)]
    check_references(listed, index, played, provenance, report)
    if report.level == "deep":
        report.notes += _unchecked_values(index, made)
    if provenance is not None:
        check_provenance(index, tasks, provenance, report)
    check_index(index, tasks, played, provenance, report)
    shards = [name for name in index.values("shard") if name in chosen]
    skipped = len(index.values("shard")) - len(shards)
    if skipped:
        report.notes.append(f"{skipped} of {skipped + len(shards)} shards were not selected")
    if report.level != "quick":
        _check_shards(index, {task.task_id: task.layout for task in tasks}, shards, report, advance)
    elif isinstance(origin, Remote):
        check_remote_sizes(origin, index, shards, report)


def _unchecked_values(index: Index, provenance: Mapping[str, Provenance]) -> Iterator[str]:
    """Yield notes about the values that verification cannot recompute."""
    if count := np.count_nonzero(index.entries.column("has_oracle_actions")):
        yield f"oracle actions of {count} histories: only their range was checked, not the script's choices"
    for name, note in _NOT_RECOMPUTED.items():
        if count := sum(getattr(of_task, name) is not None for of_task in provenance.values()):
            yield note.format(count)


def _check_shards(
    index: Index, layouts: Mapping[str, Layout], shards: list[str], report: Report, advance: NamedProgress
) -> None:
    """Check shards and their histories; `layouts` maps task ids to layouts with the tasks' recipes."""
    local = ReleaseLocation(index.root)  # a local location downloads nothing; missing files are already reported
    members = grouped(index.entries, lambda entry: entry.shard)
    total = sum(len(members[name]) for name in shards)
    contents: dict[bytes, int] = {}
    for name in shards:
        entries = members[name]
        try:
            shard = Shard(local, name, index.info, entries, ChunkCache())
        except Icrl4ahtError as error:
            report.add(name, str(error))
            continue
        for fault in check_structure(shard, values=report.level == "deep"):
            report.add(name, fault)
        damaged = check_chunks(shard, report)
        for entry in entries:
            if entry.history_id not in damaged:
                layout = layouts.get(entry.task_id) or get_layout(entry.layout)
                history = History(entry, lambda name, shard=shard: shard, "uint8")
                check_history(history, layout, index.info, contents, report)
            report.histories += 1
            advance("histories", report.histories, total)
