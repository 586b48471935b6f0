"""`download`: a remote release, or a part of it, comes here; and `repair`: what is damaged here comes again."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.remote.remote_release import (
    Advance,
    HubRemote,
    ReleaseLocation,
    Remote,
    folder_lock,
    is_address,
    open_root,
)
from icrl4aht_data.remote.store import RetryPolicy, Traffic
from icrl4aht_data.utils.files import atomic_write, has_content, parse_json, read_text, write_json
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import resolve_inside

ORIGIN = ".origin.json"
"""In a folder that `download` filled: where from, and which files it asked for. The one file that no manifest lists."""

_PLAIN = re.compile(r"(hf|s3|https?)://[^:\s]+(:\d+)?(/[^:\s]*)?")
"""Addresses that a note may send us to; fsspec knows others, of this machine's own files, or in chains."""


@dataclass(frozen=True)
class DownloadPlan:
    """What a download brings.

    Args:
        root: the remote release.
        files: name -> bytes, all that was asked for.
        absent: those of them that are not here.
    """

    root: ReleaseLocation
    files: dict[str, int]
    absent: list[str]

    @property
    def size(self) -> int:
        """Bytes to come, of files that have come in part the whole."""
        return sum(self.files[name] for name in self.absent)

    def to_json(self) -> dict[str, Any]:
        return {
            "root": str(self.root),
            "folder": str(self.root.folder),
            "files": self.files,
            "absent": self.absent,
            "bytes": self.size,
        }


def default_remote() -> str | None:
    """$ICRL4AHT_REMOTE: the address that is meant where none is given; read at each call."""
    return os.environ.get("ICRL4AHT_REMOTE") or None


def plan_download(
    url: str, *, to: Path | None = None, patience: RetryPolicy | None = None, **wanted: str | Iterable[str] | None
) -> DownloadPlan:
    """What `fetch_planned` would bring; only the index comes here.

    Args:
        url: of the release.
        to: the folder for it; by default the Hub's cache, or `cache.data_folder`.
        patience: with the remote.
        wanted: only the shards of histories with these values; see `load_icrl4aht`. All else of a release comes, too,
            but for the chunk tables of other shards.

    Raises:
        OptionError: if `url` is no address.
        RemoteError, OfflineError, EmptySelectionError, UnknownNameError.
    """
    if not is_address(url):
        raise OptionError(f"{url}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...")
    root = open_root(url, to, patience)
    assert root.remote is not None
    names = sorted(chosen_files(root, **wanted))
    absent = [name for name in names if not root.is_here(name)]
    return DownloadPlan(root, root.remote.sizes(names), absent)


def fetch_planned(plan: DownloadPlan, advance: Advance = lambda size: None) -> Traffic:
    """Bring the files of a plan here, each checked on arrival; what the remote was asked for.

    Raises:
        RemoteError: if a file cannot be had; the others have come, and a second call goes on.
        OSError: if the disk does not take it.
    """
    remote = plan.root.remote
    assert remote is not None
    before = remote.store.traffic
    remote.fetch(plan.absent, advance)
    if not isinstance(remote, HubRemote):  # the Hub's cache is not ours to write notes into
        with folder_lock(remote.partial):
            files = {*plan.files, *_noted(remote.folder).get("files", [])}
            with atomic_write(remote.folder / ORIGIN) as partial:
                write_json(partial, {"url": remote.url, "files": sorted(files)})
    return remote.store.traffic - before


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """The files of a release that go with a selection: its shards, their chunk tables, and all that is no shard.

    Without a selection those that a folder was filled with, see `ORIGIN`.
    """
    index = read_index(root.folder)
    listed = root.remote.manifest if root.remote is not None else read_manifest(root.folder)
    every = set(index.values("shard"))
    shards = _selected(index, **wanted) if any(wanted.values()) else every
    others = every - shards
    chosen = (set(listed) | shards) - others - {chunk_table_name(name) for name in others}
    if any(wanted.values()) or root.remote is not None or not (root.folder / ORIGIN).exists():
        return chosen
    asked = set(_noted(root.folder)["files"])
    return {name for name in chosen if name in asked or (root.folder / name).exists()}


def _noted(folder: Path) -> dict[str, Any]:
    """What `ORIGIN` says; empty if there is none."""
    path = resolve_inside(folder, ORIGIN)
    if not path.exists():
        return {}
    noted = parse_json(read_text(path))
    if not (isinstance(noted, dict) and isinstance(noted.get("url"), str) and _are_names(noted.get("files"))):
        raise IndexFormatError(f"{path}: expected an object with url and files; remove it, or download again")
    return noted


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _selected(index: Index, **wanted: Any) -> set[str]:
    rows = index.query(**{name: value or None for name, value in wanted.items()})
    names = index.values("shard")
    return {names[code] for code in np.unique(index.entries.column("shard")[rows]).tolist()}


def repair(
    root: str | Path, damaged: Iterable[str], *, source: str | None = None, patience: RetryPolicy | None = None
) -> tuple[dict[str, str | None], Traffic]:
    """Make files of a release whole again: of a shard only the ranges that are wrong are fetched.

    Args:
        root: the release, a folder or an address.
        damaged: names of files; others are left alone, unless the manifest itself is damaged.
        source: the address it came from; by default the root's own, or what `download` noted, or $ICRL4AHT_REMOTE.
        patience: with the remote.

    Returns:
        file -> None, or why it could not be repaired; and what the remote was asked for.

    Raises:
        OptionError: if no source is known, or it has another release.
        RemoteError, OfflineError: if the source cannot be asked.
    """
    there = open_root(_source(root, source), patience=patience).remote
    assert there is not None
    folder = there.folder if is_address(root) else Path(root)
    remote = Remote(there.url, there.revision, folder, there.partial, there.manifest, there.store)
    before = remote.store.traffic
    names = set(damaged) & remote.manifest.keys()
    text = (there.folder / MANIFEST).read_bytes()
    if folder != there.folder and not has_content(folder / MANIFEST, text):
        bad = [name for name in remote.manifest if not _holds(remote, name)]
        if 2 * len(bad) > len(remote.manifest):
            raise OptionError(
                f"{remote.url}: {len(bad)} of its {len(remote.manifest)} files are not those of {folder}: it has "
                f"another release or version; give the address that this one came from"
            )
        with atomic_write(folder / MANIFEST) as partial:
            partial.write_bytes(text)
        names.update(bad)
    done: dict[str, str | None] = {}
    for name in sorted(names, key=lambda name: name.startswith("data/")):  # chunk tables before their shards
        try:
            done[name] = None
            remote.renew(name)
        except (Icrl4ahtError, OSError) as error:
            done[name] = str(error)
    return done, remote.store.traffic - before


def _source(root: str | Path, source: str | None) -> str:
    if source is None and is_address(root):
        return str(root)
    noted = _noted(Path(root)).get("url") if Path(root).is_dir() else None
    if source is None and noted and not _PLAIN.fullmatch(noted):
        raise OptionError(f"{Path(root) / ORIGIN}: came from {noted[:200]!r}: give --from, if you trust that address")
    url = source or noted or default_remote()
    if url is None or not is_address(url):
        raise OptionError(
            f"{root}: repairing needs the address of a whole copy, found {url!r}: give --from, or set ICRL4AHT_REMOTE"
        )
    return url


def _holds(remote: Remote, name: str) -> bool:
    path = remote.path(name)
    return path.is_file() and file_hash(path) == remote.manifest[name]
