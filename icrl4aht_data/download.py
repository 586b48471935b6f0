"""Downloads of remote releases, complete or in part, and repair of damaged files from their address."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrl4aht_data.clients import Advance, without_credentials
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.fetch import ReleaseLocation, Remote, is_address, open_remote, short_hash
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST, PARQUET_EPISODES
from icrl4aht_data.utils.files import atomic_write, has_content, json_hash
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.system import data_folder


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
    unknown = [name for name in names if name not in sizes and name not in present]
    sizes = present | sizes | remote.sizes(unknown)
    total, done, changed = sum(sizes[name] for name in present), 0, []
    for name in present:
        if not remote.is_here(name, by_hash=True):
            changed.append(name)
        done += sizes[name]
        advance("compare", done, total)
    return DownloadPlan(remote, sizes, sorted(sizes.keys() - present), changed)


def fetch_planned(plan: DownloadPlan, advance: Advance | None = None) -> int:
    """Download the files of a plan, replace changed files, and return the number of bytes fetched.

    Raises:
        RemoteError: if a file cannot be fetched; calling again resumes.
        OSError: if the disk is full or not writable.
    """
    remote, before = plan.root, plan.root.fetched
    if not remote.in_hub_cache:
        _write_note(remote, plan.files)
    remote.fetch([*plan.changed, *plan.absent], advance, again=True)
    return remote.fetched - before


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """Return the names of a selection's files: shards, their chunk tables, and all files without a shard.

    With filters, the Parquet copy of the episodes is left out: it contains all histories.

    Args:
        root: an opened release.
        wanted: filters as in `load_icrl4aht`. Without filters, all files, or for a folder filled by `download` the
            requested files, see `DownloadNote`.
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
    note = None if root.remote is not None else read_note(root.folder)
    if note is None or note.release != json_hash(listed):
        return chosen
    return {name for name in chosen if name in note.files or (root.folder / name).exists()}


class DownloadNote(msgspec.Struct):
    """Record of a download into a folder. It is in the data folder, since a release could contain a forged one.

    Args:
        url: address of the release, without credentials.
        release: hash of the manifest's content.
        files: names of all files requested so far.
    """

    url: str
    release: str
    files: list[str]


def read_note(folder: Path) -> DownloadNote | None:
    """Return the note of a folder; None if there is none or it cannot be read."""
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(_note_path(folder).read_bytes(), type=DownloadNote)
    return None


def _write_note(remote: Remote, files: Iterable[str]) -> None:
    """Write the note of a download; skipped if the data folder is not writable."""
    before, release = read_note(remote.folder), json_hash(remote.manifest)
    requested = {*files, *(before.files if before is not None and before.release == release else ())}
    path = _note_path(remote.folder)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            partial.write_bytes(msgspec.json.encode(DownloadNote(remote.url, release, sorted(requested))))


def _note_path(folder: Path) -> Path:
    return data_folder() / "downloads" / f"{short_hash(os.fsencode(folder.resolve()), 32)}.json"


def repair(root: str | Path, damaged: Iterable[str], *, source: str | None = None) -> tuple[dict[str, str | None], int]:
    """Fetch damaged files of a release again.

    Args:
        root: the release, a folder or an address.
        damaged: names of files; other files are replaced only if the manifest itself is damaged.
        source: address to repair from; by default the root if it is an address, the noted address, or
            $ICRL4AHT_REMOTE.

    Returns:
        name -> None or the reason why the file could not be repaired; and the number of bytes fetched.

    Raises:
        OptionError: if no source is known, or the source has another release.
        RemoteError, OfflineError: if the source cannot be reached.
    """
    remote = open_remote(_repair_source(root, source))
    names = set(damaged) & remote.manifest.keys()
    if not is_address(root):
        manifest = (remote.folder / MANIFEST).read_bytes()
        remote = replace(remote, folder=Path(root), in_hub_cache=False)
        if not has_content(remote.folder / MANIFEST, manifest):
            names |= _replace_manifest(remote, manifest)
    before, outcome = remote.fetched, dict.fromkeys(sorted(names, key=lambda name: name.startswith("data/")))
    for name in outcome:  # shards last: their sizes are in meta/info.json, which may need repair
        try:
            remote.fetch([name], again=True)
        except (Icrl4ahtError, OSError) as error:
            outcome[name] = str(error)
    return outcome, remote.fetched - before


def _replace_manifest(remote: Remote, manifest: bytes) -> set[str]:
    """Replace a folder's damaged manifest; return the names of files that differ from the new one.

    Raises:
        OptionError: if most files differ, which means that the remote has another release.
    """
    listed = {remote.folder / name: (name, digest) for name, digest in remote.manifest.items()}
    wrong = {name for path, (name, digest) in listed.items() if not path.is_file() or file_hash(path) != digest}
    if 2 * len(wrong) > len(listed):
        raise OptionError(
            f"{remote.url}: {len(wrong)} of its {len(listed)} files are not those of {remote.folder}: it has another "
            f"release or version; give the address that this one came from"
        )
    with atomic_write(remote.folder / MANIFEST) as partial:
        partial.write_bytes(manifest)
    return wrong


def _repair_source(root: str | Path, source: str | None) -> str:
    """Return the address to repair from: the argument, the release's address, the noted one, or the default."""
    if source is None and is_address(root):
        return str(root)
    note, default = read_note(Path(root)), default_remote()
    noted = None if note is None else note.url
    if default is not None and noted == without_credentials(default).rstrip("/"):
        noted = default  # unlike the note, this address contains credentials
    url = source or noted or default
    if url is None or not is_address(url):
        found = url and without_credentials(url)
        raise OptionError(
            f"{root}: repairing needs the address of a complete copy, found {found!r}: give --from, or set "
            f"ICRL4AHT_REMOTE"
        )
    return url
