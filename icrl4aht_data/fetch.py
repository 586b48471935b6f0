"""Releases at an address: files are fetched complete, checked once against the manifest, and are local from then on.

A release at an address has a folder on this machine: for `hf://` its snapshot in the Hub's own cache, which other tools
share, and for any other address a folder below `system.data_folder`, one per version. A file gets its name there only
after its SHA-256 was found to be the manifest's, so that an interrupted download is resumed file by file.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar
from urllib.parse import urlsplit

from icrl4aht_data.errors import Icrl4ahtError, OfflineError, OptionError, RemoteError, RootNotFoundError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import check_against_manifest, check_folder, parse_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.utils import files as disk
from icrl4aht_data.utils.hashes import file_hash, git_hash
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.progress import counted, progress_bars
from icrl4aht_data.utils.system import data_folder

T = TypeVar("T")

Advance = Callable[[int], None]
"""Progress callback: called with the number of bytes that have arrived since the last call."""

_TIMEOUT = 15.0  # seconds until a connection, and between two bytes of an answer
_WAITS = (1.0, 2.0, 4.0)  # seconds before a request is repeated after a transient error
_THREADS = 8  # files fetched at once
_TRANSIENT_STATUS = {408, 425, 429, 500, 502, 503, 504}
_PERMANENT = (FileNotFoundError, PermissionError, ImportError, NotImplementedError, TypeError, ValueError)
_INDEX_FILES = (INFO, HISTORIES, TASKS, PROVENANCE)  # read when a release is opened
_HUB = re.compile(r"hf://datasets/(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[^@]+))?/?")
_ADDRESS = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*://)(?:[^/\s'\"<>]*@)?(?P<rest>[^\s?#'\"<>]*)[^\s'\"<>]*")


def is_address(root: str | Path | None) -> bool:
    """Return whether a root is the address of a remote release, not a local folder."""
    return isinstance(root, str) and "://" in root and not root.startswith("file://")


def offline_switches() -> list[str]:
    """Return the names of the environment variables that are set and switch network access off."""
    names = ("HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE")
    return [name for name in names if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]


def without_credentials(text: str) -> str:
    """Return a text without the user names, passwords, queries and fragments of the addresses in it."""
    return _ADDRESS.sub(r"\g<scheme>\g<rest>", text)


def check_credentials(address: str) -> None:
    """Check that a password in an address has no "/", after which the rest would be taken for the path and shown.

    Raises:
        OptionError: if it may have one; the message does not have the address.
    """
    try:
        parts = urlsplit(address)
        # A host with a port, or what seems to be one, and an "@" behind it: the host's name then has a dot.
        is_clear = parts.port is None or "@" in parts.netloc or "@" not in parts.path or "." in parts.netloc
    except ValueError:  # what should be the port is no number
        is_clear = False
    if not is_clear:
        raise OptionError(
            "an address, not shown because it may have a password: expected SCHEME://HOST:PORT/PATH or "
            "SCHEME://USER:PASSWORD@HOST/PATH: percent-encode the user name and password, such as / as %2F"
        )


class HubClient:
    """Files of a dataset repository of the Hugging Face Hub, by the Hub's own client, which retries and has the token.

    Args:
        repo: <org>/<repo>.
        revision: branch, tag or commit.
    """

    def __init__(self, repo: str, revision: str) -> None:
        self.repo, self.revision = repo, revision

    @contextmanager
    def connect(self) -> Iterator[None]:
        """Open a context for requests, in which an address is given up after `_TIMEOUT` seconds without an answer.

        Without the two hooks the client waits for some answers without a limit, and five times 60 s for others.
        """
        from huggingface_hub import get_session

        unanswered: dict[str, float] = {}

        def before(request: Any) -> None:
            first = unanswered.setdefault(str(request.url), time.monotonic())
            if time.monotonic() - first >= 0.9 * _TIMEOUT:
                raise TimeoutError(f"no answer for {_TIMEOUT:g} s")
            request.extensions["timeout"] = dict.fromkeys(("connect", "read", "write", "pool"), _TIMEOUT)

        def after(response: Any) -> None:
            unanswered.pop(str(response.request.url), None)

        hooks = get_session().event_hooks
        hooks["request"].append(before)
        hooks["response"].append(after)
        try:
            yield
        finally:
            hooks["request"].remove(before)
            hooks["response"].remove(after)

    def get(self, name: str, scratch: Path | None, count: Advance) -> Path:
        """Fetch a file into a folder, or by default into the Hub's cache; return its path."""
        from huggingface_hub import hf_hub_download
        from huggingface_hub.utils import tqdm

        class Bar(tqdm):
            """Invisible progress bar that counts the bytes which arrive."""

            def __init__(self, *args: Any, **options: Any) -> None:
                super().__init__(*args, **options | {"disable": True})

            def update(self, n: float | None = 1) -> bool | None:
                count(int(n or 0))
                return super().update(n)

        options: dict[str, Any] = {"repo_type": "dataset", "revision": self.revision, "local_dir": scratch}
        is_offline = bool(offline_switches())
        return Path(hf_hub_download(self.repo, name, **options, local_files_only=is_offline, tqdm_class=Bar))

    def sizes(self, names: list[str]) -> list[int]:
        """Return the bytes of files; 0 where the server does not say."""
        from huggingface_hub import HfApi

        info = HfApi().dataset_info(self.repo, revision=self.revision, files_metadata=True, timeout=_TIMEOUT)
        known = {file.rfilename: file.size for file in info.siblings or ()}
        return [known.get(name) or 0 for name in names]


