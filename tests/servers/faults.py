"""Faults that a test server injects into its answers, and rules that choose which requests get a fault."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from email.message import Message
from fnmatch import fnmatchcase


@dataclass
class Request:
    """A request in a server's log, logged before the first byte of the answer is sent.

    The fields `status` and `sent` are set later, so rules for faults cannot use them.

    Args:
        method: HTTP method, such as GET or HEAD.
        path: decoded path, without the query.
        target: path and query as the client sent them.
        headers: headers of the request.
        status: HTTP status of the answer.
        sent: number of bytes of the answer's body that were written to the socket.
    """

    method: str
    path: str
    target: str
    headers: Message = field(repr=False)
    status: int = 0
    sent: int = 0


@dataclass(frozen=True)
class TruncatedBody:
    """Send correct headers and the first `after` bytes of the body, then close the connection."""

    after: int = 0


@dataclass(frozen=True)
class ErrorStatus:
    """Answer with an HTTP error status and a line of text instead of the content."""

    code: int
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SlowAnswer:
    """Wait `delay` seconds before the answer, then send at most `bytes_per_second`."""

    delay: float = 0.0
    bytes_per_second: float | None = None


@dataclass(frozen=True)
class ShortBody:
    """Send `by` bytes fewer than requested, with a matching Content-Length."""

    by: int = 1


@dataclass(frozen=True)
class LongBody:
    """Send `by` bytes more than requested, with a matching Content-Length; bytes past the file's end are zeros."""

    by: int = 1


@dataclass(frozen=True)
class FlippedByte:
    """Send a body of the right length, with the bits of the byte at `position` inverted."""

    position: int = 0


@dataclass(frozen=True)
class Redirect:
    """Redirect to another path of this server, or to a URL."""

    to: str


Fault = TruncatedBody | ErrorStatus | SlowAnswer | ShortBody | LongBody | FlippedByte | Redirect
Rule = Callable[[Request], Fault | None]


class Faults:
    """A thread-safe list of rules; a request gets the fault of the first rule that returns a fault."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rules: list[Rule] = []

    def __call__(self, request: Request) -> Fault | None:
        with self._lock:
            return next((fault for rule in self._rules if (fault := rule(request)) is not None), None)

    def add(self, rule: Rule) -> None:
        """Add a rule that returns the fault for a request, or None; calls are locked, so a rule may count requests."""
        with self._lock:
            self._rules.append(rule)

    def next(self, fault: Fault, times: int = 1, path: str = "*", method: str | None = "GET") -> None:
        """Add a fault for the next `times` requests that match `path` and `method`.

        The path is a pattern of fnmatch (`*` also matches `/`); the method None matches any method.
        """
        left = times

        def rule(request: Request) -> Fault | None:
            nonlocal left
            if left == 0 or method not in (None, request.method) or not fnmatchcase(request.path, path):
                return None
            left -= 1
            return fault

        self.add(rule)

    def clear(self) -> None:
        """Remove all rules for faults."""
        with self._lock:
            self._rules.clear()
