"""Checks of a release's files against the manifest, the recorded sizes, and the tasks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.report import NamedProgress, Report
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.fetch import ReleaseLocation, Remote
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.provenance import ProvenanceByTask
from icrl4aht_data.format.schema import EXPERTS, INDEX_FILES, INFO, MANIFEST, PROVENANCE, TEAMMATES
from icrl4aht_data.utils.files import LARGEST, file_hash, files_below, resolve_inside

_HUB_FILES = (".gitattributes", ".cache/huggingface/")
"""Files that the Hugging Face Hub and its client add to a repository."""


def check_files(
    origin: ReleaseLocation, listed: Mapping[str, str], chosen: set[str], report: Report, advance: NamedProgress
) -> None:
    """Check that the chosen files have the hashes in the manifest, and that the manifest lists all files.

    Sizes are compared first, because hashing a sparse file of a terabyte would take hours.

    Args:
        origin: the release.
        listed: file -> SHA-256, as in the manifest.
        chosen: the files to check.
        report: receives the problems.
        advance: called with the name of a stage, the number of files checked, and their total.
    """
    root, quick = origin.folder, report.level == "quick"
    expected, present = listed.keys() & chosen, set(files_below(root))
    # A quick check downloads nothing, so a remote release may have files that are not on this machine.
    if not quick or not isinstance(origin, Remote):
        for name in sorted(expected - present):
            report.add(name, "listed in the manifest, but missing")
    for name in sorted(present - listed.keys() - {MANIFEST}):
        if not name.startswith(_HUB_FILES):
            report.add(name, "not listed in the manifest")
    both, sizes = sorted(expected & present), _recorded_sizes(root, listed)
    for number, name in enumerate(both, start=1):
        try:
            path = resolve_inside(root, name)
            size, right = path.stat().st_size, sizes.get(name)
            if size > LARGEST if right is None else size != right:
                expected_size = f"at most {LARGEST:,}" if right is None else f"{right:,}"
                report.add(name, f"expected {expected_size} bytes, found {size:,}")
                continue
            found = listed[name] if quick and name not in INDEX_FILES else file_hash(path)
        except (Icrl4ahtError, OSError) as error:
            report.add(name, str(error))
            continue
        if found != listed[name]:
            report.add(name, f"sha256: expected {listed[name]}, found {found}")
        report.files += 1
        advance("files", number, len(both))


def _recorded_sizes(root: Path, listed: Mapping[str, str]) -> dict[str, int]:
    """Return the size in bytes of each shard, as recorded in meta/info.json.

    The result is empty if that file cannot be read or does not match the manifest.
    """
    try:
        shards = read_info(root).shards
        return shards if file_hash(root / INFO) == listed.get(INFO) else {}
    except (Icrl4ahtError, OSError):  # other checks report errors of meta/info.json
        return {}


def check_references(
    listed: Mapping[str, str], index: Index, played: Iterable[Task], provenance: ProvenanceByTask | None, report: Report
) -> None:
    """Check that each shard, chunk table and checkpoint in the manifest belongs to a history or a task.

    A checkpoint's folder is named by the SHA-256 of its weights. Checkpoints are optional.

    Args:
        listed: file -> SHA-256, as in the manifest.
        index: the release's index.
        played: the release's tasks, with a copy of the task for each further teammate that plays in it.
        provenance: task id -> record of how the task's histories were made; None if unknown.
        report: receives the problems.
    """
    shards = index.values("shard")
    known = {*shards, *map(chunk_table_name, shards)}
    learned = [(task.task_id, task.teammate["theta"]["sha256"]) for task in played if task.teammate["kind"] == "rl"]
    policies = {sha256 for _, sha256 in learned}
    labellers = {of_task.expert.policy_sha256 for of_task in (provenance or {}).values() if of_task.expert}
    for name in sorted(listed):
        top, folder, *_ = *name.split("/"), ""
        if (top == "data" or name.startswith("meta/chunks/")) and name not in known:
            report.add(name, "no history of the index is in this shard")
        elif top == TEAMMATES and folder not in policies:
            report.add(name, "no task has this teammate")
        elif top == EXPERTS and provenance is not None and folder not in labellers:
            report.add(name, f"{PROVENANCE} names no such policy")
        elif name.endswith(".safetensors") and listed[name] != folder:
            report.add(name, f"sha256 {listed[name]}, expected {folder}, the name of its folder")
    with_weights = {name.split("/")[1] for name in listed if name.startswith(f"{TEAMMATES}/")}
    without = {task_id for task_id, sha256 in learned if sha256 not in with_weights}
    if without and report.level != "quick":
        report.notes.append(f"{len(without)} tasks have learned teammates whose checkpoints this release does not have")


def check_remote_sizes(remote: Remote, index: Index, shards: list[str], report: Report) -> None:
    """Check the remote sizes of shards that are not downloaded against the sizes recorded in meta/info.json."""
    try:
        sizes = remote.sizes(name for name in shards if not remote.path(name).exists())
    except Icrl4ahtError as error:
        report.add("data", str(error))
        return
    for name, found in sizes.items():
        expected = index.info.shards.get(name, found)  # `check_index` reports shards that are not in info.json
        if found not in (None, expected):  # None if the server does not report the size
            report.add(name, f"expected {expected:,} bytes, found {found:,}")