class FsspecClient:
    """Files below an https://, s3:// or any other address that fsspec opens.

    Args:
        address: the folder. It may have a user name and a password, or a query that is sent with every request.
    """

    def __init__(self, address: str) -> None:
        self._address, self._files = address, None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._address,)

    @contextmanager
    def connect(self) -> Iterator[None]:
        """Open a context for requests; each time a new file system, since connections do not survive a fork."""
        self._files = _open_filesystem(self._address)
        yield

    def get(self, name: str, scratch: Path | None, count: Advance) -> Path:
        """Fetch a file into a folder; return its path."""
        from fsspec.callbacks import Callback

        assert self._files is not None and scratch is not None

        class Counter(Callback):
            """Passes on the bytes which arrive."""

            def relative_update(self, inc: int = 1) -> None:
                count(inc)

        path = scratch / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._files.get_file(self._file_address(name), str(path), callback=Counter())
        return path

    def sizes(self, names: list[str]) -> list[int]:
        """Return the bytes of files; 0 where the server does not say."""
        assert self._files is not None
        with ThreadPoolExecutor(_THREADS) as pool:
            return [int(info["size"] or 0) for info in pool.map(self._files.info, map(self._file_address, names))]

    def _file_address(self, name: str) -> str:
        path, mark, query = self._address.partition("?")
        return f"{path.rstrip('/')}/{name}{mark}{query}"


def _open_filesystem(address: str) -> Any:
    import fsspec

    scheme, shown = address.partition("://")[0], without_credentials(address)
    options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
    if scheme in ("http", "https"):
        from aiohttp import ClientTimeout

        options["client_kwargs"] = {"timeout": ClientTimeout(total=None, sock_connect=_TIMEOUT, sock_read=_TIMEOUT)}
    elif scheme == "s3":
        once = {"total_max_attempts": 1}  # `_with_retries` repeats the requests of every protocol alike
        options["config_kwargs"] = {"connect_timeout": _TIMEOUT, "read_timeout": _TIMEOUT, "retries": once}
    try:
        files = fsspec.url_to_fs(address, **options)[0]
    except ImportError as error:
        remedy = f"`{install_command('s3')}`" if scheme == "s3" else "install what fsspec needs for it"
        raise OptionError(f"{shown}: {error}; {remedy}") from error
    except ValueError as error:
        problem = f"{shown}: not an address that fsspec opens: {without_credentials(str(error))}"
        raise OptionError(f"{problem}; expected hf://datasets/<org>/<repo>, https://... or s3://...") from None
    if scheme == "s3":
        files.retries = 1  # s3fs repeats requests on its own, besides botocore
    return files


