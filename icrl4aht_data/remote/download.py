"""`download` of a remote release or a part of it, and `repair` of damaged files from the address they came from."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST, PARQUET_EPISODES
from icrl4aht_data.remote.addresses import without_credentials
from icrl4aht_data.remote.download_note import read_note, write_note
from icrl4aht_data.remote.partial_file import map_parallel
from icrl4aht_data.remote.remote_release import Advance, ReleaseLocation, is_address, open_root
from icrl4aht_data.remote.store import RetryPolicy, Traffic
from icrl4aht_data.utils.files import atomic_write, has_content
from icrl4aht_data.utils.hashes import file_hash


@dataclass(frozen=True)
class DownloadPlan:
    """Files that a download fetches.

    Args:
        root: the remote release.
        files: name -> bytes of all files requested.
        absent: names of those that are not downloaded yet.
        changed: names of those that were downloaded and are not what the manifest lists any more.
    """

    root: ReleaseLocation
    files: dict[str, int]
    absent: list[str]
    changed: list[str]

    @property
    def size(self) -> int:
        """Bytes of the absent and the changed files; of one that is partially downloaded all bytes."""
        return sum(self.files[name] for name in (*self.absent, *self.changed))

    @property
    def replaced(self) -> list[str]:
        """Names of the changed files that were fetched again so far; those of the index are by planning."""
        return [] if self.root.remote is None else self.root.remote.replaced

    def to_json(self) -> dict[str, Any]:
        """The plan as `download --dry-run --json` prints it."""
        return {
            "root": str(self.root),
            "folder": str(self.root.folder),
            "files": self.files,
            "absent": self.absent,
            "changed": self.changed,
            "bytes": self.size,
        }


def default_remote() -> str | None:
    """The address in $ICRL4AHT_REMOTE, the default of commands; read at each call."""
    return os.environ.get("ICRL4AHT_REMOTE") or None


def plan_download(
    url: str,
    *,
    to: Path | None = None,
    retry: RetryPolicy | None = None,
    advance: Callable[[str, int, int], None] = lambda what, done, total: None,
    **wanted: str | Iterable[str] | None,
) -> DownloadPlan:
    """Plan a download; fetches the index of the release only, and compares the files that are here with the manifest.

    Args:
        url: address of the release.
        to: folder for the files, which must not exist, be empty, or have files of this release; by default the Hub's
            cache, or a folder in `cache.data_folder`.
        retry: policy for byte ranges.
        advance: called with the name of a stage, and the bytes compared so far and in total.
        wanted: filters as in `load_icrl4aht`: only the shards with matching histories are fetched, with their chunk
            tables and all files that belong to no shard, except the Parquet copy of the episodes.

    Raises:
        OptionError: if `url` is no address, or `to` has files of something else, or changed files of a release that
            was not downloaded by this user.
        RemoteError, OfflineError: if the index cannot be fetched.
        EmptySelectionError, UnknownNameError: if no history matches the filters, or a filter has no such value.
    """
    if not is_address(url):
        found = without_credentials(url)
        raise OptionError(f"{found}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...")
    root = open_root(url, to, retry)
    remote = root.remote
    assert remote is not None
    names = sorted(chosen_files(root, **wanted))
    sizes = dict(zip(names, map_parallel(remote.size, names), strict=True))
    present = [name for name in names if remote.path(name).exists()]
    total, done, changed = sum(sizes[name] for name in present), 0, []
    for name in present:
        if not remote.is_unchanged(name):
            changed.append(name)
        done += sizes[name]
        advance("compare", done, total)
    remote.check_replaceable(changed)
    return DownloadPlan(root, sizes, sorted(sizes.keys() - present), changed)


def fetch_planned(plan: DownloadPlan, advance: Advance = lambda size: None) -> Traffic:
    """Download the files of a plan, each checked on arrival; return the requests and bytes that it took.

    Changed files are replaced; of a changed shard only the damaged parts are fetched.

    Raises:
        RemoteError: if a file cannot be fetched; a second call resumes.
        OSError: if the disk is full or not writable.
    """
    remote = plan.root.remote
    assert remote is not None
    before = remote.store.traffic
    if not remote.in_hub_cache:  # the client's own folder
        write_note(remote.folder, remote.url, remote.manifest, plan.files)
    for name in sorted(plan.changed, key=_tables_first):
        remote.repair_file(name, advance)
    remote.replaced.extend(plan.changed)
    remote.fetch(plan.absent, advance)
    return remote.store.traffic - before


def _tables_first(name: str) -> bool:
    """Sorting key: a shard is repaired by its chunk table, which has to be right by then."""
    return name.startswith("data/")


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """Files of a release that belong to a selection: its shards, their chunk tables, and all files of no shard.

    With filters, the Parquet copy of the episodes is left out: it repeats the shards, of all histories.

    Args:
        root: an opened release.
        wanted: filters as in `load_icrl4aht`. Without any, all files; of a folder that `download` filled those that
            the downloads requested, see `DownloadNote`.
    """
    index = read_index(root.folder)
    listed = root.remote.manifest if root.remote is not None else read_manifest(root.folder)
    all_shards = set(index.values("shard"))
    chosen = set(listed) | all_shards
    if any(wanted.values()):
        others = all_shards - _selected_shards(index, **wanted)
        chosen -= others | {chunk_table_name(name) for name in others}
        return {name for name in chosen if not name.startswith(f"{PARQUET_EPISODES}/")}
    note = None if root.remote is not None else read_note(root.folder)
    if note is None or not note.belongs_to(listed):
        return chosen
    return {name for name in chosen if name in note.files or (root.folder / name).exists()}


def _selected_shards(index: Index, **wanted: Any) -> set[str]:
    rows = index.query(**{name: value or None for name, value in wanted.items()})
    names = index.values("shard")
    return {names[code] for code in np.unique(index.entries.column("shard")[rows]).tolist()}


def repair(
    root: str | Path, damaged: Iterable[str], *, source: str | None = None, retry: RetryPolicy | None = None
) -> tuple[dict[str, str | None], Traffic]:
    """Replace damaged files of a release; of a shard only the damaged ranges are fetched.

    Args:
        root: the release, a folder or an address.
        damaged: names of files; other files are not touched, unless the manifest itself is damaged.
        source: address to repair from; by default the root itself, the address that `download` noted, or
            $ICRL4AHT_REMOTE.
        retry: policy for byte ranges.

    Returns:
        name -> None, or why the file could not be repaired; and the requests and bytes that it took.

    Raises:
        OptionError: if no source is known, or it has another release.
        RemoteError, OfflineError: if the source cannot be reached.
    """
    pristine = open_root(_repair_source(root, source), retry=retry).remote
    assert pristine is not None
    folder = pristine.folder if is_address(root) else Path(root)
    remote = replace(pristine, folder=folder)
    before = remote.store.traffic
    names = set(damaged) & remote.manifest.keys()
    manifest = (pristine.folder / MANIFEST).read_bytes()
    if folder != pristine.folder and not has_content(folder / MANIFEST, manifest):
        paths = {name: remote.path(name) for name in remote.manifest}
        wrong = [n for n, path in paths.items() if not path.is_file() or file_hash(path) != remote.manifest[n]]
        if 2 * len(wrong) > len(remote.manifest):
            raise OptionError(
                f"{remote.url}: {len(wrong)} of its {len(remote.manifest)} files are not those of {folder}: it has "
                f"another release or version; give the address that this one came from"
            )
        with atomic_write(folder / MANIFEST) as partial:
            partial.write_bytes(manifest)
        names.update(wrong)
    outcome: dict[str, str | None] = {}
    for name in sorted(names, key=_tables_first):
        try:
            outcome[name] = None
            remote.repair_file(name)
        except (Icrl4ahtError, OSError) as error:
            outcome[name] = str(error)
    return outcome, remote.store.traffic - before


def _repair_source(root: str | Path, source: str | None) -> str:
    """The address to repair a release from: the given one, the release's own, the noted one, or the default."""
    if source is None and is_address(root):
        return str(root)
    note, default = read_note(Path(root)), default_remote()
    noted = None if note is None else note.url
    if default is not None and noted == without_credentials(default).rstrip("/"):
        noted = default  # the address with its credentials
    url = source or noted or default
    if url is None or not is_address(url):
        found = url and without_credentials(url)
        raise OptionError(
            f"{root}: repairing needs the address of a complete copy, found {found!r}: give --from, or set "
            f"ICRL4AHT_REMOTE"
        )
    return url
