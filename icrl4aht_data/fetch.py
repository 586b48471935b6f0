"""Releases at an address: files are fetched complete, checked once against the manifest, and are local from then on.

A release at an address has a folder on this machine: for `hf://` its snapshot in the Hub's own cache, which other tools
share, and for any other address a folder below `system.data_folder`, one per version. A file gets its name there only
after its SHA-256 was found to be the manifest's, so that an interrupted download is resumed file by file.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from icrl4aht_data.clients import (
    THREADS,
    Advance,
    FsspecClient,
    HubClient,
    check_credentials,
    offline_switches,
    with_retries,
    without_credentials,
)
from icrl4aht_data.errors import OfflineError, OptionError, RemoteError, RootNotFoundError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import check_against_manifest, parse_manifest, read_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, LAYOUTS_FILE, MANIFEST, PARQUET_EPISODES, PROVENANCE, TASKS
from icrl4aht_data.utils import files as disk
from icrl4aht_data.utils.progress import counted, progress_bars
from icrl4aht_data.utils.system import data_folder

_INDEX_FILES = (INFO, HISTORIES, TASKS, PROVENANCE, LAYOUTS_FILE)  # read when a release is opened
_HUB = re.compile(r"hf://datasets/(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[^@]+))?/?")


def is_address(root: str | Path | None) -> bool:
    """Return whether a root is the address of a remote release, not a local folder."""
    return isinstance(root, str) and "://" in root and not root.startswith("file://")


@dataclass
class ReleaseLocation:
    """An opened release: a local one, or as `Remote` one at an address.

    Args:
        folder: its folder on this machine.
    """

    folder: Path

    def __str__(self) -> str:
        return str(self.folder)

    def path(self, name: str) -> Path:
        """Return the path of a file in the folder; it need not exist.

        Raises:
            UnsafePathError: if it leads out of the release.
        """
        return disk.resolve_inside(self.folder, name)

    def fetch(self, names: Iterable[str]) -> None:
        """Download files that are not in the folder; a local release has all of its files."""

    def file(self, name: str) -> Path:
        """Return the path of a file, fetched first if necessary; a local one of meta/ is checked against the manifest.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if it cannot be fetched.
            IndexFormatError, ChunkTableError: if it is not the one that the manifest lists.
        """
        if name.startswith("meta/"):
            check_against_manifest(self.folder, [name])
        return self.path(name)

    def below(self, name: str) -> Path:
        """Return the path of a folder, which need not exist, after its files are fetched and checked.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if a file cannot be fetched.
            IndexFormatError: if a file is not the one that the manifest lists.
        """
        path = self.path(name)
        listed = [known for known in read_manifest(self.folder) if known.startswith(f"{name}/")]
        self.fetch(listed)
        check_against_manifest(self.folder, [known for known in listed if (self.folder / known).exists()])
        return path


@dataclass
class Remote(ReleaseLocation):
    """A release at an address, pinned to one manifest.

    Args:
        folder: its folder on this machine.
        url: address of the release, with its revision if it has one, without credentials.
        revision: the Hub's commit, or the first 16 hexadecimal digits of the manifest's SHA-256.
        manifest: file -> SHA-256, hexadecimal.
        client: fetches files.
        in_hub_cache: whether `folder` belongs to the Hub's cache.
    """

    url: str
    revision: str
    manifest: dict[str, str]
    client: HubClient | FsspecClient
    in_hub_cache: bool = False

    def __str__(self) -> str:
        return self.url

    def file(self, name: str) -> Path:
        self.fetch([name])  # which checks its hash
        return self.path(name)

    def fetch(self, names: Iterable[str], advance: Advance | None = None, again: bool = False) -> None:
        """Download files that are not in the folder, several at once; stops at the first one that fails.

        Args:
            names: files of the release.
            advance: called with the number of bytes since the last call, by several threads; negative before a retry.
                By default a progress bar shows the bytes of shards.
            again: also download files that are in the folder.

        Raises:
            OfflineError: names every file that is not downloaded.
            RemoteError: if a file cannot be fetched, or is not the one that the manifest lists.
        """
        wanted = list(dict.fromkeys(names))
        unlisted = [name for name in wanted if name not in self.manifest]
        if unlisted:
            raise RemoteError(f"{self.url}: its manifest does not list {', '.join(unlisted[:5])}", missing=True)
        absent = [name for name in wanted if again or not self.is_here(name)]
        if absent and offline_switches():
            listed = ", ".join(absent)
            raise OfflineError(f"{self.url}: offline, and not downloaded, or changed since: {listed}; go online")
        if not absent:
            return
        with ExitStack() as stack:
            scratch = None
            if not self.in_hub_cache:  # whose client has locks of its own
                stack.enter_context(disk.process_lock(disk.lock_path(self.folder)))
                absent = [name for name in absent if again or not self.is_here(name)]
                for left in self.folder.glob(".partial-*"):  # by a killed process
                    shutil.rmtree(left, ignore_errors=True)
                scratch = Path(stack.enter_context(TemporaryDirectory(prefix=".partial-", dir=self.folder)))
            stack.enter_context(self.client.connect())
            if advance is None:
                size = sum(self._shard_sizes.get(name, 0) for name in absent if name.startswith("data/"))
                show = stack.enter_context(progress_bars(quiet=not size, of_bytes=True))
                advance = counted(show, "download", size)
            pool = stack.enter_context(ThreadPoolExecutor(THREADS))
            stack.callback(pool.shutdown, cancel_futures=True)
            for file in as_completed([pool.submit(self._fetch_file, name, scratch, advance) for name in absent]):
                file.result()

    def _fetch_file(self, name: str, scratch: Path | None, advance: Advance) -> None:
        """Fetch a file and move it to its path if it has the manifest's hash."""
        address, target = f"{self.url}/{name}", self.path(name)
        if scratch is None:
            _remove_from_cache(target)  # a changed file, which the client would take
        most = self._shard_sizes.get(name, 2**62) if name.startswith("data/") else disk.LARGEST
        path = _get(self.client, address, name, scratch, advance, most)
        size, found = path.stat().st_size, disk.file_hash(path)
        if found != self.manifest[name]:
            if scratch is None:
                _remove_from_cache(path)
            raise RemoteError(
                f"{address}: expected sha256 {self.manifest[name]}, found {found} in {size:,} bytes: "
                f"fetch it again; if that does not help, it is damaged there: report it to its publisher",
            )
        if scratch is not None:
            disk.sync(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)

    def is_here(self, name: str, by_hash: bool = False) -> bool:
        """Return whether a file needs no fetching: it has the manifest's hash, or as a shard the right size.

        Args:
            name: file of the release.
            by_hash: compare the hash of a shard, too, whose content is otherwise checked chunk by chunk on reading.
        """
        path, is_shard = self.path(name), name.startswith("data/")
        if not path.is_file() or (is_shard and path.stat().st_size != self._shard_sizes.get(name)):
            return False
        if is_shard and not by_hash:
            return True
        is_hashable = is_shard or path.stat().st_size <= disk.LARGEST  # a sparse file may have a terabyte
        return is_hashable and disk.file_hash(path) == self.manifest[name]

    def sizes(self, names: Iterable[str]) -> dict[str, int]:
        """Return the bytes of files as the remote says; 0 where it does not say.

        Raises:
            RemoteError: if the remote cannot be reached, or does not have a file.
        """
        names = list(names)
        if not names:
            return {}
        with self.client.connect():
            return dict(zip(names, with_retries(self.url, lambda: self.client.sizes(names)), strict=True))

    @cached_property
    def _shard_sizes(self) -> dict[str, int]:
        return read_info(self.folder).shards


