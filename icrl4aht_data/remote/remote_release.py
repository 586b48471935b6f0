"""Where a release is: a folder here, or an address whose files come here when they are needed.

A remote release has a folder here as well, its mirror, to which whole files come, each checked against the manifest
before it takes its name. For a repository of the Hub that is its snapshot in the Hub's own cache; for any other
address a folder below `cache.data_folder`, one a version: the manifest's hash is the revision. What has arrived of an
unfinished file lies beside the mirror.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from icrl4aht_data.errors import (
    Icrl4ahtError,
    IndexFormatError,
    OfflineError,
    OptionError,
    RemoteError,
    RootNotFoundError,
)
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import parse_manifest, read_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.remote.partial_file import PartialFile, whole_file
from icrl4aht_data.remote.store import HubStore, RetryPolicy, Store, offline
from icrl4aht_data.utils.cache import data_folder
from icrl4aht_data.utils.files import TEXT_BYTES, atomic_write, has_content, plain_size
from icrl4aht_data.utils.hashes import file_hash, git_hash
from icrl4aht_data.utils.paths import LARGEST, resolve_inside

_OPENED = (INFO, HISTORIES, TASKS, PROVENANCE)
"""What opening a release reads."""

_HUB = re.compile(r"hf://datasets/(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[^@]+))?/?")
_AT_ONCE = 8

Advance = Callable[[int], None]
"""Called with the bytes that have arrived since the last call."""


@dataclass(frozen=True)
class ReleaseLocation:
    """An opened release: its folder here, and where what is not in it comes from."""

    folder: Path
    remote: Remote | None = None

    def __str__(self) -> str:
        return str(self.folder) if self.remote is None else self.remote.url

    def file(self, name: str) -> Path:
        """The path of a whole file, fetched first if it is not here.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if it cannot be had.
        """
        path = resolve_inside(self.folder, name)
        if self.remote is not None and not path.exists():
            self.remote.fetch([name])
        return path

    def below(self, name: str) -> Path:
        """The path of a folder with all its files, fetched first if they are not here; it need not exist.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if a file cannot be had.
        """
        path = resolve_inside(self.folder, name)
        if self.remote is not None:
            self.remote.fetch(known for known in self.remote.manifest if known.startswith(f"{name}/"))
        return path

    def is_here(self, name: str) -> bool:
        """Whether a file needs no fetching."""
        return self.remote is None or (self.folder / name).exists()


def open_root(root: str | Path, to: Path | None = None, patience: RetryPolicy | None = None) -> ReleaseLocation:
    """A release folder, or a remote release with all that its index needs.

    Args:
        root: a folder or an address: hf://datasets/<org>/<repo>[@<revision>], s3://, https://, any other of fsspec.
        to: the folder for a remote's files; see the module for the default.
        patience: with the remote.

    Raises:
        RootNotFoundError: if there is no release.
        OfflineError: if there may be one, but nothing may be asked.
    """
    if isinstance(root, Path) or "://" not in root:
        return ReleaseLocation(Path(root).expanduser())
    if root.startswith("file://"):
        return ReleaseLocation(Path(root.removeprefix("file://")))
    remote = (_open_hub if root.startswith("hf://") else _open_address)(root, to, patience)
    remote.fetch([name for name in _OPENED if name in remote.manifest])
    return ReleaseLocation(remote.folder, remote)


def is_address(root: str | Path | None) -> bool:
    """Whether a root is not a folder of this machine."""
    return isinstance(root, str) and "://" in root and not root.startswith("file://")


class Remote:
    """A release at an address, pinned to one manifest.

    Args:
        url: of the release, with its revision if it has one.
        revision: what pins the content: the Hub's commit, or the first 16 digits of the manifest's hash.
        folder: its mirror.
        partial: the folder for unfinished files.
        manifest: file -> SHA-256.
        store: gives the bytes.
    """

    def __init__(
        self, url: str, revision: str, folder: Path, partial: Path, manifest: dict[str, str], store: Store
    ) -> None:
        self.url, self.revision = url, revision
        self.folder, self.partial = folder, partial
        self.manifest, self.store = manifest, store

    def fetch(self, names: Iterable[str], advance: Advance = lambda size: None) -> None:
        """Bring whole files here, several at once. Those that are here stay as they are.

        A file that is cut goes on where it was cut, at the next try or the next call.

        Raises:
            OfflineError: names every file that is missing here.
            RemoteError: if a file cannot be had, or is not what the manifest lists; the others are brought first.
        """
        wanted = list(dict.fromkeys(names))
        unlisted = [name for name in wanted if name not in self.manifest]
        if unlisted:
            raise RemoteError(f"{self.url}: its manifest does not list {', '.join(unlisted[:5])}", missing=True)
        absent = [name for name in wanted if not self.path(name).exists()]
        if absent and offline():
            raise OfflineError(f"{self.url}: offline, and not here: {', '.join(absent)}; go online to fetch them")
        with ThreadPoolExecutor(min(_AT_ONCE, max(1, len(absent)))) as pool:
            done = [pool.submit(self._fetch_one, name, advance) for name in absent]
        errors = [error for error in (one.exception() for one in done) if error is not None]
        if errors:
            raise errors[0]

    def path(self, name: str) -> Path:
        """Where a file is, or will be."""
        return resolve_inside(self.folder, name)

    def part(self, name: str) -> PartialFile:
        """A file of which parts are here."""
        if name not in self._parts:
            self._parts[name] = PartialFile(self.store, name, self.partial / name)
        return self._parts[name]

    @cached_property
    def _parts(self) -> dict[str, PartialFile]:
        return {}

    @cached_property
    def _sizes(self) -> dict[str, int]:
        return read_info(self.folder).shards

    def size(self, name: str) -> int:
        """Bytes of a file: a shard's as the release says, another's as the remote says."""
        if name.startswith("data/") and name in self._sizes:
            return self._sizes[name]
        path = self.path(name)
        return path.stat().st_size if path.exists() else self._size_there(name)

    def _size_there(self, name: str) -> int:
        size = self.store.size(name)
        if name.startswith("data/"):  # of which the chunk table has to account for every byte
            return size
        if not 0 <= size <= LARGEST:
            raise RemoteError(f"{self.url}/{name}: expected at most {LARGEST:,} bytes, the remote says {size:,}")
        return size

    def sizes(self, names: Sequence[str]) -> dict[str, int]:
        """The same of several files, asked at once."""
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            return dict(zip(names, pool.map(self.size, names), strict=True))

    def _fetch_one(self, name: str, advance: Advance) -> None:
        self.partial.mkdir(parents=True, exist_ok=True)
        target = self.path(name)
        part = self.part(name)
        part.path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(part.path.with_name(f".{part.path.name}.lock")):
            if target.exists():  # another process was quicker
                return
            whole_file(part, self.size(name), self.manifest[name], self._chunks(name), advance)
            target.parent.mkdir(parents=True, exist_ok=True)
            part.path.replace(target)

    def renew(self, name: str) -> None:
        """Make a file here the one that the manifest lists: of a shard only what is wrong is fetched, into its place.

        Raises:
            RemoteError: if what comes is not that file; then the damaged one stays.
        """
        target, chunks = self.path(name), self._chunks(name)
        if chunks is not None and target.exists():
            in_place = PartialFile(self.store, name, target)
            whole_file(in_place, self._size_there(name), self.manifest[name], chunks, lambda size: None, keep=True)
            return
        part = self.part(name)
        part.path.unlink(missing_ok=True)
        whole_file(part, self._size_there(name), self.manifest[name], chunks, lambda size: None)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as new:
            shutil.move(part.path, new)

    def _chunks(self, name: str) -> np.ndarray | None:
        """The chunk table of a shard, by which what has arrived of it is known."""
        from icrl4aht_data.format.chunks import chunk_table_name, read_table

        table = chunk_table_name(name)
        if not name.startswith("data/") or table not in self.manifest:
            return None
        self.fetch([table])
        return np.array(read_table(self.path(table)))


class HubRemote(Remote):
    """The same of a dataset repository of the Hub, whose whole files go into the Hub's cache."""

    def _fetch_one(self, name: str, advance: Advance) -> None:
        expected, found = self.manifest[name], ""
        most = 2 * self._sizes.get(name, LARGEST) if name.startswith("data/") else LARGEST  # what is cut counts twice
        for _ in range(2):
            arrived = 0

            def count(size: int) -> None:
                nonlocal arrived
                arrived += size
                advance(size)

            target = self.store.patiently(
                name, lambda count=count: _from_hub(self.url, name, self.revision, most, count)
            )
            advance(target.stat().st_size - arrived)
            found = file_hash(target)
            if found == expected:
                return
            advance(-target.stat().st_size)
            target.resolve().unlink()
            target.unlink(missing_ok=True)
        raise RemoteError(
            f"{self.url}/{name}: expected sha256 {expected}, found {found}: the repository's file is not the one that "
            f"its manifest lists; tell its publisher"
        )