def _with_retries(address: str, request: Callable[[], T]) -> T:
    """Return the result of a request, repeated after transient errors.

    Raises:
        RemoteError: names the address; instead of the client's error.
        OSError: unchanged, if the local disk is full or not writable.
    """
    for wait in (*_WAITS, None):
        try:
            return request()
        except Icrl4ahtError:
            raise
        except Exception as error:  # every client has its own error classes
            if isinstance(error, OSError) and error.errno in (*disk.NO_ROOM, errno.EROFS):
                raise
            if wait is None or not _is_transient(error):
                raise _remote_error(address, error) from None
        time.sleep(wait)
    raise AssertionError


def _is_transient(error: Exception) -> bool:
    """Return whether the same request may succeed a moment later."""
    if type(error).__name__ == "LocalEntryNotFoundError":  # the Hub's client has repeated the request
        return False
    status, cause = _http_status(error), _root_cause(error)
    if status is not None:
        return status in _TRANSIENT_STATUS
    # A server that did not answer in time is not asked again: the user waits for the first word.
    return not isinstance(cause, _PERMANENT) and "Timeout" not in type(cause).__name__


def _remote_error(address: str, error: Exception) -> RemoteError:
    """Return the error to raise instead of a client's, whose messages may have a password."""
    cause = _root_cause(error)
    text = without_credentials(" ".join(f"{type(cause).__name__}: {cause}".split()))[:400]
    if isinstance(cause, FileNotFoundError) or _http_status(error) == 404:
        return RemoteError(f"{address}: the remote has no such file: {text}", missing=True)
    return RemoteError(f"{address}: {text}; repeat the command, which keeps the files that are complete")


def _root_cause(error: BaseException) -> BaseException:
    """Return the error behind a FileNotFoundError: clients turn any failure to learn a file's size into one."""
    while isinstance(error, FileNotFoundError) and error.__cause__ is not None:
        error = error.__cause__
    return error


def _http_status(error: BaseException | None) -> int | None:
    """Return the HTTP status behind an error of aiohttp, httpx or botocore; None without an answer."""
    while error is not None:
        answer = getattr(error, "response", None)
        if isinstance(answer, dict):  # botocore
            status = answer.get("ResponseMetadata", {}).get("HTTPStatusCode")
        else:
            status = getattr(answer, "status_code", getattr(error, "status", None))
        if isinstance(status, int):
            return status
        error = error.__cause__
    return None


@dataclass(frozen=True)
class ReleaseLocation:
    """Folder and remote of an opened release.

    Args:
        folder: its folder on this machine.
        remote: source of the files that are not in the folder; None for a local release.
    """

    folder: Path
    remote: Remote | None = None

    def __str__(self) -> str:
        return str(self.folder) if self.remote is None else self.remote.url

    def file(self, name: str) -> Path:
        """Return the path of a file, fetched first if necessary; a local one of meta/ is checked against the manifest.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if it cannot be fetched.
            IndexFormatError, ChunkTableError: if it is not the one that the manifest lists.
        """
        path = disk.resolve_inside(self.folder, name)
        if self.remote is not None:
            self.remote.fetch([name])
        elif name.startswith("meta/"):
            check_against_manifest(self.folder, [name])
        return path

    def below(self, name: str) -> Path:
        """Return the path of a folder, which need not exist, after its files are fetched and checked.

        Raises:
            UnsafePathError: if it leads out of the release.
            RemoteError, OfflineError: if a file cannot be fetched.
            IndexFormatError: if a file is not the one that the manifest lists.
        """
        path = disk.resolve_inside(self.folder, name)
        if self.remote is not None:
            self.remote.fetch(known for known in self.remote.manifest if known.startswith(f"{name}/"))
        check_folder(self.folder, name)
        return path

    def is_here(self, name: str) -> bool:
        """Return whether a file needs no fetching."""
        return self.remote is None or self.remote.is_here(name)


