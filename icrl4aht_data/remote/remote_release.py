"""Location of a release: a local folder, or an address whose files are downloaded when they are needed.

A remote release has a local folder as well, its mirror, which receives complete files only, each checked against the
manifest before it gets its name, and again before it is used: a file that has changed since is fetched again. The
mirror of a Hub repository is its snapshot in the Hub's own cache; that of any other address is a folder below
`cache.data_folder`, one per version, named by the manifest's hash. Unfinished files are kept in a folder next to the
mirror, which is removed when it is empty.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icrl4aht_data.errors import (
    Icrl4ahtError,
    IndexFormatError,
    OfflineError,
    OptionError,
    RemoteError,
    RootNotFoundError,
)
from icrl4aht_data.format.chunks import chunk_table_name, read_table
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import (
    check_against_manifest,
    check_folder,
    check_only_files_of,
    parse_manifest,
    read_manifest,
)
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.remote.addresses import without_credentials
from icrl4aht_data.remote.download_note import read_note
from icrl4aht_data.remote.hub import HubStore
from icrl4aht_data.remote.partial_file import PartialFile, complete_file, map_parallel
from icrl4aht_data.remote.store import RetryPolicy, Store, offline
from icrl4aht_data.utils.files import (
    LARGEST,
    TEXT_BYTES,
    atomic_write,
    files_below,
    has_content,
    lock_path,
    plain_size,
    process_lock,
    read_text,
    remove_empty_folders,
    resolve_inside,
)
from icrl4aht_data.utils.forks import cached_property
from icrl4aht_data.utils.hashes import file_hash, git_hash
from icrl4aht_data.utils.remembered import remembered_hash
from icrl4aht_data.utils.system import data_folder

_CLIENT_FOLDER = ".cache/huggingface"
"""Where the Hub's client keeps notes on a folder that it downloads to."""

_INDEX_FILES = (INFO, HISTORIES, TASKS, PROVENANCE)  # read when a release is opened

_HUB = re.compile(r"hf://datasets/(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[^@]+))?/?")
_PARALLEL_FILES = 8

Advance = Callable[[int], None]
"""Progress callback: called with the number of bytes that have arrived since the last call."""


@dataclass(frozen=True)
class ReleaseLocation:
    """Folder and remote of an opened release.

    Args:
        folder: its local folder, for a remote release the mirror.
        remote: source of the files that are not in the folder; None for a local release.
    """

    folder: Path
    remote: Remote | None = None

    def __str__(self) -> str:
        return str(self.folder) if self.remote is None else self.remote.url

    def file(self, name: str) -> Path:
        """Path of a complete file, fetched first if it is not downloaded; one of meta/ is checked against the manifest.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if it cannot be fetched.
            IndexFormatError, ChunkTableError: if it is not the one that the manifest lists.
        """
        path = resolve_inside(self.folder, name)
        if self.remote is not None:
            self.remote.fetch([name])
        elif name.startswith("meta/"):
            check_against_manifest(self.folder, [name])
        return path

    def below(self, name: str) -> Path:
        """Path of a folder, which need not exist; all its files are fetched first if they are not downloaded, and
        checked against the manifest.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if a file cannot be fetched.
            IndexFormatError: if a file is not the one that the manifest lists.
        """
        path = resolve_inside(self.folder, name)
        if self.remote is not None:
            self.remote.fetch(known for known in self.remote.manifest if known.startswith(f"{name}/"))
        check_folder(self.folder, name)
        return path

    def is_here(self, name: str) -> bool:
        """Whether a file needs no fetching."""
        return self.remote is None or self.remote.is_here(name)


