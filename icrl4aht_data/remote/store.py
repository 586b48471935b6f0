"""Byte ranges of files behind any fsspec address, with patience: what passes is tried again, what stays is an error."""

from __future__ import annotations

import errno
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from functools import cached_property
from typing import Any, TypeVar
from urllib.parse import urlsplit

from icrl4aht_data.errors import Icrl4ahtError, OfflineError, OptionError, RemoteError

T = TypeVar("T")
_log = logging.getLogger(__name__)

_PASSING = {408, 425, 429, 500, 502, 503, 504}
_LASTING = (FileNotFoundError, PermissionError, Icrl4ahtError, ImportError, NotImplementedError, MemoryError, TypeError)
_TIMEOUT = 30  # seconds without a byte, or until a connection
_TOTAL = 300  # seconds for a request, of a server that sends a byte now and then
_LONG_WAIT = 2.0  # seconds between attempts, from which on a wait is told
_WHOLE = 64 * 2**20  # bytes taken from a server that gives all of a file instead of a range


@dataclass(frozen=True)
class RetryPolicy:
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


def offline() -> bool:
    """Whether nothing may be asked of the network: HF_HUB_OFFLINE or ICRL4AHT_OFFLINE, read at each call."""
    return bool(offline_switches())


def offline_switches() -> list[str]:
    """The environment variables that are set so that nothing may be asked of the network."""
    names = ("HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE")
    return [name for name in names if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]


class WrongLengthError(OSError):
    """A server sent more or fewer bytes than asked."""


class Store:
    """Files below an address. May be shared between threads, pickled, and used after a fork.

    Args:
        url: of a folder: https://, s3://, or any other that fsspec opens; for the Hub see `HubStore`.
        patience: see there.
    """

    def __init__(self, url: str, patience: RetryPolicy | None = None) -> None:
        self.url = url.rstrip("/")
        self.patience = patience or RetryPolicy()
        self._traffic = Traffic()
        self._lock = threading.Lock()

    def __getstate__(self) -> tuple[str, RetryPolicy]:
        return self.url, self.patience

    def __setstate__(self, state: tuple[str, RetryPolicy]) -> None:
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
            OfflineError: if nothing may be asked.
        """
        self._check_online(name)
        return self.patiently(name, lambda: self._range(name, start, stop))

    def size(self, name: str) -> int:
        """Of a file, in bytes.

        Raises:
            RemoteError, OfflineError: the same.
        """
        self._check_online(name)
        return self.patiently(name, lambda: self._size(name))

    def _check_online(self, name: str) -> None:
        if offline():
            raise OfflineError(f"{self.url}: offline, and not here, or not all of it: {name}; go online to fetch it")

    def _size(self, name: str) -> int:
        size = self._files.info(f"{self.url}/{name}")["size"]
        if size is None:
            raise WrongLengthError("the server does not say how long the file is")
        return int(size)

    def _range(self, name: str, start: int, stop: int) -> bytes:
        return self._counted(name, start, stop, self._files.cat_file(f"{self.url}/{name}", start=start, end=stop))

    def _counted(self, name: str, start: int, stop: int, data: bytes) -> bytes:
        """What a request has given, if it is what was asked for, or a whole file."""
        with self._lock:
            self._traffic.requests += 1
            self._traffic.bytes += len(data)
        if len(data) != stop - start:
            if len(data) < stop or len(data) != self._size(name):
                raise WrongLengthError(f"asked for bytes {start}..{stop}, got {len(data)} bytes")
            data = data[start:stop]  # a server without ranges
        return data

    @property
    def _opens(self) -> str:
        """An address of the kind that the file system is for."""
        return self.url

    @property
    def _files(self) -> Any:
        """The fsspec file system: one a process, since connections do not survive a fork."""
        if self._opened[0] != os.getpid():
            del self._opened
        return self._opened[1]

    @cached_property
    def _opened(self) -> tuple[int, Any]:
        import fsspec

        url = self._opens
        scheme = url.partition("://")[0]
        options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
        if scheme in ("http", "https"):
            import aiohttp

            timeout = aiohttp.ClientTimeout(total=_TOTAL, sock_connect=_TIMEOUT, sock_read=_TIMEOUT)
            options["client_kwargs"] = {"timeout": timeout, "response_class": _bounded_response()}
        elif scheme == "s3":
            once = {"total_max_attempts": 1}  # `RetryPolicy` is enough
            options["config_kwargs"] = {"connect_timeout": _TIMEOUT, "read_timeout": _TIMEOUT, "retries": once}
        try:
            files = fsspec.url_to_fs(url, **options)[0]
        except ImportError as error:
            extra = {"s3": "s3"}.get(scheme)
            remedy = f"`pip install 'icrl4aht-data[{extra}]'`" if extra else "install what fsspec needs for it"
            raise OptionError(f"{self.url}: {error}; {remedy}") from error
        except ValueError as error:
            expected = "hf://datasets/<org>/<repo>, https://... or s3://..."
            raise OptionError(f"{self.url}: not an address that fsspec opens: {error}; expected {expected}") from error
        if scheme == "s3":
            files.retries = 1  # as above
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
            before_sleep=lambda state: self._say(name, state),
            reraise=True,
        )
        try:
            return retrying(ask)
        except (Icrl4ahtError, MemoryError):
            raise
        except Exception as error:  # every file system has errors of its own
            if _is_of_disk(error):
                raise
            if not isinstance(_cause(error), FileNotFoundError) and _status(error) != 404:
                tried = f" ({self.patience.attempts} attempts)" if _passes(error) else ""
                what = f"{_in_words(_cause(error))}{tried}"
                raise RemoteError(f"{self.url}/{name}: {what}; what has arrived is kept: try again to go on") from error
            raise RemoteError(f"{self.url}/{name}: the remote has no such file", missing=True) from error

    def _say(self, name: str, state: Any) -> None:
        """What is waited for, where the wait is long enough to wonder."""
        seconds = state.next_action.sleep
        if seconds >= _LONG_WAIT:
            what = _in_words(_cause(state.outcome.exception()))
            _log.warning("%s/%s: %s; trying again in %.0f s", self.url, name, what, seconds)

    def _wait(self, state: Any) -> float:
        error = state.outcome.exception()
        doubled = self.patience.first * 2 ** (state.attempt_number - 1)
        return min(max(doubled, _retry_after(error)), self.patience.longest)


class HubStore(Store):
    """Files of a dataset repository of the Hub at one commit.

    The Hub answers for a large file with the place where it lies; that is asked for once and then read by ranges, which
    is one request each.

    Args:
        repo: <org>/<repo>.
        commit: all 40 digits.
        patience: see `RetryPolicy`.
    """

    def __init__(self, repo: str, commit: str, patience: RetryPolicy | None = None) -> None:
        super().__init__(f"hf://datasets/{repo}@{commit}", patience)
        self._repo, self._commit = repo, commit
        self._places: dict[str, Any] = {}

    def __getstate__(self) -> tuple:
        return self._repo, self._commit, self.patience

    def __setstate__(self, state: tuple) -> None:
        self.__init__(*state)

    @property
    def _opens(self) -> str:
        return "https://"

    def _place(self, name: str) -> Any:
        """The Hub's metadata of a file: `location` and `size`."""
        from huggingface_hub import get_hf_file_metadata, hf_hub_url

        if name not in self._places:
            url = hf_hub_url(self._repo, name, repo_type="dataset", revision=self._commit)
            self._places[name] = get_hf_file_metadata(url)
        return self._places[name]

    def _size(self, name: str) -> int:
        size = self._place(name).size
        if size is None:
            raise WrongLengthError("the Hub does not say how long the file is")
        return int(size)

    def _range(self, name: str, start: int, stop: int) -> bytes:
        from huggingface_hub import constants
        from huggingface_hub.utils import build_hf_headers

        place = self._place(name).location
        of_hub = urlsplit(place).netloc == urlsplit(constants.ENDPOINT).netloc
        headers = build_hf_headers() if of_hub else {}  # the token is nobody else's business
        try:
            data = self._files.cat_file(place, start=start, end=stop, headers=headers)
        except Exception as error:
            if _status(error) in (401, 403, 404, 410) and not of_hub:  # the place is lent for a while
                self._places.pop(name, None)
                raise ConnectionError(f"{name}: its place at the Hub has changed") from None
            raise
        return self._counted(name, start, stop, data)


