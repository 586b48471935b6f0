"""`download` of a remote release or a part of it, and `repair` of damaged files from the address they came from."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.remote.partial_file import map_parallel
from icrl4aht_data.remote.remote_release import Advance, ReleaseLocation, folder_lock, is_address, open_root
from icrl4aht_data.remote.store import RetryPolicy, Traffic
from icrl4aht_data.utils.files import atomic_write, has_content, parse_json, read_text, write_json
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import resolve_inside

ORIGIN = ".origin.json"
"""Note in a folder that `download` filled: the address, and the files requested. No manifest lists this file."""

_PLAIN_ADDRESS = re.compile(r"(hf|s3|https?)://[^:\s]+(:\d+)?(/[^:\s]*)?")
"""Addresses that are trusted in a note; fsspec knows others, which open local files or chain several protocols."""


@dataclass(frozen=True)
class DownloadPlan:
    """Files that a download fetches.

    Args:
        root: the remote release.
        files: name -> bytes of all files requested.
        absent: names of those that are not downloaded yet.
    """

    root: ReleaseLocation
    files: dict[str, int]
    absent: list[str]

    @property
    def size(self) -> int:
        """Bytes of the absent files; of one that is partially downloaded all bytes."""
        return sum(self.files[name] for name in self.absent)

    def to_json(self) -> dict[str, Any]:
        """The plan as `download --dry-run --json` prints it."""
        return {
            "root": str(self.root),
            "folder": str(self.root.folder),
            "files": self.files,
            "absent": self.absent,
            "bytes": self.size,
        }


def default_remote() -> str | None:
    """The address in $ICRL4AHT_REMOTE, the default of commands; read at each call."""
    return os.environ.get("ICRL4AHT_REMOTE") or None


def plan_download(
    url: str, *, to: Path | None = None, retry: RetryPolicy | None = None, **wanted: str | Iterable[str] | None
) -> DownloadPlan:
    """Plan a download; fetches the index of the release only.

    Args:
        url: address of the release.
        to: folder for the files; by default the Hub's cache, or a folder in `cache.data_folder`.
        retry: policy for byte ranges.
        wanted: filters as in `load_icrl4aht`: only the shards with matching histories are fetched, with their chunk
            tables. Files that belong to no shard are always fetched.

    Raises:
        OptionError: if `url` is no address.
        RemoteError, OfflineError: if the index cannot be fetched.
        EmptySelectionError, UnknownNameError: if no history matches the filters, or a filter has no such value.
    """
    if not is_address(url):
        raise OptionError(f"{url}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...")
    root = open_root(url, to, retry)
    assert root.remote is not None
    names = sorted(chosen_files(root, **wanted))
    absent = [name for name in names if not root.is_here(name)]
    sizes = map_parallel(root.remote.size, names)
    return DownloadPlan(root, dict(zip(names, sizes, strict=True)), absent)


def fetch_planned(plan: DownloadPlan, advance: Advance = lambda size: None) -> Traffic:
    """Download the files of a plan, each checked on arrival; return the requests and bytes that it took.

    Raises:
        RemoteError: if a file cannot be fetched; a second call resumes.
        OSError: if the disk is full or not writable.
    """
    remote = plan.root.remote
    assert remote is not None
    before = remote.store.traffic
    remote.fetch(plan.absent, advance)
    if not remote.in_hub_cache:  # the client's own folder gets no note
        with folder_lock(remote.partial):
            files = {*plan.files, *_read_note(remote.folder).get("files", [])}
            with atomic_write(remote.folder / ORIGIN) as partial:
                write_json(partial, {"url": remote.url, "files": sorted(files)})
    return remote.store.traffic - before


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """Files of a release that belong to a selection: its shards, their chunk tables, and all files of no shard.

    Args:
        root: an opened release.
        wanted: filters as in `load_icrl4aht`. Without any, all files; of a folder that `download` filled those that
            the downloads requested (see `ORIGIN`).
    """
    index = read_index(root.folder)
    listed = root.remote.manifest if root.remote is not None else read_manifest(root.folder)
    all_shards = set(index.values("shard"))
    shards = _selected_shards(index, **wanted) if any(wanted.values()) else all_shards
    others = all_shards - shards
    chosen = (set(listed) | shards) - others - {chunk_table_name(name) for name in others}
    if any(wanted.values()) or root.remote is not None or not (root.folder / ORIGIN).exists():
        return chosen
    requested = set(_read_note(root.folder)["files"])
    return {name for name in chosen if name in requested or (root.folder / name).exists()}


def _read_note(folder: Path) -> dict[str, Any]:
    """Content of a folder's `ORIGIN`; empty without one."""
    path = resolve_inside(folder, ORIGIN)
    if not path.exists():
        return {}
    note = parse_json(read_text(path))
    files = note.get("files") if isinstance(note, dict) else None
    names_only = isinstance(files, list) and all(isinstance(name, str) for name in files)
    if not (names_only and isinstance(note.get("url"), str)):
        raise IndexFormatError(f"{path}: expected an object with url and files; remove it, or download again")
    return note


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
    for name in sorted(names, key=lambda name: name.startswith("data/")):  # chunk tables before their shards
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
    noted = _read_note(Path(root)).get("url") if Path(root).is_dir() else None
    if source is None and noted and not _PLAIN_ADDRESS.fullmatch(noted):
        raise OptionError(f"{Path(root) / ORIGIN}: came from {noted[:200]!r}: give --from, if you trust that address")
    url = source or noted or default_remote()
    if url is None or not is_address(url):
        raise OptionError(
            f"{root}: repairing needs the address of a complete copy, found {url!r}: give --from, or set "
            f"ICRL4AHT_REMOTE"
        )
    return url