def open_root(root: str | Path, to: Path | None = None, retry: RetryPolicy | None = None) -> ReleaseLocation:
    """Locate a release; fetch the files that make up the index of a remote one.

    Args:
        root: a folder or an address: hf://datasets/<org>/<repo>[@<revision>], s3://, https://, any other of fsspec.
        to: folder for the files of a remote release; by default the mirror (see the module).
        retry: policy for byte ranges.

    Raises:
        OptionError: if `root` is no address, or `to` has files of something else.
        RootNotFoundError: if the address has no release.
        RemoteError: if the remote cannot be reached, or serves something else than its manifest lists.
        OfflineError: if network access is switched off and the index is not downloaded.
    """
    if isinstance(root, Path) or "://" not in root:
        return ReleaseLocation(Path(root).expanduser())
    if root.startswith("file://"):
        return ReleaseLocation(Path(root.removeprefix("file://")))
    remote = (_open_hub if root.startswith("hf://") else _open_address)(root, to, retry)
    remote.fetch([name for name in _INDEX_FILES if name in remote.manifest])
    return ReleaseLocation(remote.folder, remote)


def is_address(root: str | Path | None) -> bool:
    """Whether a root is the address of a remote release, not a local folder."""
    return isinstance(root, str) and "://" in root and not root.startswith("file://")


