"""Byte ranges of files behind any fsspec address, with retries: transient errors are retried, others raised."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any, TypeVar
from urllib.parse import urljoin

from icrl4aht_data.errors import Icrl4ahtError, OfflineError, OptionError, RemoteError
from icrl4aht_data.remote.addresses import address_of, check_credentials, check_redirect, without_credentials
from icrl4aht_data.utils.files import NO_ROOM
from icrl4aht_data.utils.forks import ForkSafeLock
from icrl4aht_data.utils.installation import install_command

T = TypeVar("T")
_log = logging.getLogger(__name__)

_TRANSIENT_STATUS = {408, 425, 429, 500, 502, 503, 504}
_PERMANENT = (
    FileNotFoundError,
    PermissionError,
    Icrl4ahtError,
    ImportError,
    NotImplementedError,
    MemoryError,
    TypeError,
)
_PERMANENT_NAMES = {"TooManyRedirects", "InvalidURL"}  # classes of HTTP clients, which are imported when needed
_ADDRESS_LOGS = ("fsspec", "fsspec.http", "fsspec.asyn", "s3fs", "aiohttp.client")  # loggers of messages with addresses
_TIMEOUT = 30  # seconds without a byte, or until a connection
_TOTAL_TIMEOUT = 300  # seconds for one request, against a server that sends a byte now and then
_LOGGED_WAIT = 2.0  # seconds between attempts from which on the wait is logged
_UNRANGED_BYTES = 64 * 2**20  # accepted from a server that answers a range request with the complete file


@dataclass(frozen=True)
class RetryPolicy:
    """Number of attempts of a request for a byte range, and the waits between them.

    Args:
        attempts: requests in total, the first one included.
        first_wait: seconds before the second attempt; doubled before each further one. A server's Retry-After header
            makes the wait longer, never shorter.
        longest_wait: upper bound of a wait in seconds.
    """

    attempts: int = 8
    first_wait: float = 0.25
    longest_wait: float = 60.0


@dataclass
class Traffic:
    """Counts of what a remote has sent.

    Args:
        requests: requests that returned file content.
        bytes: bytes of content in their answers.
    """

    requests: int = 0
    bytes: int = 0

    def __sub__(self, before: Traffic) -> Traffic:
        return Traffic(self.requests - before.requests, self.bytes - before.bytes)


def offline() -> bool:
    """Whether network access is switched off by HF_HUB_OFFLINE or ICRL4AHT_OFFLINE; read at each call."""
    return bool(offline_switches())


def offline_switches() -> list[str]:
    """Names of the environment variables that are set and switch network access off."""
    names = ("HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE")
    return [name for name in names if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]


class WrongLengthError(OSError):
    """A server sent more or fewer bytes than the requested range has."""


class Store:
    """Files below an address. Can be shared between threads, pickled, and used after a fork.

    Args:
        url: address of a folder: https://, s3://, or any other that fsspec opens; see `HubStore` for the Hub. It may
            have a user name and a password, or a query that is sent with every request.
        retry: policy for transient errors.

    Attributes:
        url: the address without credentials, for messages and files.

    Raises:
        OptionError: if the user name or password has characters that are not percent-encoded.
    """

    def __init__(self, url: str, retry: RetryPolicy | None = None) -> None:
        check_credentials(url)
        self._address = url
        self.url = without_credentials(url).rstrip("/")
        self.retry = retry or RetryPolicy()
        self._filesystem: tuple[int, Any] = 0, None
        self._traffic = Traffic()
        self._lock = ForkSafeLock()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._address, self.retry)

    @property
    def traffic(self) -> Traffic:
        """A copy of the counts so far."""
        with self._lock:
            return Traffic(self._traffic.requests, self._traffic.bytes)

    def count(self, requests: int, size: int) -> None:
        """Add requests and the bytes they returned to `traffic`."""
        with self._lock:
            self._traffic.requests += requests
            self._traffic.bytes += size

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Fetch the bytes start..stop of a file.

        Raises:
            RemoteError: names the address and the last answer.
            OfflineError: if network access is switched off.
        """
        self._check_online(name)
        return self.with_retries(name, lambda: self._read(name, start, stop))

    def size(self, name: str) -> int:
        """Fetch the size of a file in bytes.

        Raises:
            RemoteError: names the address and the last answer.
            OfflineError: if network access is switched off.
        """
        self._check_online(name)
        return self.with_retries(name, lambda: self._size(name))

    def _check_online(self, name: str) -> None:
        if offline():
            raise OfflineError(f"{self.url}: offline, and {name} is not completely downloaded; go online to fetch it")

    def _size(self, name: str) -> int:
        size = self._files.info(address_of(self._address, name))["size"]
        if size is None:
            raise WrongLengthError("the server does not say how long the file is")
        return int(size)

    def _read(self, name: str, start: int, stop: int) -> bytes:
        data = self._files.cat_file(address_of(self._address, name), start=start, end=stop)
        return self._counted(name, start, stop, data)

    def _counted(self, name: str, start: int, stop: int, data: bytes) -> bytes:
        """The bytes start..stop in an answer, which may hold the complete file instead."""
        self.count(1, len(data))
        if len(data) != stop - start:
            if len(data) < stop or len(data) != self._size(name):
                raise WrongLengthError(f"requested bytes {start}..{stop}, got {len(data)} bytes")
            data = data[start:stop]  # a server without ranges
        return data

    @property
    def _files(self) -> Any:
        """The fsspec file system: one per process, because connections do not survive a fork."""
        if self._filesystem[0] != os.getpid():
            self._filesystem = os.getpid(), _open_filesystem(self._address)
        return self._filesystem[1]

    def with_retries(self, name: str, request: Callable[[], T]) -> T:
        """Return the result of `request`, called again after transient errors as `retry` says.

        Args:
            name: file that the error message names.
            request: raises whatever its client raises.

        Raises:
            RemoteError: names the file's address, and says whether the remote has no such file.
            OSError: if the local disk is full or not writable.
        """
        import tenacity

        address = f"{self.url}/{name}"

        def seconds_before_next(state: Any) -> float:
            doubled = self.retry.first_wait * 2 ** (state.attempt_number - 1)
            return min(max(doubled, _retry_after(state.outcome.exception())), self.retry.longest_wait)

        def log_long_wait(state: Any) -> None:
            if state.next_action.sleep >= _LOGGED_WAIT:
                what = _one_line(_root_cause(state.outcome.exception()))
                _log.warning("%s: %s; trying again in %.0f s", address, what, state.next_action.sleep)

        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception(_is_transient),
            stop=tenacity.stop_after_attempt(self.retry.attempts),
            wait=seconds_before_next,
            before_sleep=log_long_wait,
            reraise=True,
        )
        with wrap_remote_errors(address, self.retry.attempts):
            return retrying(request)


