"""Remote releases: each file is downloaded completely, checked once against the manifest, and kept on this machine.

The files of a remote release are stored in a local folder. For `hf://`, this is the snapshot in the Hub's cache, which
other tools share; for any other address, a folder in `system.data_folder`, one per version. A file is accepted only if
its SHA-256 is the one in the manifest, so an interrupted download is resumed file by file.

In the Hub's cache, the Hub's client gives a file its final name before this check. If the process is killed in between,
wrong bytes of the right size stay, but are not used: the hashes of all files except shards are compared again, the
chunks of shards are checked whenever they are read, and `icrl4aht-data download` replaces changed files.
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
from icrl4aht_data.format.manifest import check_against_manifest, read_manifest
from icrl4aht_data.format.schema import INDEX_FILES, MANIFEST, PARQUET_EPISODES
from icrl4aht_data.utils import files as disk
from icrl4aht_data.utils.progress import bar_updater, progress_bars
from icrl4aht_data.utils.system import data_folder

_HUB = re.compile(r"hf://datasets/(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[^@]+))?/?")


def is_address(root: str | Path | None) -> bool:
    """Return whether `root` is the address of a remote release, not a local folder."""
    return isinstance(root, str) and "://" in root and not root.startswith("file://")


@dataclass
class ReleaseLocation:
    """Location of an opened release: a local folder, or, in the subclass `Remote`, an address.

    Args:
        folder: the release's folder on this machine.
    """

    folder: Path

    def __str__(self) -> str:
        return str(self.folder)

    def path(self, name: str) -> Path:
        """Return the path of a file of the release; the file need not exist.

        Raises:
            UnsafePathError: if the path points outside the release.
        """
        return disk.resolve_inside(self.folder, name)

    def fetch(self, names: Iterable[str]) -> None:
        """Download missing files of a remote release; do nothing for a local folder."""

    def file(self, name: str) -> Path:
        """Return the path of a file, downloaded if necessary; local files in meta/ are checked against the manifest.

        Raises:
            UnsafePathError: if the path points outside the release.
            RemoteError, OfflineError: if the file cannot be downloaded.
            IndexFormatError, ChunkTableError: if the file does not match the manifest.
        """
        if name.startswith("meta/"):
            check_against_manifest(self.folder, [name])
        return self.path(name)

    def fetch_folder(self, name: str) -> Path:
        """Download and check the files of a folder, which need not exist, and return the path of the folder.

        Raises:
            UnsafePathError: if the path points outside the release.
            RemoteError, OfflineError: if a file cannot be downloaded.
            IndexFormatError: if a file does not match the manifest.
        """
        path = self.path(name)
        listed = [known for known in read_manifest(self.folder) if known.startswith(f"{name}/")]
        self.fetch(listed)
        check_against_manifest(self.folder, [known for known in listed if (self.folder / known).exists()])
        return path


@dataclass
class Remote(ReleaseLocation):
    """A release at a remote address, pinned to one manifest.

    Args:
        folder: the release's folder on this machine.
        url: address of the release, with its revision if it has one, without credentials.
        revision: the Hub's commit, or the first 16 hexadecimal digits of the manifest's SHA-256.
        client: client that downloads files.
        in_hub_cache: whether `folder` belongs to the Hub's cache.
    """

    url: str
    revision: str
    client: HubClient | FsspecClient
    in_hub_cache: bool = False

    def __str__(self) -> str:
        return self.url

    def file(self, name: str) -> Path:
        self.fetch([name])  # `fetch` also checks the hash
        return self.path(name)

    def fetch(self, names: Iterable[str], advance: Advance | None = None, again: bool = False) -> None:
        """Download missing files, several in parallel; stop at the first failure.

        Args:
            names: files of the release.
            advance: called by several threads with the number of bytes received since the last call; negative before a
                retry. By default a progress bar shows the bytes of shards.
            again: also download files that are already present.

        Raises:
            OfflineError: if network access is switched off; the message names every missing file.
            RemoteError: if a file cannot be downloaded, or does not match the manifest.
        """
        wanted = list(dict.fromkeys(names))
        unlisted = [name for name in wanted if name not in self.manifest]
        if unlisted:
            raise RemoteError(f"{self.url}: the manifest does not list {', '.join(unlisted[:5])}", missing=True)
        absent = [name for name in wanted if again or not self.is_downloaded(name)]
        if absent and offline_switches():
            listed = ", ".join(absent)
            raise OfflineError(
                f"{self.url}: offline, but these files are missing or have changed: {listed}; {_offline_advice()}"
            )
        if not absent:
            return
        with ExitStack() as stack:
            scratch = None
            if not self.in_hub_cache:  # the Hub's client locks its own cache
                stack.enter_context(disk.process_lock(disk.lock_file_path(self.folder)))
                absent = [name for name in absent if again or not self.is_downloaded(name)]
                for left in self.folder.glob(".partial-*"):  # left by a killed download
                    shutil.rmtree(left, ignore_errors=True)
                scratch = Path(stack.enter_context(TemporaryDirectory(prefix=".partial-", dir=self.folder)))
            stack.enter_context(self.client.connect())
            if advance is None:
                size = sum(self._shard_sizes.get(name, 0) for name in absent if name.startswith("data/"))
                show = stack.enter_context(progress_bars(quiet=not size, of_bytes=True))
                advance = bar_updater(show, "download", size)
            pool = stack.enter_context(ThreadPoolExecutor(THREADS))
            stack.callback(pool.shutdown, cancel_futures=True)
            for file in as_completed([pool.submit(self._fetch_file, name, scratch, advance) for name in absent]):
                file.result()

    def _fetch_file(self, name: str, scratch: Path | None, advance: Advance) -> None:
        """Download a file, and move it to its final path if its hash is the one in the manifest."""
        address, target = f"{self.url}/{name}", self.path(name)
        if scratch is None:
            _remove_from_cache(target)  # otherwise the client would keep the cached file
        if name.startswith("data/"):
            most = self._shard_sizes.get(name, 2**62)
        else:
            most = disk.TEXT_BYTES if name.endswith(".json") else disk.LARGEST
        path = _fetch_with_retries(self.client, address, name, scratch, advance, most)
        size, found = path.stat().st_size, disk.file_hash(path)
        if found != self.manifest[name]:
            if scratch is None:
                _remove_from_cache(path)
            raise RemoteError(
                f"{address}: expected sha256 {self.manifest[name]}, found {found} in {size:,} bytes: "
                f"download it again; if that does not help, the remote file is damaged: report it to the publisher",
            )
        if scratch is not None:
            disk.sync(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)

    def is_downloaded(self, name: str, by_hash: bool = False) -> bool:
        """Return whether a file is present and has the hash in the manifest; shards are compared only by size.

        Args:
            name: file of the release.
            by_hash: also compare the hashes of shards, which are otherwise checked chunk by chunk when they are read.
        """
        path, is_shard = self.path(name), name.startswith("data/")
        if not path.is_file() or (is_shard and path.stat().st_size != self._shard_sizes.get(name)):
            return False
        if is_shard and not by_hash:
            return True
        is_hashable = is_shard or path.stat().st_size <= disk.LARGEST  # a sparse file may be huge
        return is_hashable and disk.file_hash(path) == self.manifest[name]

    def sizes(self, names: Iterable[str]) -> dict[str, int | None]:
        """Return the size in bytes of each file, as reported by the remote; None for an unreported size.

        Raises:
            RemoteError: if the remote cannot be reached, or does not have a file.
        """
        names = list(names)
        if not names:
            return {}
        with self.client.connect():
            return dict(zip(names, with_retries(self.url, lambda: self.client.sizes(names)), strict=True))

    @cached_property
    def manifest(self) -> dict[str, str]:
        """Hexadecimal SHA-256 of each file, by path in the release."""
        return dict(read_manifest(self.folder))  # unlike a MappingProxyType, a dict can be pickled

    @cached_property
    def _shard_sizes(self) -> dict[str, int]:
        return read_info(self.folder).shards


def _offline_advice() -> str:
    """Return advice for an error in offline mode: the environment variables to unset."""
    return f"unset {' and '.join(offline_switches())} to download"


def _fetch_with_retries(
    client: HubClient | FsspecClient, address: str, name: str, scratch: Path | None, advance: Advance, most: int
) -> Path:
    """Download a file of at most `most` bytes, with retries; `advance` receives counts that add up to its size."""
    arrived = 0

    def count(size: int) -> None:
        nonlocal arrived
        arrived += size
        advance(size)
        if arrived > most:
            raise RemoteError(f"{address}: expected at most {most:,} bytes, but the server sent more")

    def attempt() -> Path:
        count(-arrived)  # a new attempt starts again at the first byte
        return client.get(name, scratch, count)

    path = with_retries(address, attempt)
    advance(path.stat().st_size - arrived)  # the Hub's cache may already have the bytes
    return path


def _remove_from_cache(path: Path) -> None:
    """Remove a file from the Hub's cache: the link in the snapshot and the content that the link points to."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def check_root(root: Any) -> None:
    """Check that `root` is a path or a string, without null characters.

    Raises:
        OptionError: for any other value.
    """
    if not isinstance(root, (str, Path)) or "\0" in str(root):
        raise OptionError(
            f"root = {root!r}: expected a release folder or an address such as hf://datasets/<org>/<repo>"
        )