@dataclass
class Remote:
    """A release at an address, pinned to one manifest.

    Args:
        url: address of the release, with its revision if it has one.
        revision: the Hub's commit, or the first 16 hexadecimal digits of the manifest's SHA-256.
        folder: its mirror.
        partial: folder for unfinished files.
        manifest: file -> SHA-256, hexadecimal.
        store: reads byte ranges.
        in_hub_cache: whether `folder` belongs to the Hub's cache.
        owned: whether changed files in `folder` may be replaced: it is a mirror, or this user has downloaded into it.
        replaced: names of the changed files that were fetched again.
    """

    url: str
    revision: str
    folder: Path
    partial: Path
    manifest: dict[str, str]
    store: Store
    in_hub_cache: bool = False
    owned: bool = True
    replaced: list[str] = field(default_factory=list)

    def fetch(self, names: Iterable[str], advance: Advance = lambda size: None) -> None:
        """Download complete files, several at once, unless they are in the folder already; see `is_here`.

        A file that was cut resumes at the missing chunks, in the next attempt or the next call.

        Raises:
            OfflineError: names every file that is not downloaded.
            RemoteError: if a file cannot be fetched, or is not the one that the manifest lists.
        """
        wanted = list(dict.fromkeys(names))
        unlisted = [name for name in wanted if name not in self.manifest]
        if unlisted:
            raise RemoteError(f"{self.url}: its manifest does not list {', '.join(unlisted[:5])}", missing=True)
        # First, because another thread may complete a file after it was found to be absent.
        present = {name for name in wanted if self.path(name).exists()}
        absent = [name for name in wanted if not self.is_here(name)]
        changed = [name for name in absent if name in present]
        self.check_replaceable(changed)
        if absent and offline():
            what = "not downloaded, or changed since" if changed else "not downloaded"
            raise OfflineError(f"{self.url}: offline, and {what}: {', '.join(absent)}; go online to fetch them")
        if absent:
            self._fetch_files(absent, advance)
            self.replaced.extend(changed)

    def check_replaceable(self, changed: Sequence[str]) -> None:
        """Check that changed files of the folder may be replaced.

        Raises:
            OptionError: if there are some, and the folder is one that this user has not downloaded.
        """
        if changed and not self.owned:
            raise OptionError(
                f"{self.folder}: {', '.join(changed[:5])}: not as its {MANIFEST} says, and not downloaded to here by "
                f"you: `icrl4aht-data verify {self.folder} --repair --from {self.url}` replaces changed files; or give "
                f"another folder"
            )

    def is_here(self, name: str) -> bool:
        """Whether a file needs no fetching: it has the hash that the manifest lists. Of a shard only the size counts,
        since the chunk table has the hash of every part that is read."""
        if name.startswith("data/"):
            path = self.path(name)
            return path.is_file() and path.stat().st_size == self._shard_sizes.get(name)
        return self.is_unchanged(name)

    def is_unchanged(self, name: str) -> bool:
        """Whether a file in the folder has the hash that the manifest lists; large ones are hashed once, see
        `utils.remembered`."""
        path = self.path(name)
        try:
            limit = self._shard_sizes.get(name, 0) if name.startswith("data/") else LARGEST
            return path.stat().st_size <= limit and remembered_hash(path) == self.manifest[name]
        except OSError:
            return False

    def path(self, name: str) -> Path:
        """Path of a file in the mirror; it need not exist."""
        return resolve_inside(self.folder, name)

    def part(self, name: str) -> PartialFile:
        """The downloaded part of a file that is not complete."""
        if name not in self._parts:
            self._parts[name] = PartialFile(self.store, name, self.partial / name)
        return self._parts[name]

    @cached_property
    def _parts(self) -> dict[str, PartialFile]:
        return {}

    @cached_property
    def _shard_sizes(self) -> dict[str, int]:
        return read_info(self.folder).shards

    def size(self, name: str) -> int:
        """Bytes of a file: of a shard as the release's info says, of another file as the remote says."""
        if name.startswith("data/") and name in self._shard_sizes:
            return self._shard_sizes[name]
        return self.path(name).stat().st_size if self.is_here(name) else self._size_at_remote(name)

    def _size_at_remote(self, name: str) -> int:
        size = self.store.size(name)
        if not name.startswith("data/") and not 0 <= size <= LARGEST:  # a shard's size is checked by its chunk table
            raise RemoteError(f"{self.url}/{name}: expected at most {LARGEST:,} bytes, the remote says {size:,}")
        return size

    def _fetch_files(self, names: Sequence[str], advance: Advance) -> None:
        """Download files that are not in the folder; if one fails, the others are downloaded first."""
        try:
            map_parallel(lambda name: self._fetch_file(name, advance), names, _PARALLEL_FILES)
        finally:
            remove_empty_folders(self.partial)

    def _fetch_file(self, name: str, advance: Advance) -> None:
        target, part = self.path(name), self.part(name)
        with process_lock(part.path.with_name(f".{part.path.name}.lock")):
            if self.is_here(name):  # downloaded by another process meanwhile
                return
            complete_file(part, self.size(name), self.manifest[name], self._chunks(name), advance)
            target.parent.mkdir(parents=True, exist_ok=True)
            part.path.replace(target)

    def repair_file(self, name: str, advance: Advance = lambda size: None) -> None:
        """Replace a damaged file of the folder; of a shard only the damaged chunks are fetched, in place.

        Args:
            name: the file.
            advance: called with the number of valid bytes since the last call.

        Raises:
            RemoteError: if the remote's file is not the one that the manifest lists; the damaged file is kept.
        """
        target, chunks = self.path(name), self._chunks(name)
        in_place = chunks is not None and target.exists()
        # In the Hub's cache a file of the release is a link to its content.
        part = PartialFile(self.store, name, target.resolve()) if in_place else self.part(name)
        if not in_place:
            part.path.unlink(missing_ok=True)
        size = self._size_at_remote(name)
        complete_file(part, size, self.manifest[name], chunks, advance, in_place)
        if not in_place:
            target.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(target) as new:
                shutil.move(part.path, new)
            remove_empty_folders(self.partial)

    def _chunks(self, name: str) -> np.ndarray | None:
        """Chunk table of a shard (CHUNK_DTYPE (n,)), fetched if necessary; None for another file."""
        table = chunk_table_name(name)
        if not name.startswith("data/") or table not in self.manifest:
            return None
        self.fetch([table])
        return np.array(read_table(self.path(table)))