@contextmanager
def wrap_remote_errors(address: str, attempts: int = 1) -> Iterator[None]:
    """Turn whatever a client raises into an error that names the address.

    Args:
        address: the file's, or the release's.
        attempts: how often a transient error was retried before it was raised.

    Raises:
        RemoteError: from the client's error.
        OSError: unchanged, if the local disk is full or not writable.
    """
    try:
        yield
    except (Icrl4ahtError, MemoryError):
        raise
    except Exception as error:  # every file system has its own error classes
        if _is_disk_error(error):
            raise
        cause = _root_cause(error)
        # A traceback shows the client's error too, which may have the complete address.
        shown = error if without_credentials(f"{error} {cause}") == f"{error} {cause}" else None
        if isinstance(cause, Icrl4ahtError):  # of a refused redirect
            raise cause from None
        if isinstance(cause, FileNotFoundError) or http_status(error) == 404:
            raise RemoteError(f"{address}: the remote has no such file", missing=True) from shown
        tried = f" ({attempts} attempts)" if attempts > 1 and _is_transient(error) else ""
        kept = "what has arrived is kept: repeat the command to resume"
        raise RemoteError(f"{address}: {_one_line(cause)}{tried}; {kept}") from shown


def _open_filesystem(url: str) -> Any:
    import fsspec

    for name in _ADDRESS_LOGS:
        logging.getLogger(name).addFilter(_remove_credentials)  # added once, as it is the same function
    scheme = url.partition("://")[0]
    options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
    if scheme in ("http", "https"):
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=_TOTAL_TIMEOUT, sock_connect=_TIMEOUT, sock_read=_TIMEOUT)
        options["client_kwargs"] = {"timeout": timeout, "response_class": _bounded_response()}
        options["client_kwargs"]["trace_configs"] = [_redirect_guard()]
    elif scheme == "s3":
        once = {"total_max_attempts": 1}  # `RetryPolicy` alone retries
        options["config_kwargs"] = {"connect_timeout": _TIMEOUT, "read_timeout": _TIMEOUT, "retries": once}
    try:
        files = fsspec.url_to_fs(url, **options)[0]
    except ImportError as error:
        extra = {"s3": "s3"}.get(scheme)
        remedy = f"`{install_command(extra)}`" if extra else "install what fsspec needs for it"
        raise OptionError(f"{without_credentials(url)}: {error}; {remedy}") from error
    except ValueError as error:
        problem = f"{without_credentials(url)}: not an address that fsspec opens: {without_credentials(str(error))}"
        raise OptionError(f"{problem}; expected hf://datasets/<org>/<repo>, https://... or s3://...") from None
    if scheme == "s3":
        files.retries = 1  # s3fs has retries of its own besides botocore's
    return files