def _open_hub(url: str, to: Path | None, patience: RetryPolicy | None) -> Remote:
    match = _HUB.fullmatch(url)
    if match is None:
        raise OptionError(f"{url}: expected hf://datasets/<org>/<repo> or hf://datasets/<org>/<repo>@<revision>")
    try:
        path, text = Store(url, patience).patiently(MANIFEST, lambda: _manifest_from_hub(url, match["revision"]))
    except RemoteError as error:
        if error.missing:
            raise RootNotFoundError(f"{url}: no release there, expected {MANIFEST} in it: {error.__cause__}") from error
        raise
    folder, commit = path.parent, path.parent.name
    pinned = f"hf://datasets/{match['repo']}@{commit}"
    manifest = _checked_manifest(text, pinned)
    store = HubStore(match["repo"], commit, patience)
    if to is not None:
        _write_once(to, text, manifest, pinned)
        return Remote(pinned, commit, to, _beside(to), manifest, store)
    return HubRemote(pinned, commit, folder, data_folder() / _slug(url) / f"{commit}.partial", manifest, store)


def _manifest_from_hub(url: str, revision: str | None) -> tuple[Path, bytes]:
    """The manifest's place and text, for which the Hub's cache alone vouches: a blob's name there is its hash."""
    path = _from_hub(url, MANIFEST, revision, TEXT_BYTES)
    plain_size(path, TEXT_BYTES)
    text, blob = path.read_bytes(), path.resolve()
    git = git_hash(text)
    if len(blob.name) == len(git) and blob.name != git:
        blob.unlink()
        path.unlink(missing_ok=True)
        raise ConnectionError(f"came damaged: git's hash of it is {git}, expected {blob.name}")
    return path, text