def _bounded_response() -> type:
    """aiohttp's response, but that it takes no longer body than was asked for: a hostile server's has no end."""
    from aiohttp import ClientResponse

    class BoundedResponse(ClientResponse):
        async def read(self) -> bytes:
            if self._body is None:
                asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.request_info.headers.get("Range", ""))
                most = int(asked[2]) - int(asked[1]) + 1 if asked and self.status == 206 else _WHOLE
                body = bytearray()
                async for part in self.content.iter_any():
                    body += part
                    if len(body) > most:
                        self.close()
                        raise WrongLengthError(f"expected at most {most:,} bytes, and more came")
                self._body = bytes(body)
            return self._body

    return BoundedResponse


def _passes(error: BaseException) -> bool:
    """Whether the same request may succeed a moment later."""
    status = _status(error)
    if status is not None:
        return status in _PASSING
    return isinstance(error, Exception) and not isinstance(_cause(error), _LASTING) and not _is_of_disk(error)


def _cause(error: BaseException) -> BaseException:
    """What is behind a FileNotFoundError: fsspec makes one of any failure to learn a file's size."""
    while isinstance(error, FileNotFoundError) and error.__cause__ is not None:
        error = error.__cause__
    return error


def _is_of_disk(error: BaseException) -> bool:
    """Whether this machine's disk refused to take what came."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def _answers(error: BaseException | None) -> Iterator[tuple[Any, Any]]:
    """(HTTP status, headers) in an error of aiohttp, httpx or botocore, and in what caused it; None for neither."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            answer = response.get("ResponseMetadata", {})
            yield answer.get("HTTPStatusCode"), answer.get("HTTPHeaders")
        else:
            yield (
                getattr(error, "status", None) or getattr(response, "status_code", None),
                getattr(error, "headers", None) or getattr(response, "headers", None),
            )
        error = error.__cause__


def _status(error: BaseException | None) -> int | None:
    """The status that the server answered with, if it did."""
    return next((status for status, _ in _answers(error) if isinstance(status, int)), None)


def _retry_after(error: BaseException | None) -> float:
    """Seconds that a server asked to wait; 0 if it did not."""
    for _, headers in _answers(error):
        for name, value in dict(headers or {}).items():
            if str(name).lower() == "retry-after":
                return _seconds(value)
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