def open_root(root: str | Path) -> ReleaseLocation:
    """Open a release given by a folder or an address; see `check_root` and `open_remote` for the errors."""
    check_root(root)
    if is_address(root):
        return open_remote(str(root))
    return ReleaseLocation(Path(root.removeprefix("file://") if isinstance(root, str) else root).expanduser())


def open_remote(url: str, to: Path | None = None) -> Remote:
    """Open a release at an address, and download the manifest and the index.

    Args:
        url: hf://datasets/<org>/<repo>[@<revision>], s3://, https://, or any other address of fsspec.
        to: folder for the release's files; by default the Hub's cache, or a folder in `system.data_folder`.

    Raises:
        OptionError: if `url` is not an address, or `to` contains other files.
        RootNotFoundError: if there is no release at the address.
        RemoteError: if the remote cannot be reached, or a file does not match the manifest.
        OfflineError: if network access is switched off and the index is not downloaded.
    """
    if not is_address(url):
        found = without_credentials(url)
        raise OptionError(f"{found}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...")
    remote = (_open_hub if url.startswith("hf://") else _open_address)(url, to)
    remote.fetch([name for name in INDEX_FILES if name in remote.manifest])
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
    return Remote(to or path.parent, url, commit, HubClient(match["repo"], commit), in_hub_cache=to is None)