def _from_hub(url: str, name: str, revision: str | None, most: int, advance: Advance = lambda size: None) -> Path:
    """A file of a repository in the Hub's cache, which takes at most so many bytes."""
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import LocalEntryNotFoundError
    from tqdm import tqdm

    class Counting(tqdm):
        def __init__(self, *args: Any, name: str | None = None, **options: Any) -> None:
            super().__init__(*args, **options | {"disable": True})

        def update(self, n: float | None = 1) -> bool | None:
            nonlocal arrived
            arrived += int(n or 0)
            if arrived > most:
                raise RemoteError(f"{url}/{name}: expected at most {most:,} bytes, and more came")
            advance(int(n or 0))
            return super().update(n)

    arrived = 0
    match = _HUB.fullmatch(url)
    assert match is not None
    where: dict[str, Any] = {"repo_type": "dataset", "revision": revision, "local_files_only": offline()}
    try:
        return Path(hf_hub_download(match["repo"], name, tqdm_class=Counting, **where))
    except LocalEntryNotFoundError as error:
        if offline():
            raise OfflineError(f"{url}: offline, and not in the Hub's cache: {name}; go online to fetch it") from error
        raise ConnectionError(str(error)) from error


def _open_address(url: str, to: Path | None, patience: RetryPolicy | None) -> Remote:
    url = url.rstrip("/")
    store, base = Store(url, patience), data_folder() / _slug(url)
    text = _kept_manifest(url, to or base / _text(base / "latest")) if offline() else _asked_manifest(url, store)
    manifest = _checked_manifest(text, url)
    revision = hashlib.sha256(text).hexdigest()[:16]
    folder = to or base / revision
    _write_once(folder, text, manifest, url)
    if to is None and _text(base / "latest") != revision:
        with folder_lock(base), atomic_write(base / "latest") as partial:
            partial.write_text(revision, encoding="utf-8")
    return Remote(url, revision, folder, _beside(folder), manifest, store)


def _asked_manifest(url: str, store: Store) -> bytes:
    try:
        size = store.size(MANIFEST)
        if size > TEXT_BYTES:
            raise IndexFormatError(f"{url}/{MANIFEST}: expected at most {TEXT_BYTES:,} bytes, found {size:,}")
        return store.read(MANIFEST, 0, size)
    except RemoteError as error:
        if error.missing:
            raise RootNotFoundError(f"{url}: no release there, expected {MANIFEST} in it") from error
        raise


def _kept_manifest(url: str, folder: Path) -> bytes:
    try:
        plain_size(folder / MANIFEST, TEXT_BYTES)
        return (folder / MANIFEST).read_bytes()
    except (OSError, IndexFormatError) as error:
        raise OfflineError(f"{url}: offline, and nothing of this release is here; go online to fetch it") from error


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


def _checked_manifest(text: bytes, url: str) -> dict[str, str]:
    try:
        return parse_manifest(text.decode(), f"{url}/{MANIFEST}")
    except UnicodeDecodeError as error:
        raise IndexFormatError(f"{url}/{MANIFEST}: not UTF-8 text: {error}") from error


def _write_once(folder: Path, text: bytes, manifest: dict[str, str], url: str) -> None:
    """The manifest into the mirror, which holds files of this manifest alone."""
    path = folder / MANIFEST
    if has_content(path, text):
        return
    with folder_lock(_beside(folder)):
        if path.exists() and not has_content(path, text) and not _fits(folder, manifest):
            raise OptionError(f"{folder}: holds another release or version than {url} now; give another folder")
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            partial.write_bytes(text)


def folder_lock(folder: Path) -> FileLock:
    """Held while notes are written, which no two processes may do at once.

    Args:
        folder: beside them, for the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".lock")


def _fits(folder: Path, manifest: dict[str, str]) -> bool:
    """Whether all that is here is of another manifest as well: then the one here, or that one, had come damaged."""
    try:
        listed = read_manifest(folder)
    except Icrl4ahtError:
        return False
    return all(manifest.get(name) == digest for name, digest in listed.items() if (folder / name).exists())


def _beside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.partial")


def _slug(url: str) -> str:
    """A folder's name for an address, readable and its own."""
    return f"{re.sub(r'[^A-Za-z0-9.]+', '-', url)[:80]}-{hashlib.sha256(url.encode()).hexdigest()[:8]}"