class HubRemote(Remote):
    """A dataset repository of the Hub, whose complete files are downloaded by the Hub's own client."""

    def _fetch_files(self, names: Sequence[str], advance: Advance) -> None:
        """Download files to the Hub's cache, or by way of `partial` to `folder`; remove those with a wrong hash."""
        assert isinstance(self.store, HubStore)
        damaged = ""
        with nullcontext() if self.in_hub_cache else process_lock(lock_path(self.folder)):
            names = [name for name in names if not self.is_here(name)]
            for name in names if self.in_hub_cache else ():
                _remove_from_cache(self.path(name))  # changed; the client would take what is there
            # Twice a shard's size, because the client counts the bytes before a cut as well.
            limit = sum(2 * self._shard_sizes.get(n, LARGEST) if n.startswith("data/") else LARGEST for n in names)
            local_dir = None if self.in_hub_cache else self.partial
            folder = self.store.fetch_files(names, limit, advance, local_dir) if names else self.folder
            for name in names:
                path, target, found = folder / name, self.path(name), file_hash(folder / name)
                if found != self.manifest[name]:
                    damaged = damaged or f"{self.url}/{name}: expected sha256 {self.manifest[name]}, found {found}"
                    _remove_from_cache(path)
                    continue
                if not self.in_hub_cache:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(target)
                self.part(name).path.unlink(missing_ok=True)
            if not damaged and not self.in_hub_cache:
                shutil.rmtree(self.partial / _CLIENT_FOLDER, ignore_errors=True)
            remove_empty_folders(self.partial)
        if damaged:
            raise RemoteError(f"{damaged}: fetch it again; if that does not help, report it to its publisher")


