"""Byte ranges of files behind any fsspec address, with patience: what passes is tried again, what stays is an error."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from functools import cached_property
from typing import Any, TypeVar

from icrl4aht_data.errors import Icrl4ahtError, OptionError, RemoteError

T = TypeVar("T")

_PASSING = {408, 425, 429, 500, 502, 503, 504}
_LASTING = (FileNotFoundError, PermissionError, Icrl4ahtError, ImportError, NotImplementedError, MemoryError, TypeError)
_TIMEOUT = 30  # seconds without a byte, or until a connection


@dataclass(frozen=True)
class Patience:
    """How often a request is tried, and how long to wait in between, in seconds: doubled each time, or what the
    server asks for if that is more."""

    attempts: int = 8
    first: float = 0.25
    longest: float = 60.0


@dataclass
class Traffic:
    """What was asked of a remote: requests that gave file content, and the bytes they gave."""

    requests: int = 0
    bytes: int = 0

    def __sub__(self, before: Traffic) -> Traffic:
        return Traffic(self.requests - before.requests, self.bytes - before.bytes)


class WrongLengthError(OSError):
    """A server sent more or fewer bytes than asked."""


class Store:
    """Files below an address. May be shared between threads, pickled, and used after a fork.

    Args:
        url: of a folder: https://, s3://, hf://datasets/<org>/<repo>@<revision>, or any other that fsspec opens.
        patience: see there.
    """

    def __init__(self, url: str, patience: Patience | None = None) -> None:
        self.url = url.rstrip("/")
        self.patience = patience or Patience()
        self._traffic = Traffic()
        self._lock = threading.Lock()

    def __getstate__(self) -> tuple[str, Patience]:
        return self.url, self.patience

    def __setstate__(self, state: tuple[str, Patience]) -> None:
        self.__init__(*state)

    @property
    def traffic(self) -> Traffic:
        """So far, a copy."""
        with self._lock:
            return Traffic(self._traffic.requests, self._traffic.bytes)

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Bytes start..stop of a file.

        Raises:
            RemoteError: names the address and what the last answer was.
        """
        return self.patiently(name, lambda: self._range(name, start, stop))

    def size(self, name: str) -> int:
        """Of a file, in bytes."""

        def ask() -> int:
            size = self._files.info(self._address(name))["size"]
            if size is None:
                raise WrongLengthError("the server does not say how long the file is")
            return int(size)

        return self.patiently(name, ask)

    def _range(self, name: str, start: int, stop: int) -> bytes:
        # cache_type: the Hub's file system would read five megabytes ahead
        hub = {"cache_type": "none"} if self.url.startswith("hf://") else {}
        data = self._files.cat_file(self._address(name), start=start, end=stop, **hub)
        with self._lock:
            self._traffic.requests += 1
            self._traffic.bytes += len(data)
        if len(data) != stop - start:
            whole = len(data) >= stop and len(data) == self._files.info(self._address(name))["size"]
            if not whole:
                raise WrongLengthError(f"asked for bytes {start}..{stop}, got {len(data)} bytes")
            data = data[start:stop]  # a server without ranges
        return data

    def _address(self, name: str) -> str:
        return f"{self.url}/{name}" if name else self.url

    @property
    def _files(self) -> Any:
        """The fsspec file system: one a process, since connections do not survive a fork."""
        if self._opened[0] != os.getpid():
            del self._opened
        return self._opened[1]

    @cached_property
    def _opened(self) -> tuple[int, Any]:
        import fsspec

        scheme = self.url.partition("://")[0]
        options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
        if scheme in ("http", "https"):
            import aiohttp

            timeout = aiohttp.ClientTimeout(total=None, sock_connect=_TIMEOUT, sock_read=_TIMEOUT)
            options["client_kwargs"] = {"timeout": timeout}
        elif scheme == "s3":
            options["config_kwargs"] = {"connect_timeout": _TIMEOUT, "read_timeout": _TIMEOUT}
            options["config_kwargs"]["retries"] = {"total_max_attempts": 1}  # `Patience` is enough
        elif scheme == "hf":
            options = {"skip_instance_cache": True}
        try:
            files = fsspec.url_to_fs(self.url, **options)[0]
        except ImportError as error:
            extra = {"s3": "s3"}.get(scheme)
            remedy = f"`pip install 'icrl4aht-data[{extra}]'`" if extra else "install what fsspec needs for it"
            raise OptionError(f"{self.url}: {error}; {remedy}") from error
        except ValueError as error:
            raise OptionError(f"{self.url}: not an address that fsspec opens: {error}") from error
        if scheme == "s3":
            files.retries = 1
        return os.getpid(), files

    def patiently(self, name: str, ask: Callable[[], T]) -> T:
        """What `ask` gives, asked again while its errors are of the passing kind.

        Raises:
            RemoteError: names the file's address.
            OSError: if the disk takes no more.
        """
        import tenacity

        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception(_passes),
            stop=tenacity.stop_after_attempt(self.patience.attempts),
            wait=self._wait,
            reraise=True,
        )
        try:
            return retrying(ask)
        except (Icrl4ahtError, MemoryError):
            raise
        except Exception as raised:  # every file system has errors of its own
            error = _behind(raised)
            if _is_of_disk(error):
                raise
            if not isinstance(error, FileNotFoundError) and _status(error) != 404:
                tried = f" ({self.patience.attempts} attempts)" if _passes(error) else ""
                raise RemoteError(
                    f"{self._address(name)}: {_in_words(error)}{tried}; what has arrived is kept: try again to go on"
                ) from error
            raise RemoteError(f"{self._address(name)}: the remote has no such file", missing=True) from error

    def _wait(self, state: Any) -> float:
        error = state.outcome.exception()
        doubled = self.patience.first * 2 ** (state.attempt_number - 1)
        return min(max(doubled, _retry_after(error)), self.patience.longest)


