"""Clients for remote releases (Hugging Face Hub, fsspec) with retries, timeouts and hidden credentials."""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from icrl4aht_data.errors import Icrl4ahtError, OptionError, RemoteError
from icrl4aht_data.utils.files import NO_ROOM
from icrl4aht_data.utils.install_hints import install_command

T = TypeVar("T")

Advance = Callable[[int], None]
"""Progress callback: called with the number of bytes received since the last call."""

THREADS = 8
"""Number of files fetched in parallel."""

_TIMEOUT = 15.0  # maximum seconds to connect, and to wait for the next bytes of a response
_WAITS = (1.0, 2.0, 4.0)  # seconds before a request is repeated after a transient error
_TRANSIENT_STATUS = (408, 429)  # HTTP statuses to retry, besides 500 and above
_PERMANENT = (FileNotFoundError, PermissionError, ImportError, NotImplementedError, TypeError, ValueError)
_ADDRESS = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*://)(?:[^/\s'\"<>]*@)?(?P<rest>[^\s?#'\"<>]*)[^\s'\"<>]*")


def offline_switches() -> list[str]:
    """Return the names of the environment variables that currently disable network access."""
    names = ("HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE")
    return [name for name in names if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]


def without_credentials(text: str) -> str:
    """Return a text without the user names, passwords, queries and fragments of its URLs."""
    return _ADDRESS.sub(r"\g<scheme>\g<rest>", text)


def check_credentials(address: str) -> None:
    """Check that a password in an address has no unencoded "/": messages would show the part after the "/" as a path.

    Raises:
        OptionError: if a password may contain an unencoded "/"; the message omits the address.
    """
    try:
        parts = urlsplit(address)
        # "s3://user:12/3@host" would be parsed as host "user", port 12. Unlike a user name, a host usually has a dot.
        is_clear = parts.port is None or "@" in parts.netloc or "@" not in parts.path or "." in parts.netloc
    except ValueError:  # the port is not a number
        is_clear = False
    if not is_clear:
        raise OptionError(
            "an address (not shown, since it may contain a password): expected SCHEME://HOST:PORT/PATH or "
            "SCHEME://USER:PASSWORD@HOST/PATH; percent-encode the user name and password, for example / as %2F"
        )


class HubClient:
    """Client for a dataset repository of the Hugging Face Hub; huggingface_hub handles retries and the token.

    Args:
        repo: <org>/<repo>.
        revision: branch, tag or commit.
    """

    def __init__(self, repo: str, revision: str) -> None:
        self.repo, self.revision = repo, revision

    @contextmanager
    def connect(self) -> Iterator[None]:
        """Return a context manager that limits the wait for a response, over all retries, to `_TIMEOUT` seconds.

        Two hooks set this limit. Without a limit, huggingface_hub waits forever for some responses, and five times 60 s
        for others.
        """
        from huggingface_hub import get_session

        unanswered: dict[str, float] = {}

        def before_request(request: Any) -> None:
            # The wait is timed per address, because a server may answer only some addresses. It is also timed per host,
            # because one call of the client may request several addresses of a host.
            now, keys = time.monotonic(), (str(request.url), request.url.host)
            first = min(unanswered.setdefault(key, now) for key in keys)
            left = first + _TIMEOUT - now
            if left < 0.1 * _TIMEOUT:
                raise TimeoutError(f"no answer for {_TIMEOUT:g} s")
            # A shorter limit set by the client is kept, since the client gives up early on optional requests.
            given = request.extensions.get("timeout") or {}
            limits = {name: given.get(name) for name in ("connect", "read", "write", "pool")}
            request.extensions["timeout"] = {
                name: left if limit is None else min(left, limit) for name, limit in limits.items()
            }

        def after_response(response: Any) -> None:
            unanswered.pop(str(response.request.url), None)
            unanswered.pop(response.request.url.host, None)

        hooks = get_session().event_hooks
        hooks["request"].append(before_request)
        hooks["response"].append(after_response)
        try:
            yield
        finally:
            hooks["request"].remove(before_request)
            hooks["response"].remove(after_response)

    def get(self, name: str, scratch: Path | None, count: Advance) -> Path:
        """Download a file to the folder `scratch`, or to the Hub's cache if `scratch` is None, and return the path."""
        from huggingface_hub import hf_hub_download
        from huggingface_hub.utils import tqdm

        class HiddenBar(tqdm):
            """Progress bar that shows nothing and reports received bytes to `count`."""

            def __init__(self, *args: Any, **options: Any) -> None:
                super().__init__(*args, **options | {"disable": True})

            def update(self, n: float | None = 1) -> bool | None:
                count(int(n or 0))
                return super().update(n)

        options: dict[str, Any] = {"repo_type": "dataset", "revision": self.revision, "local_dir": scratch}
        is_offline = bool(offline_switches())
        return Path(hf_hub_download(self.repo, name, **options, local_files_only=is_offline, tqdm_class=HiddenBar))

    def sizes(self, names: list[str]) -> list[int | None]:
        """Return the sizes of files in bytes; None if the server does not report a size.

        Raises:
            FileNotFoundError: if the repository does not have a file.
        """
        from huggingface_hub import HfApi

        info = HfApi().dataset_info(self.repo, revision=self.revision, files_metadata=True, timeout=_TIMEOUT)
        known = {file.rfilename: file.size for file in info.siblings or ()}
        if absent := [name for name in names if name not in known]:
            raise FileNotFoundError(", ".join(absent[:3]))
        return [known[name] for name in names]