def _get(
    client: HubClient | FsspecClient, address: str, name: str, scratch: Path | None, advance: Advance, most: int
) -> Path:
    """Fetch a file of at most `most` bytes, with retries; the sum of `advance` is then the size of the file."""
    arrived = 0

    def count(size: int) -> None:
        nonlocal arrived
        arrived += size
        advance(size)
        if arrived > most:
            raise RemoteError(f"{address}: expected at most {most:,} bytes, the server sent more")

    def attempt() -> Path:
        count(-arrived)  # the bytes of a failed attempt are sent again
        return client.get(name, scratch, count)

    path = with_retries(address, attempt)
    advance(path.stat().st_size - arrived)  # what the Hub's cache had under another name
    return path


def _remove_from_cache(path: Path) -> None:
    """Remove a file of the Hub's cache: the link in the snapshot and the content that it points to."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def check_root(root: Any) -> None:
    """Check that a root is a path, or a text without null characters.

    Raises:
        OptionError: if it is not.
    """
    if not isinstance(root, (str, Path)) or "\0" in str(root):
        raise OptionError(
            f"root = {root!r}: expected a release folder or an address such as hf://datasets/<org>/<repo>"
        )


def open_root(root: str | Path) -> ReleaseLocation:
    """Locate a release, a folder or an address; see `check_root` and `open_remote` for the errors."""
    check_root(root)
    if is_address(root):
        return open_remote(str(root))
    return ReleaseLocation(Path(root.removeprefix("file://") if isinstance(root, str) else root).expanduser())


def open_remote(url: str, to: Path | None = None) -> Remote:
    """Open a release at an address; fetch its manifest and index.

    Args:
        url: hf://datasets/<org>/<repo>[@<revision>], s3://, https://, or any other address of fsspec.
        to: folder for its files; see the module for the default.

    Raises:
        OptionError: if `url` is no address, or `to` has files of something else.
        RootNotFoundError: if the address has no release.
        RemoteError: if the remote cannot be reached, or serves something else than its manifest lists.
        OfflineError: if network access is switched off and the index is not downloaded.
    """
    if not is_address(url):
        found = without_credentials(url)
        raise OptionError(f"{found}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...")
    remote = (_open_hub if url.startswith("hf://") else _open_address)(url, to)
    remote.fetch([name for name in _INDEX_FILES if name in remote.manifest])
    return remote


def _open_hub(url: str, to: Path | None) -> Remote:
    match = _HUB.fullmatch(url)
    if match is None:
        found = without_credentials(url)
        raise OptionError(f"{found}: expected hf://datasets/<org>/<repo> or hf://datasets/<org>/<repo>@<revision>")
    path, text = _fetch_manifest(HubClient(match["repo"], match["revision"] or "main"), url, None)
    commit = path.parent.name
    url = f"hf://datasets/{match['repo']}@{commit}"
    if to is not None:
        _prepare_folder(to, text, url)
    client, manifest = HubClient(match["repo"], commit), _parse_manifest(text, url)
    return Remote(to or path.parent, url, commit, manifest, client, in_hub_cache=to is None)


def _open_address(address: str, to: Path | None) -> Remote:
    check_credentials(address)
    client, url = FsspecClient(address), without_credentials(address).rstrip("/")
    base = data_folder() / f"{re.sub(r'[^A-Za-z0-9.]+', '-', url)[:80]}-{disk.short_hash(url.encode(), 8)}"
    latest = base / "latest"  # the version that this address had when it was last opened
    if offline_switches():
        path = (to or base / (latest.read_text() if latest.is_file() else "none")) / MANIFEST
        if not path.is_file():
            raise OfflineError(f"{url}: offline, and no version of it is downloaded to {path.parent}; go online")
        text = path.read_bytes()
    else:
        with TemporaryDirectory() as scratch:
            _, text = _fetch_manifest(client, url, Path(scratch))
        if to is None:
            (base / disk.short_hash(text)).mkdir(parents=True, exist_ok=True)
            with disk.process_lock(disk.lock_path(latest)), disk.atomic_write(latest) as partial:
                partial.write_text(disk.short_hash(text))
    folder = to or base / disk.short_hash(text)
    _prepare_folder(folder, text, url, is_ours=to is None)
    return Remote(folder, url, disk.short_hash(text), _parse_manifest(text, url), client)


def _fetch_manifest(client: HubClient | FsspecClient, url: str, scratch: Path | None) -> tuple[Path, bytes]:
    """Return the path and the content of a release's manifest; a missing one is a missing release."""
    address = f"{url}/{MANIFEST}"
    try:
        with client.connect():
            path = _get(client, address, MANIFEST, scratch, lambda size: None, disk.TEXT_BYTES)
    except RemoteError as error:
        if error.missing and offline_switches():
            raise OfflineError(f"{url}: offline, and no version of it is downloaded; go online") from None
        if error.missing:
            raise RootNotFoundError(f"{url}: no release there, expected {MANIFEST} in it: {error}") from None
        raise
    disk.plain_size(path, disk.TEXT_BYTES)
    return path, path.read_bytes()


