"""Checks of a release's files: against the manifest, the recorded sizes, and the tasks that name checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import NamedProgress, Report
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files, expert_folder
from icrl4aht_data.format.chunks import chunk_table_name, read_table
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import MANIFEST, PROVENANCE, TEAMMATES
from icrl4aht_data.remote.download import ORIGIN
from icrl4aht_data.remote.remote_release import ReleaseLocation
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import LARGEST, files_below, resolve_inside

_HUB_FILES = (".gitattributes", ".cache/huggingface/")
"""Files that the Hub and its client add to a repository's."""


def check_files(
    origin: ReleaseLocation, listed: Mapping[str, str], chosen: set[str], report: Report, advance: NamedProgress
) -> None:
    """Check that the chosen files exist with the manifest's hashes, and that no unlisted files do.

    Args:
        origin: the release.
        listed: the manifest, file -> SHA-256.
        chosen: the files to check.
        report: receives the problems.
        advance: progress.
    """
    root, quick = origin.folder, report.level == "quick"
    expected, present = listed.keys() & chosen, set(files_below(root))
    if not quick or origin.remote is None:  # files of a remote need not be downloaded for a quick check
        for name in sorted(expected - present):
            report.add(name, "listed in the manifest, but missing")
    for name in sorted(present - listed.keys() - {MANIFEST, ORIGIN}):
        if not name.startswith(_HUB_FILES):
            report.add(name, "not listed in the manifest")
    both = sorted(expected & present)
    for number, name in enumerate(both, start=1):
        try:
            path = resolve_inside(root, name)
            if path.stat().st_size > LARGEST and not _is_covered(root, name):
                report.add(name, f"expected at most {LARGEST:,} bytes, found {path.stat().st_size:,}")
                continue
            found = listed[name] if quick else file_hash(path)
        except (Icrl4ahtError, OSError) as error:
            report.add(name, str(error))
            continue
        if found != listed[name]:
            report.add(name, f"sha256: expected {listed[name]}, found {found}")
        report.files += 1
        advance("files", number, len(both))


def _is_covered(root: Path, name: str) -> bool:
    """Return whether a file is a shard whose chunk table covers every byte; other huge files, which may be sparse, are
    not worth hashing."""
    if not name.startswith("data/"):
        return False
    table = read_table(resolve_inside(root, chunk_table_name(name)))
    return int(table["size"].sum(dtype=np.int64)) == (root / name).stat().st_size


def check_shard_sizes(origin: ReleaseLocation, index: Index, shards: list[str], report: Report) -> None:
    """Check that local and remote shards have the sizes that meta/info.json records."""
    for name in shards:
        path, found = resolve_inside(index.root, name), None
        if path.exists():
            found = path.stat().st_size
        elif origin.remote is not None:
            try:
                found = origin.remote.store.size(name)
            except Icrl4ahtError as error:
                report.add(name, str(error))
                continue
        expected = index.info.shards.get(name)
        if found is not None and found != expected:
            report.add(name, f"expected {expected} bytes, found {found}")


def check_checkpoints(root: Path, tasks: list[Task], report: Report) -> None:
    """Check that the weights of learned teammates are those that the tasks name; a release may omit them."""
    without = 0
    for task in tasks:
        try:
            files = checkpoint_files(root / TEAMMATES, task, root)
        except Icrl4ahtError as error:
            report.add(f"{TEAMMATES}/{task.teammate['theta']['sha256']}", str(error))
            continue
        without += task.teammate_family == "rl" and not files
        for name, path in files.items():
            found, expected = file_hash(path), task.teammate["theta"]["sha256"]
            if path.suffix == ".safetensors" and found != expected:
                report.add(name, f"sha256 {found}, expected {expected} as task {task.task_id!r} says")
    if without:
        report.notes.append(f"{without} tasks have learned teammates whose checkpoints this release does not have")


def check_experts(index: Index, report: Report) -> None:
    """Check that the weights behind the expert actions are those that meta/provenance.json names; a release may omit
    them."""
    try:
        provenance = read_provenance(resolve_inside(index.root, PROVENANCE))
    except Icrl4ahtError:  # reported by `check_index`
        return
    for task_id, of_task in provenance.items():
        if of_task.expert is None:
            continue
        name = expert_folder(of_task.expert.policy_sha256)
        try:
            files = expert_files(resolve_inside(index.root, name), of_task.expert.policy_sha256, index.root)
        except Icrl4ahtError as error:
            report.add(name, str(error))
            continue
        for name, path in files.items():
            found, expected = file_hash(path), of_task.expert.policy_sha256
            if path.suffix == ".safetensors" and found != expected:
                report.add(name, f"sha256 {found}, expected {expected} as {PROVENANCE} says of task {task_id!r}")
