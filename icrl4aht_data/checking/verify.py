"""Is a release whole, and does its physics hold? Hashes, checksums, counts, ranges; `deep`: rendering and replay.

A release of observations cannot be replayed; `deep` then asks whether each observation shows the layout from some cell.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.checking.histories import _check_chunks, _check_history
from icrl4aht_data.checking.report import NamedProgress, Report
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import EmptySelectionError, Icrl4ahtError, OptionError, UnknownNameError
from icrl4aht_data.format.checkpoints import checkpoint_files
from icrl4aht_data.format.chunks import chunk_table_name, read_table
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.info import LayoutStatistics, describe, shard_sizes
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import (
    HISTORIES,
    INFO,
    KINDS,
    MANIFEST,
    PROVENANCE,
    TASKS,
    TEAMMATES,
)
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.selection import Names
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.remote.download import ORIGIN, chosen_files
from icrl4aht_data.remote.remote_release import ReleaseLocation, Remote, open_root
from icrl4aht_data.remote.store import Traffic
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import LARGEST, files_below, resolve_inside
from icrl4aht_data.writing.statistics import layout_statistics

_OF_THE_HUB = (".gitattributes", ".cache/huggingface/")
"""What its own tools put beside a repository's files."""

_LOST = 100  # shards of one set that are named


def verify_release(
    root: str | Path | None = None,
    *,
    deep: bool = False,
    quick: bool = False,
    advance: NamedProgress = lambda what, done, total: None,
    **wanted: Names,
) -> Report:
    """Check a release; never raises for what is wrong in it.

    Args:
        root: a release folder, or an address as in `load_icrl4aht`; the bundled mini release by default. Of a remote
            release all that is checked comes here first, unless `quick`.
        deep: also check that observations are what the states show, that every recorded step follows from the one
            before under the rules, with the recorded reward, and that every episode starts as the environment starts.
            Without state records only that every observation shows the layout; a note says so.
        quick: check names, sizes and the index alone, no contents.
        advance: progress.
        wanted: check the shards of these histories alone; see `load_icrl4aht`. A folder that `download` filled with a
            part of a release has to have that part.

    Raises:
        UnknownNameError, EmptySelectionError: if there is nothing of what is `wanted`.
    """
    if deep and quick:
        raise OptionError("deep and quick: give one of them")
    report = Report(str(MINI if root is None else root), deep, quick)
    try:
        origin = open_root(MINI if root is None else root)
    except Icrl4ahtError as error:
        report.add(".", str(error))
        return report
    if not origin.folder.is_dir():
        report.add(".", f"{origin.folder}: no such folder; give the folder or the address of a release")
        return report
    before = origin.remote.store.traffic if origin.remote else Traffic()
    report.root = str(origin)
    try:
        _verify(origin, report, advance, wanted)
    except (Icrl4ahtError, OSError) as error:
        if isinstance(error, (EmptySelectionError, UnknownNameError)) and any(wanted.values()):
            raise  # nothing is wrong with the release
        report.add("meta", str(error))
    if origin.remote is not None:
        traffic = origin.remote.store.traffic - before
        report.fetched_bytes, report.requests = traffic.bytes, traffic.requests
    return report


def _verify(origin: ReleaseLocation, report: Report, advance: NamedProgress, wanted: dict[str, Names]) -> None:
    listed = _manifest(origin, report)
    chosen, unreadable = set(listed), None
    try:
        chosen = chosen_files(origin, **wanted)
    except (EmptySelectionError, UnknownNameError):
        raise
    except Icrl4ahtError as error:
        unreadable = error
    if origin.remote is not None and not report.quick:
        _fetch(origin.remote, sorted(chosen), report, advance)
    _check_files(
        origin, {name: digest for name, digest in listed.items() if name in chosen}, listed.keys(), report, advance
    )
    if unreadable is not None:
        report.add("meta", str(unreadable))
        return
    index = read_index(origin.folder)
    tasks = read_tasks(resolve_inside(origin.folder, TASKS))
    report.replayed = report.deep and index.info.kind in KINDS
    if report.deep and not report.replayed:
        report.notes.append(
            "nothing was replayed: without state records it cannot be said whether steps obey the rules"
        )
    _check_index(index, tasks, chosen, report)
    shards = [name for name in index.values("shard") if name in chosen]
    left = len(index.values("shard")) - len(shards)
    if left:
        report.notes.append(f"{left} of {left + len(shards)} shards were not asked for")
    if report.quick:
        _check_sizes(origin, index, shards, report)
    else:
        _check_teammates(origin.folder, tasks, report)
        _check_shards(index, shards, report, advance)