def _parse_manifest(text: bytes, url: str) -> dict[str, str]:
    # What is not UTF-8 becomes unprintable characters, which no line may have.
    return dict(parse_manifest(text.decode(errors="surrogateescape"), f"{url}/{MANIFEST}"))


def _prepare_folder(folder: Path, text: bytes, url: str, is_ours: bool = False) -> None:
    """Write the manifest into the folder for a release.

    Raises:
        OptionError: if the folder has files of something else, unless it is one of `system.data_folder`.
    """
    path = folder / MANIFEST

    def is_there() -> bool:
        return path.is_file() and path.stat().st_size == len(text) and path.read_bytes() == text

    if is_there():
        return
    with disk.process_lock(disk.lock_path(folder)):  # another process may be writing the manifest
        if is_there():
            return
        if path.exists() and not is_ours:
            raise OptionError(f"{folder}: holds another release or version than {url} has now; give another folder")
        if folder.exists() and any(folder.iterdir()) and not is_ours:
            raise OptionError(f"{folder}: not empty, and not a release; give a new or an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
        with disk.atomic_write(path) as partial:
            partial.write_bytes(text)


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
    index, names = read_index(remote.folder), sorted(chosen_files(remote, **wanted))
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
    all_shards = index.values("shard")
    chosen = {*read_manifest(root.folder), *all_shards}
    if any(wanted.values()):
        rows = index.query(**{name: value or None for name, value in wanted.items()})  # type: ignore[arg-type]
        codes = np.unique(index.entries.column("shard")[rows]).tolist()
        others = set(all_shards) - {all_shards[code] for code in codes}
        chosen -= others | {chunk_table_name(name) for name in others}
        return {name for name in chosen if not name.startswith(f"{PARQUET_EPISODES}/")}
    return chosen