@dataclass
class Remote:
    """A release at an address, pinned to one manifest.

    Args:
        url: address of the release, with its revision if it has one, without credentials.
        revision: the Hub's commit, or the first 16 hexadecimal digits of the manifest's SHA-256.
        folder: its folder on this machine.
        manifest: file -> SHA-256, hexadecimal.
        client: fetches files.
        in_hub_cache: whether `folder` belongs to the Hub's cache.
        fetched: bytes of the files fetched so far.
    """

    url: str
    revision: str
    folder: Path
    manifest: dict[str, str]
    client: HubClient | FsspecClient
    in_hub_cache: bool = False
    fetched: int = 0

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
            pool = stack.enter_context(ThreadPoolExecutor(_THREADS))
            stack.callback(pool.shutdown, cancel_futures=True)
            for file in as_completed([pool.submit(self._fetch_file, name, scratch, advance) for name in absent]):
                self.fetched += file.result()

    def _fetch_file(self, name: str, scratch: Path | None, advance: Advance) -> int:
        """Fetch a file and move it to its path if it has the manifest's hash; return its bytes."""
        address, target = f"{self.url}/{name}", self.path(name)
        most = self._shard_sizes.get(name, 2**62) if name.startswith("data/") else disk.LARGEST
        if scratch is None:
            _remove_from_cache(target)  # a changed file, which the client would take
        path = _with_retries(address, lambda: _get(self.client, address, name, scratch, most, advance))
        size, found = path.stat().st_size, file_hash(path)
        if found != self.manifest[name]:
            if scratch is None:
                _remove_from_cache(path)
            raise RemoteError(
                f"{address}: expected sha256 {self.manifest[name]}, found {found} in {size:,} bytes: fetch it again; "
                f"if that does not help, it is damaged or not of this version: report it to its publisher",
                is_content=True,
            )
        if scratch is not None:
            disk.sync(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        return size

    def is_here(self, name: str) -> bool:
        """Return whether a file needs no fetching: it has the manifest's hash, or as a shard the right size.

        A shard's content is checked chunk by chunk when it is read.
        """
        path = self.path(name)
        if name.startswith("data/"):
            return path.is_file() and path.stat().st_size == self._shard_sizes.get(name)
        return self.is_unchanged(name)

    def is_unchanged(self, name: str) -> bool:
        """Return whether a file in the folder has the hash that the manifest lists."""
        path = self.path(name)
        most = self._shard_sizes.get(name, 0) if name.startswith("data/") else disk.LARGEST
        return path.is_file() and path.stat().st_size <= most and file_hash(path) == self.manifest[name]

    def path(self, name: str) -> Path:
        """Return the path of a file in the folder; it need not exist."""
        return disk.resolve_inside(self.folder, name)

    def sizes(self, names: Iterable[str]) -> dict[str, int]:
        """Return the bytes of files as the remote says; 0 where it does not say.

        Raises:
            RemoteError: if the remote cannot be reached, or does not have a file.
        """
        names = list(names)
        if not names:
            return {}
        with self.client.connect():
            return dict(zip(names, _with_retries(self.url, lambda: self.client.sizes(names)), strict=True))

    @cached_property
    def _shard_sizes(self) -> dict[str, int]:
        return read_info(self.folder).shards


def _get(
    client: HubClient | FsspecClient, address: str, name: str, scratch: Path | None, most: int, advance: Advance
) -> Path:
    """Fetch a file of at most `most` bytes; `advance` has been called with all of them when it is complete."""
    arrived = 0

    def count(size: int) -> None:
        nonlocal arrived
        arrived += size
        advance(size)
        if arrived > most:
            raise RemoteError(f"{address}: expected at most {most:,} bytes, the server sent more", is_content=True)

    try:
        path = client.get(name, scratch, count)
    except BaseException:
        advance(-arrived)
        raise
    advance(path.stat().st_size - arrived)  # what the Hub's cache had under another name
    return path


def _remove_from_cache(path: Path) -> None:
    """Remove a file of the Hub's cache: the link in the snapshot and the content that it points to."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def open_root(root: str | Path, to: Path | None = None) -> ReleaseLocation:
    """Locate a release; fetch the manifest and the index of a remote one.

    Args:
        root: a folder or an address: hf://datasets/<org>/<repo>[@<revision>], s3://, https://, any other of fsspec.
        to: folder for the files of a remote release; see the module for the default.

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
    remote = (_open_hub if root.startswith("hf://") else _open_address)(root, to)
    remote.fetch([name for name in _INDEX_FILES if name in remote.manifest])
    return ReleaseLocation(remote.folder, remote)


def _open_hub(url: str, to: Path | None) -> Remote:
    match = _HUB.fullmatch(url)
    if match is None:
        found = without_credentials(url)
        raise OptionError(f"{found}: expected hf://datasets/<org>/<repo> or hf://datasets/<org>/<repo>@<revision>")
    path, text = _fetch_manifest(HubClient(match["repo"], match["revision"] or "main"), url, None)
    blob, commit = path.resolve().name, path.parent.name
    if len(blob) == 40 and blob != git_hash(text):  # the cache names a small file by the hash that git has
        _remove_from_cache(path)
        raise RemoteError(f"{url}/{MANIFEST}: arrived damaged: expected git hash {blob}; fetch it again")
    url = f"hf://datasets/{match['repo']}@{commit}"
    if to is not None:
        _prepare_folder(to, text, url)
    client, manifest = HubClient(match["repo"], commit), _parse_manifest(text, url)
    return Remote(url, commit, to or path.parent, manifest, client, in_hub_cache=to is None)


def _open_address(address: str, to: Path | None) -> Remote:
    check_credentials(address)
    client, url = FsspecClient(address), without_credentials(address).rstrip("/")
    base = data_folder() / f"{re.sub(r'[^A-Za-z0-9.]+', '-', url)[:80]}-{short_hash(url.encode(), 8)}"
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
            (base / short_hash(text)).mkdir(parents=True, exist_ok=True)
            with disk.process_lock(disk.lock_path(latest)), disk.atomic_write(latest) as partial:
                partial.write_text(short_hash(text))
    folder = to or base / short_hash(text)
    _prepare_folder(folder, text, url, is_ours=to is None)
    return Remote(url, short_hash(text), folder, _parse_manifest(text, url), client)


def _fetch_manifest(client: HubClient | FsspecClient, url: str, scratch: Path | None) -> tuple[Path, bytes]:
    """Return the path and the content of a release's manifest; a missing one is a missing release."""
    address = f"{url}/{MANIFEST}"
    try:
        with client.connect():
            path = _with_retries(
                address, lambda: _get(client, address, MANIFEST, scratch, disk.TEXT_BYTES, lambda size: None)
            )
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
    return parse_manifest(text.decode(errors="surrogateescape"), f"{url}/{MANIFEST}")


def short_hash(data: bytes, digits: int = 16) -> str:
    """Return the first hexadecimal digits of a text's SHA-256."""
    return hashlib.sha256(data).hexdigest()[:digits]


def _prepare_folder(folder: Path, text: bytes, url: str, is_ours: bool = False) -> None:
    """Write the manifest into the folder for a release.

    Raises:
        OptionError: if the folder has files of something else, unless it is one of `system.data_folder`.
    """
    path = folder / MANIFEST
    if disk.has_content(path, text):
        return
    if path.exists() and not is_ours:
        raise OptionError(f"{folder}: holds another release or version than {url} has now; give another folder")
    if folder.exists() and any(folder.iterdir()) and not is_ours:
        raise OptionError(f"{folder}: not empty, and not a release; give a new or an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    with disk.process_lock(disk.lock_path(folder)), disk.atomic_write(path) as partial:
        partial.write_bytes(text)