def _passes(error: BaseException) -> bool:
    """Whether the same request may succeed a moment later."""
    error = _behind(error)
    status = _status(error)
    if status is not None:
        return status in _PASSING
    return isinstance(error, Exception) and not isinstance(error, _LASTING) and not _is_of_disk(error)


def _behind(error: BaseException) -> BaseException:
    """What went wrong: fsspec says "not found" of whatever keeps it from asking for a file's length."""
    status = _status(error)
    if isinstance(error, FileNotFoundError) and error.__cause__ and (status is None or status in _PASSING):
        return error.__cause__
    return error


def _is_of_disk(error: BaseException) -> bool:
    """Whether this machine's disk refused to take what came."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def _status(error: BaseException | None) -> int | None:
    """The HTTP status in an error of aiohttp, httpx or botocore, or in what caused it."""
    while error is not None:
        response = getattr(error, "response", None)
        found = getattr(error, "status", None) or getattr(response, "status_code", None)
        if found is None and isinstance(response, dict):
            found = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        if isinstance(found, int):
            return found
        error = error.__cause__
    return None


def _retry_after(error: BaseException | None) -> float:
    """Seconds that a server asked to wait; 0 if it did not."""
    while error is not None:
        response = getattr(error, "response", None)
        headers = getattr(error, "headers", None) or getattr(response, "headers", None) or {}
        if isinstance(response, dict):
            headers = response.get("ResponseMetadata", {}).get("HTTPHeaders", {})
        asked = {str(key).lower(): value for key, value in dict(headers).items()}.get("retry-after")
        if asked is not None:
            return _seconds(asked)
        error = error.__cause__
    return 0.0


def _seconds(asked: str) -> float:
    """From now, of a number or a date."""
    try:
        return float(asked)
    except ValueError:
        with suppress(ValueError):
            return parsedate_to_datetime(asked).timestamp() - time.time()
    return 0.0


def _in_words(error: BaseException) -> str:
    """One line, without the library's own advice."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:300]}" if text else type(error).__name__