class FsspecClient:
    """Client for the files of a folder at an https://, s3:// or other address that fsspec opens.

    Args:
        address: the folder's address; may have a user name and password, or a query, which is sent with every request.
    """

    def __init__(self, address: str) -> None:
        self._address, self._files = address, None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._address,)

    @contextmanager
    def connect(self) -> Iterator[None]:
        """Return a context manager that opens a new file system object, since connections do not survive a fork."""
        self._files = _open_filesystem(self._address)
        yield

    def get(self, name: str, scratch: Path | None, count: Advance) -> Path:
        """Download a file to the folder `scratch` and return the path."""
        from fsspec.callbacks import Callback

        assert self._files is not None and scratch is not None

        class Counter(Callback):
            """fsspec callback that reports received bytes to `count`."""

            def relative_update(self, inc: int = 1) -> None:
                count(inc)

        path = scratch / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._files.get_file(self._file_address(name), str(path), callback=Counter())
        return path

    def sizes(self, names: list[str]) -> list[int | None]:
        """Return the sizes of files in bytes; None if the server does not report a size."""
        assert self._files is not None
        return self._files.sizes(list(map(self._file_address, names)))

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
        once = {"total_max_attempts": 1}  # `with_retries` retries requests for every protocol
        options["config_kwargs"] = {"connect_timeout": _TIMEOUT, "read_timeout": _TIMEOUT, "retries": once}
    try:
        files = fsspec.url_to_fs(address, **options)[0]
    except ImportError as error:
        remedy = f"`{install_command('s3')}`" if scheme == "s3" else "install the package that fsspec names"
        raise OptionError(f"{shown}: {error}; {remedy}") from error
    except ValueError as error:
        problem = f"{shown}: not an address that fsspec opens: {without_credentials(str(error))}"
        raise OptionError(f"{problem}; expected hf://datasets/<org>/<repo>, https://... or s3://...") from None
    if scheme == "s3":
        files.retries = 1  # s3fs also retries, in addition to botocore
    return files


def with_retries(address: str, request: Callable[[], T]) -> T:
    """Return the result of a request, which is retried after transient errors.

    Raises:
        RemoteError: if the request fails; the message has the address and the client's error.
        OSError: if the local disk is full or not writable.
    """
    for wait in (*_WAITS, None):
        try:
            return request()
        except Icrl4ahtError:
            raise
        except Exception as error:  # each client library has its own error classes
            if isinstance(error, OSError) and error.errno in (*NO_ROOM, errno.EROFS):
                raise
            status, cause = _http_status(error), _root_cause(error)
            # Timeouts are not retried, since the user has already waited for the server.
            is_transient = not isinstance(cause, _PERMANENT) and "Timeout" not in type(cause).__name__
            if status is not None:
                is_transient = status in _TRANSIENT_STATUS or status >= 500
            # huggingface_hub raises LocalEntryNotFoundError after its own retries.
            if wait is None or not is_transient or type(error).__name__ == "LocalEntryNotFoundError":
                # Some timeout errors have no message.
                said = str(cause) or (
                    f"no answer for {_TIMEOUT:g} s" if isinstance(cause, TimeoutError) else "no reason given"
                )
                text = without_credentials(" ".join(f"{type(cause).__name__}: {said}".split()))[:400]
                if isinstance(cause, FileNotFoundError) or status == 404:
                    raise RemoteError(f"{address}: the remote has no such file: {text}", missing=True) from None
                remedy = "repeat the command, which does not download complete files again"
                raise RemoteError(f"{address}: {text}; {remedy}") from None
        time.sleep(wait)
    raise AssertionError


def _root_cause(error: BaseException) -> BaseException:
    """Return the cause of a FileNotFoundError: clients raise this error if any request for a file's size fails."""
    while isinstance(error, FileNotFoundError) and error.__cause__ is not None:
        error = error.__cause__
    return error


def _http_status(error: BaseException | None) -> int | None:
    """Return the HTTP status in an error of aiohttp or httpx, or in its cause; None if no response arrived."""
    if error is None:
        return None
    status = getattr(getattr(error, "response", None), "status_code", getattr(error, "status", None))
    return status if isinstance(status, int) else _http_status(error.__cause__)