def _remove_credentials(record: logging.LogRecord) -> bool:
    """Filter of a logger that takes credentials out of messages; of an exception only the message is kept."""
    text = record.getMessage()
    if record.exc_info and record.exc_info[1] is not None:
        text, record.exc_info = f"{text} {_one_line(record.exc_info[1])}".strip(), None
    record.msg, record.args = without_credentials(text), ()
    return True


def _redirect_guard() -> Any:
    """Hook of aiohttp's client that raises an error before a redirect is followed which `check_redirect` refuses."""
    from aiohttp import TraceConfig

    async def check(session: Any, context: Any, redirect: Any) -> None:
        location = redirect.response.headers.get("Location") or redirect.response.headers.get("URI") or ""
        target = urljoin(str(redirect.url), location)
        try:
            await asyncio.get_running_loop().run_in_executor(None, check_redirect, str(redirect.url), target)
        except RemoteError:
            redirect.response.close()
            raise

    guard = TraceConfig()
    guard.on_request_redirect.append(check)
    return guard


def _bounded_response() -> type:
    """Subclass of aiohttp's response that stops at the requested length: a hostile server's body has no end."""
    from aiohttp import ClientResponse

    class BoundedResponse(ClientResponse):
        async def read(self) -> bytes:
            if self._body is None:
                requested = re.fullmatch(r"bytes=(\d+)-(\d+)", self.request_info.headers.get("Range", ""))
                is_range = requested is not None and self.status == 206
                limit = int(requested[2]) - int(requested[1]) + 1 if requested and is_range else _UNRANGED_BYTES
                body = bytearray()
                async for part in self.content.iter_any():
                    body += part
                    if len(body) > limit:
                        self.close()
                        raise WrongLengthError(f"expected at most {limit:,} bytes, and more came")
                self._body = bytes(body)
            return self._body

    return BoundedResponse


def _is_transient(error: BaseException) -> bool:
    """Whether the same request may succeed a moment later."""
    status = http_status(error)
    if status is not None:
        return status in _TRANSIENT_STATUS
    cause = _root_cause(error)
    if isinstance(cause, _PERMANENT) or _PERMANENT_NAMES & {known.__name__ for known in type(cause).__mro__}:
        return False
    return isinstance(error, Exception) and not _is_disk_error(error)


def _root_cause(error: BaseException) -> BaseException:
    """The error behind a FileNotFoundError: clients turn any failure to learn a file's size into one."""
    while isinstance(error, FileNotFoundError) and error.__cause__ is not None:
        error = error.__cause__
    return error


def _is_disk_error(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in (*NO_ROOM, errno.EROFS)


def _answers(error: BaseException | None) -> Iterator[tuple[Any, Any]]:
    """(HTTP status, headers) of an error of aiohttp, httpx or botocore, and of its causes; None where there is none."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):  # botocore
            answer = response.get("ResponseMetadata", {})
            yield answer.get("HTTPStatusCode"), answer.get("HTTPHeaders")
        else:
            yield (
                getattr(error, "status", None) or getattr(response, "status_code", None),
                getattr(error, "headers", None) or getattr(response, "headers", None),
            )
        error = error.__cause__


def http_status(error: BaseException | None) -> int | None:
    """HTTP status of the server's answer; None without an answer."""
    return next((status for status, _ in _answers(error) if isinstance(status, int)), None)


def _retry_after(error: BaseException | None) -> float:
    """Seconds that a Retry-After header demands, given as a number or a date; 0 without one."""
    for _, headers in _answers(error):
        for name, value in dict(headers or {}).items():
            if str(name).lower() == "retry-after":
                with suppress(ValueError):
                    return float(value)
                with suppress(ValueError):
                    return parsedate_to_datetime(value).timestamp() - time.time()
    return 0.0


def _one_line(error: BaseException) -> str:
    """The error's class and message on one line, without the library's advice in further paragraphs."""
    text = without_credentials(" ".join(str(error).split()))
    return f"{type(error).__name__}: {text[:300]}" if text else type(error).__name__