def _open_address(address: str, to: Path | None) -> Remote:
    check_credentials(address)
    client, url = FsspecClient(address), without_credentials(address).rstrip("/")
    base = data_folder() / f"{re.sub(r'[^A-Za-z0-9.]+', '-', url)[:80]}-{disk.short_hash(url.encode(), 8)}"
    latest = base / "latest"  # file with the folder name of the version opened last
    if offline_switches():
        path = (to or base / (latest.read_text() if latest.is_file() else "none")) / MANIFEST
        if not path.is_file():
            raise OfflineError(
                f"{url}: offline, and this release is not downloaded to {path.parent}; {_offline_advice()}"
            )
        text = path.read_bytes()
    else:
        with TemporaryDirectory() as scratch:
            _, text = _fetch_manifest(client, url, Path(scratch))
        if to is None:
            (base / disk.short_hash(text)).mkdir(parents=True, exist_ok=True)
            with disk.process_lock(disk.lock_file_path(latest)):
                disk.write_atomically(latest, disk.short_hash(text))
    folder = to or base / disk.short_hash(text)
    _prepare_folder(folder, text, url, is_ours=to is None)
    return Remote(folder, url, disk.short_hash(text), client)


def _fetch_manifest(client: HubClient | FsspecClient, url: str, scratch: Path | None) -> tuple[Path, bytes]:
    """Download a release's manifest, and return the manifest's path and content; a missing manifest is an error."""
    address = f"{url}/{MANIFEST}"
    try:
        with client.connect():
            path = _fetch_with_retries(client, address, MANIFEST, scratch, lambda size: None, disk.TEXT_BYTES)
    except RemoteError as error:
        if error.missing and offline_switches():
            raise OfflineError(f"{url}: offline, and this release is not downloaded; {_offline_advice()}") from None
        if error.missing:
            raise RootNotFoundError(f"{url}: no release at this address, expected {MANIFEST}: {error}") from None
        raise
    disk.check_file_size(path, disk.TEXT_BYTES)
    return path, path.read_bytes()