def _fetch(remote: Remote, names: list[str], report: Report, advance: NamedProgress) -> None:
    for number, name in enumerate(names, start=1):  # one by one, so that each that cannot be had is named
        try:
            remote.fetch([name])
        except Icrl4ahtError as error:
            report.add(name, str(error))
        advance("fetched", number, len(names))


def _check_index(index: Index, tasks: list[Task], chosen: set[str], report: Report) -> None:
    """Index, tasks, totals and shard names against each other."""
    by_id = {task.task_id: task for task in tasks}
    given = bool(tasks) or index.info.kind in KINDS
    streams: set[tuple[str, int]] = set()
    for entry in index.entries:
        task = by_id.get(entry.task_id)
        said = (entry.layout, entry.track, entry.split, entry.teammate_kind, entry.teammate_family, entry.seed)
        if task is None and given:
            report.add(TASKS, f"history {entry.history_id}: its task {entry.task_id!r} is missing")
        elif task is not None and said != (
            task.layout.name,
            task.track,
            task.split,
            task.teammate_kind,
            task.teammate_family,
            task.seed,
        ):
            report.add(TASKS, f"history {entry.history_id}: index and task {entry.task_id!r} disagree")
        if (entry.task_id, entry.env_idx) in streams:
            report.add(HISTORIES, f"history {entry.history_id}: stream {entry.env_idx} of its task stands twice")
        streams.add((entry.task_id, entry.env_idx))
    for task_id in by_id.keys() - {entry.task_id for entry in index.entries}:
        report.add(TASKS, f"task {task_id!r} has no history")
    _check_apart(tasks, report)
    if not index.entries:
        report.add(HISTORIES, "no histories")
    info = index.info
    described = describe(info.kind, info.data_version, info.environment.kept_steps, list(index.entries))
    here = all(name in chosen and (index.root / name).is_file() for name in index.values("shard"))
    if report.ok and here and not report.quick:
        # else what they are made of is at fault, or away
        sizes = shard_sizes(index.root, index.entries)
        described = replace(described, shards=sizes, statistics=_statistics(index, tasks, report))
    elif info.shards.keys() != set(index.values("shard")):
        report.add(INFO, f"shards: expected {sorted(index.values('shard'))}, found {sorted(info.shards)}")
    expected = described.to_json()
    found = parse_json(read_text(resolve_inside(index.root, INFO)))  # also what `ReleaseInfo` does not have
    for name in expected:
        if found.get(name) != expected[name]:
            report.add(INFO, f"{name}: expected {expected[name]!r}, found {found.get(name)!r}")
    shards = {entry.shard for entry in index.entries}
    for shard in shards:
        stem, count = shard.removesuffix(".h5").split("-")[0], int(shard.removesuffix(".h5").split("-")[-1])
        names = (f"{stem}-{number:05}-of-{count:05}.h5" for number in range(count))
        for name in islice((name for name in names if name not in shards), _LOST):
            report.add(name, f"the name of {shard} promises this shard, the index has no history in it")


def _check_apart(tasks: list[Task], report: Report) -> None:
    """Whether no teammate of a training task is one of a test task on the same track."""
    seen: dict[tuple[str, str, str], str] = {}
    for task in sorted(tasks, key=lambda task: task.split, reverse=True):  # train before test
        who = (task.track, task.layout.name, json.dumps(task.teammate, sort_keys=True))
        if task.split == "train":
            seen[who] = task.task_id
        elif who in seen:
            report.add(TASKS, f"task {task.task_id!r} ({task.split}) has the teammate of {seen[who]!r} (train)")


def _check_sizes(origin: ReleaseLocation, index: Index, shards: list[str], report: Report) -> None:
    """Whether every shard is as long as the release says, where it is."""
    for name in shards:
        expected, found = index.info.shards.get(name), None
        remote, path = origin.remote, resolve_inside(index.root, name)
        if path.exists():
            found = path.stat().st_size
        elif remote is not None:
            try:
                found = remote.store.size(name)
            except Icrl4ahtError as error:
                report.add(name, str(error))
                continue
        if found is not None and found != expected:
            report.add(name, f"expected {expected} bytes, found {found}")