def _remove_from_cache(path: Path) -> None:
    """Remove a file of the Hub's cache: the link in the snapshot and the content that it points to."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def _open_hub(url: str, to: Path | None, retry: RetryPolicy | None) -> Remote:
    match = _HUB.fullmatch(url)
    if match is None:
        found = without_credentials(url)
        raise OptionError(f"{found}: expected hf://datasets/<org>/<repo> or hf://datasets/<org>/<repo>@<revision>")
    with _missing_release(url):
        snapshot = HubStore(match["repo"], match["revision"]).fetch_files([MANIFEST], TEXT_BYTES, lambda size: None)
    path, store = snapshot / MANIFEST, HubStore(match["repo"], snapshot.name, retry)
    plain_size(path, TEXT_BYTES)
    text, blob = path.read_bytes(), path.resolve()
    if len(blob.name) == 40 and blob.name != git_hash(text):  # the cache names a small file by the hash that git has
        _remove_from_cache(path)
        raise RemoteError(f"{url}/{MANIFEST}: arrived damaged: expected git hash {blob.name}; fetch it again")
    manifest = _parse_manifest(text, store.url)
    if to is None:
        partial = data_folder() / _folder_name(url) / f"{snapshot.name}.partial"
        check_partial_folder(partial, manifest)
        return HubRemote(store.url, snapshot.name, snapshot, partial, manifest, store, in_hub_cache=True)
    partial = _partial_folder(to)
    check_partial_folder(partial, manifest)
    _claim_folder(to, text, manifest, store.url, chosen=True)
    return HubRemote(store.url, snapshot.name, to, partial, manifest, store, owned=read_note(to) is not None)


def _open_address(address: str, to: Path | None, retry: RetryPolicy | None) -> Remote:
    store = Store(address, retry)
    url, base = store.url, data_folder() / _folder_name(store.url)
    latest = base / "latest"  # the version that this address had when it was last opened
    known = _read_revision(latest)
    if offline():
        text = _downloaded_manifest(url, to or base / known)
        if to is None and _revision(text) != known:
            raise OfflineError(f"{base / known / MANIFEST}: changed since it was downloaded; go online to fetch it")
    else:
        with _missing_release(url):
            size = store.size(MANIFEST)
            if size > TEXT_BYTES:
                raise IndexFormatError(f"{url}/{MANIFEST}: expected at most {TEXT_BYTES:,} bytes, found {size:,}")
            text = store.read(MANIFEST, 0, size)
    manifest, revision = _parse_manifest(text, url), _revision(text)
    folder = to or base / revision
    check_partial_folder(_partial_folder(folder), manifest)
    _claim_folder(folder, text, manifest, url, chosen=to is not None)
    if to is None and known != revision:
        with process_lock(lock_path(latest)), atomic_write(latest) as partial:
            partial.write_text(revision, encoding="utf-8")
    owned = to is None or read_note(to) is not None
    return Remote(url, revision, folder, _partial_folder(folder), manifest, store, owned=owned)


def _revision(manifest: bytes) -> str:
    return hashlib.sha256(manifest).hexdigest()[:16]


def _read_revision(path: Path) -> str:
    """The revision noted in a file; empty without one."""
    with suppress(IndexFormatError):
        text = read_text(path)
        return text if re.fullmatch("[0-9a-f]{16}", text) else ""
    return ""


@contextmanager
def _missing_release(url: str) -> Iterator[None]:
    """Report a missing manifest as a missing release."""
    try:
        yield
    except RemoteError as error:
        if error.missing:
            raise RootNotFoundError(f"{url}: no release there, expected {MANIFEST} in it: {error}") from None
        raise


def _downloaded_manifest(url: str, folder: Path) -> bytes:
    try:
        plain_size(folder / MANIFEST, TEXT_BYTES)
        return (folder / MANIFEST).read_bytes()
    except (OSError, IndexFormatError) as error:
        raise OfflineError(f"{url}: offline, and nothing of it is downloaded; go online to fetch it") from error


def _parse_manifest(text: bytes, url: str) -> dict[str, str]:
    # What is not UTF-8 becomes unprintable characters, which no line may have.
    return parse_manifest(text.decode(errors="surrogateescape"), f"{url}/{MANIFEST}")


def _claim_folder(folder: Path, text: bytes, manifest: dict[str, str], url: str, chosen: bool) -> None:
    """Write the manifest into the folder for a release, which may hold files of this manifest only.

    Args:
        folder: the folder, which need not exist.
        text: the manifest.
        manifest: its content.
        url: address of the release.
        chosen: whether a user has chosen the folder, so that it may hold anything; else it is a mirror.

    Raises:
        OptionError: if the folder has files of something else.
    """
    path = folder / MANIFEST
    if has_content(path, text):
        if chosen:
            check_only_files_of(folder, manifest)
        return
    with process_lock(lock_path(folder)):
        note = read_note(folder)
        ours = not chosen or (note is not None and note.belongs_to(manifest))
        if path.exists() and not has_content(path, text) and not ours and not _has_only_files_of(folder, manifest):
            raise OptionError(f"{folder}: holds another release or version than {url} has now; give another folder")
        if not ours and not path.exists() and folder.exists() and any(folder.iterdir()):
            raise OptionError(
                f"{folder}: not empty, and not a release, so that nothing is written into it; give a new or an empty "
                f"folder"
            )
        if chosen:
            check_only_files_of(folder, manifest)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            partial.write_bytes(text)


def _has_only_files_of(folder: Path, manifest: dict[str, str]) -> bool:
    """Whether every file in a folder is listed alike by its own manifest and the given one.

    Two manifests that agree on the files are of one release: one of the manifests had arrived damaged.
    """
    try:
        listed = read_manifest(folder)
    except Icrl4ahtError:
        return False
    return all(manifest.get(name) == digest for name, digest in listed.items() if (folder / name).exists())


def check_partial_folder(partial: Path, manifest: Mapping[str, str]) -> None:
    """Check that a folder for unfinished files, which need not exist, has nothing but these, and no links.

    Raises:
        OptionError: if it is not a folder, or has a link or anything else; names it.
    """
    if partial.is_symlink() or (partial.exists() and not partial.is_dir()):
        raise OptionError(f"{partial}: expected a folder for unfinished files, found something else; remove it")
    for name in files_below(partial) if partial.exists() else ():
        path, file = partial / name, re.sub(r"(^|/)\.([^/]+)\.lock$", r"\1\2", name)
        with suppress(FileNotFoundError):  # another process has completed it
            if not stat.S_ISREG(path.lstat().st_mode):
                raise OptionError(f"{path}: not a plain file: remove it, since downloads are written there")
            if file not in manifest and not name.startswith(f"{_CLIENT_FOLDER}/"):
                raise OptionError(f"{path}: not of a download of this release: remove it, or rename {partial}")


def _partial_folder(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.partial")


def _folder_name(url: str) -> str:
    """A readable and unique folder name for an address."""
    return f"{re.sub(r'[^A-Za-z0-9.]+', '-', url)[:80]}-{hashlib.sha256(url.encode()).hexdigest()[:8]}"
