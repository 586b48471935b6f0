"""Downloads of remote releases, complete or in part."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.clients import Advance
from icrl4aht_data.fetch import ReleaseLocation, Remote, open_remote
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import PARQUET_EPISODES
from icrl4aht_data.utils.progress import counted


@dataclass(frozen=True)
class DownloadPlan:
    """Plan of a download: the files to fetch.

    Args:
        root: the remote release.
        files: name -> bytes of all files requested.
        absent: names of files not downloaded yet.
        changed: names of downloaded files that differ from the manifest.
    """

    root: Remote
    files: dict[str, int]
    absent: list[str]
    changed: list[str]

    @property
    def size(self) -> int:
        """Bytes to fetch: the sizes of absent and changed files."""
        return sum(self.files[name] for name in (*self.absent, *self.changed))

    def to_json(self) -> dict[str, Any]:
        """Return the plan as `download --dry-run --json` prints it."""
        facts = {"root": str(self.root), "folder": str(self.root.folder), "files": self.files}
        return facts | {"absent": self.absent, "changed": self.changed, "bytes": self.size}


def default_remote() -> str | None:
    """Return the address in $ICRL4AHT_REMOTE, the default of commands."""
    return os.environ.get("ICRL4AHT_REMOTE") or None


def plan_download(
    url: str,
    *,
    to: Path | None = None,
    advance: Callable[[str, int, int], None] = lambda what, done, total: None,
    **wanted: str | Iterable[str] | None,
) -> DownloadPlan:
    """Plan a download: fetch only the index, and compare existing files with the manifest.

    Args:
        url: address of the release.
        to: folder for the files, which must be absent, empty or contain this release; by default the Hub's cache, or a
            folder in `system.data_folder`.
        advance: called with the name of a stage, and the bytes compared so far and in total.
        wanted: filters as in `load_icrl4aht`: only the shards with matching histories are fetched, with their chunk
            tables and all files that belong to no shard, except the Parquet copy of the episodes.

    Raises:
        OptionError: if `url` is not an address, or `to` contains other files.
        RemoteError, OfflineError: if the index cannot be fetched.
        EmptySelectionError, UnknownNameError: if no history matches the filters, or a filter has no such value.
    """
    remote = open_remote(url, to)
    index, names = read_index(remote.folder), sorted(chosen_files(ReleaseLocation(remote.folder, remote), **wanted))
    present = {name: remote.path(name).stat().st_size for name in names if remote.path(name).exists()}
    sizes = {name: index.info.shards[name] for name in names if name in index.info.shards}
    sizes = present | sizes | remote.sizes(name for name in names if name not in sizes and name not in present)
    compared, changed = counted(advance, "compare", sum(present.values())), []
    for name, size in present.items():
        if not remote.is_here(name, by_hash=True):
            changed.append(name)
        compared(size)
    return DownloadPlan(remote, sizes, sorted(sizes.keys() - present), changed)


def fetch_planned(plan: DownloadPlan, advance: Advance | None = None) -> None:
    """Download the files of a plan, and replace changed files.

    Raises:
        RemoteError: if a file cannot be fetched; calling again resumes.
        OSError: if the disk is full or not writable.
    """
    plan.root.fetch([*plan.changed, *plan.absent], advance, again=True)


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """Return the names of a selection's files: shards, their chunk tables, and all files without a shard.

    With filters, the Parquet copy of the episodes is left out: it contains all histories.

    Args:
        root: an opened release.
        wanted: filters as in `load_icrl4aht`. Without filters, all files.
    """
    index = read_index(root.folder)
    listed = root.remote.manifest if root.remote is not None else read_manifest(root.folder)
    all_shards = index.values("shard")
    chosen = {*listed, *all_shards}
    if any(wanted.values()):
        rows = index.query(**{name: value or None for name, value in wanted.items()})  # type: ignore[arg-type]
        codes = np.unique(index.entries.column("shard")[rows]).tolist()
        others = set(all_shards) - {all_shards[code] for code in codes}
        chosen -= others | {chunk_table_name(name) for name in others}
        return {name for name in chosen if not name.startswith(f"{PARQUET_EPISODES}/")}
    return chosen