def _check_teammates(root: Path, tasks: list[Task], report: Report) -> None:
    """Whether the weights of learned teammates are those that the tasks name. A release need not have them."""
    without = 0
    for task in tasks:
        try:
            files = checkpoint_files(root / TEAMMATES, task, root)
        except Icrl4ahtError as error:
            report.add(f"{TEAMMATES}/{task.teammate['theta']['sha256']}", str(error))
            continue
        without += task.teammate_family == "rl" and not files
        for name, path in files.items():
            found = file_hash(path)
            expected = task.teammate["theta"]["sha256"]
            if path.suffix == ".safetensors" and found != expected:
                report.add(name, f"sha256 {found}, expected {expected} as task {task.task_id!r} says")
    if without:
        report.notes.append(f"{without} tasks have learned teammates whose checkpoints this release does not have")


def _statistics(index: Index, tasks: list[Task], report: Report) -> dict[str, LayoutStatistics]:
    try:
        provenance = read_provenance(resolve_inside(index.root, PROVENANCE))
        kept_steps = index.info.environment.kept_steps
        return layout_statistics(index.root, index.entries, tasks, provenance, kept_steps)
    except (Icrl4ahtError, OSError) as error:
        report.add(INFO, f"statistics cannot be computed from {PROVENANCE} and the shards: {error}")
        return {}


def _manifest(origin: ReleaseLocation, report: Report) -> dict[str, str]:
    try:
        return read_manifest(origin.folder)
    except Icrl4ahtError as error:
        report.add(MANIFEST, str(error))
        return {}


def _check_files(
    origin: ReleaseLocation, expected: dict[str, str], listed: Collection[str], report: Report, advance: NamedProgress
) -> None:
    """Whether the files that are expected are here as the manifest has them, and no others.

    Args:
        expected: file -> SHA-256.
        listed: all files of the manifest.
    """
    root = origin.folder
    present = set(files_below(root))
    if not report.quick or origin.remote is None:
        for name in sorted(expected.keys() - present):
            report.add(name, "listed in the manifest, but missing")
    for name in sorted(present - set(listed) - {MANIFEST, ORIGIN}):
        if not name.startswith(_OF_THE_HUB):
            report.add(name, "not listed in the manifest")
    both = sorted(expected.keys() & present)
    for number, name in enumerate(both, start=1):
        try:
            path = resolve_inside(root, name)
            if path.stat().st_size > LARGEST and not _is_covered(root, name):
                report.add(name, f"expected at most {LARGEST:,} bytes, found {path.stat().st_size:,}")
                continue
            found = expected[name] if report.quick else file_hash(path)
        except (Icrl4ahtError, OSError) as error:
            report.add(name, str(error))
            continue
        if found != expected[name]:
            report.add(name, f"sha256: expected {expected[name]}, found {found}")
        report.files += 1
        advance("files", number, len(both))


def _is_covered(root: Path, name: str) -> bool:
    """Whether a file is a shard of which the chunk table accounts for every byte: a hole is not worth hashing."""
    if not name.startswith("data/"):
        return False
    table = read_table(resolve_inside(root, chunk_table_name(name)))
    return int(table["size"].sum(dtype=np.int64)) == (root / name).stat().st_size


def _check_shards(index: Index, shards: list[str], report: Report, advance: NamedProgress) -> None:
    local = ReleaseLocation(index.root)  # what could not be fetched has been reported
    members = {name: [index.entries[row] for row in index.entries.shard_rows(name).tolist()] for name in shards}
    total = sum(map(len, members.values()))
    for name, entries in members.items():
        try:
            shard = Shard(local, name, index.info.kind, entries)
        except Icrl4ahtError as error:
            report.add(name, str(error))
            continue
        for fault in shard.check_between() + shard.check_structure(values=report.deep):
            report.add(name, fault)
        damaged = _check_chunks(shard, report)
        seen: dict[tuple[str, bytes], int] = {}
        for entry in entries:
            if entry.history_id not in damaged:
                try:
                    _check_history(History(entry, shard, "uint8"), index, seen, report)
                except (Icrl4ahtError, MemoryError) as error:
                    report.add(name, f"history {entry.history_id}: could not be checked: {error!r}")
            report.histories += 1
            advance("histories", report.histories, total)