def _prepare_folder(folder: Path, text: bytes, url: str, is_ours: bool = False) -> None:
    """Create the folder for a release's files, and write the manifest into it.

    Raises:
        OptionError: if the folder contains other files and is not in `system.data_folder` (`is_ours` is False).
    """
    path = folder / MANIFEST

    def has_same_manifest() -> bool:
        return path.is_file() and path.stat().st_size == len(text) and path.read_bytes() == text

    if has_same_manifest():
        return
    with disk.process_lock(disk.lock_file_path(folder)):  # another process may be writing the manifest
        if has_same_manifest():
            return
        if folder.exists() and any(folder.iterdir()) and not is_ours:
            raise OptionError(f"{folder}: not empty, and not this version of {url}; give a new or an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
        disk.write_atomically(path, text)


@dataclass(frozen=True)
class DownloadPlan:
    """Plan of a download: the requested files of a release, and the names of absent and of changed files.

    Args:
        root: the remote release.
        files: name -> size in bytes, for all requested files.
        absent: names of files not downloaded yet.
        changed: names of downloaded files that differ from the manifest.
    """

    root: Remote
    files: dict[str, int]
    absent: list[str]
    changed: list[str]

    @property
    def size(self) -> int:
        """Number of bytes to download: the sum of the sizes of absent and changed files."""
        return sum(self.files[name] for name in (*self.absent, *self.changed))

    def to_json(self) -> dict[str, Any]:
        """Return the plan as a JSON object, which `download --dry-run --json` prints."""
        facts = {"root": str(self.root), "folder": str(self.root.folder), "files": self.files}
        return facts | {"absent": self.absent, "changed": self.changed, "bytes": self.size}


def plan_download(
    url: str,
    *,
    to: Path | None = None,
    advance: Callable[[str, int, int], None] = lambda what, done, total: None,
    **wanted: str | Iterable[str] | None,
) -> DownloadPlan:
    """Plan a download: compare existing files with the manifest, and download only the index.

    Args:
        url: address of the release.
        to: a new or empty folder for the files, or a folder with this release; by default the Hub's cache, or a folder
            in `system.data_folder`.
        advance: called with the name of a stage, and the bytes compared so far and in total.
        wanted: filters as in `load_icrl4aht`: the plan has the shards with matching histories, their chunk tables, and
            all files that belong to no shard, except the Parquet copy of the episodes.

    Raises:
        OptionError: if `url` is not an address, or `to` contains other files.
        RemoteError, OfflineError: if the index cannot be downloaded.
        EmptySelectionError, UnknownNameError: if no history matches the filters, or a filter's value does not exist.
    """
    remote = open_remote(url, to)
    index, names = read_index(remote.folder), sorted(chosen_files(remote, **wanted))
    present = {name: remote.path(name).stat().st_size for name in names if remote.path(name).exists()}
    sizes = {name: index.info.shards[name] for name in names if name in index.info.shards}
    others = remote.sizes(name for name in names if name not in sizes and name not in present)
    sizes = present | sizes | {name: size or 0 for name, size in others.items()}
    compared, changed = bar_updater(advance, "compare", sum(present.values())), []
    for name, size in present.items():
        if not remote.is_downloaded(name, by_hash=True):
            changed.append(name)
        compared(size)
    return DownloadPlan(remote, sizes, sorted(sizes.keys() - present), changed)


def fetch_planned(plan: DownloadPlan, advance: Advance | None = None) -> None:
    """Download the files of a plan, and replace changed files.

    Raises:
        RemoteError: if a file cannot be downloaded; another call resumes the download.
        OSError: if the disk is full or not writable.
    """
    plan.root.fetch([*plan.changed, *plan.absent], advance, again=True)


def chosen_files(root: ReleaseLocation, **wanted: str | Iterable[str] | None) -> set[str]:
    """Return the files that a selection needs: shards, chunk tables, and all files that belong to no shard.

    With filters, the Parquet copy of the episodes is left out, since it contains all histories.

    Args:
        root: an opened release.
        wanted: filters as in `load_icrl4aht`; without filters, all files are returned.
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
