"""Faults of a test server, and rules for when they happen."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from email.message import Message
from fnmatch import fnmatchcase


@dataclass
class Request:
    """One request in a server's log. All but `sent` is logged before the first byte of the answer is sent.

    Rules see neither `status` nor `sent`, because the answer is not known yet.

    Args:
        method: GET, HEAD, ...
        path: decoded and without the query.
        target: path and query as the client sent them.
        headers: headers of the request.
        status: status of the answer.
        sent: bytes of the body that were written to the socket.
    """

    method: str
    path: str
    target: str
    headers: Message = field(repr=False)
    status: int = 0
    sent: int = 0


@dataclass(frozen=True)
class Cut:
    """Correct headers and `after` bytes of the body, then a closed socket."""

    after: int = 0


@dataclass(frozen=True)
class Status:
    """Another status, with a line of text as the body."""

    code: int
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Slow:
    """A wait of `delay` seconds before the answer, then at most `bytes_per_second`."""

    delay: float = 0.0
    bytes_per_second: float | None = None


@dataclass(frozen=True)
class Short:
    """`by` bytes less than requested, in headers that agree with one another."""

    by: int = 1


@dataclass(frozen=True)
class Long:
    """`by` bytes more than requested, in headers that agree with one another; zeros past the end of the file."""

    by: int = 1


@dataclass(frozen=True)
class Flip:
    """A body of the right length, with the bits of the byte at `position` inverted."""

    position: int = 0


@dataclass(frozen=True)
class Redirect:
    """A redirect to another path of this server, or to a URL."""

    to: str


Fault = Cut | Status | Slow | Short | Long | Flip | Redirect
Rule = Callable[[Request], Fault | None]


class Faults:
    """Rules in order: the first that returns a fault decides what goes wrong with a request. Thread safe.

    `path` is a pattern of fnmatch (`*` crosses `/`); `method` None is any method.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rules: list[Rule] = []

    def __call__(self, request: Request) -> Fault | None:
        with self._lock:
            return next((fault for rule in self._rules if (fault := rule(request)) is not None), None)

    def add(self, rule: Rule) -> None:
        """Add a rule of the caller's own. Rules are called under a lock, so they may count."""
        with self._lock:
            self._rules.append(rule)

    def next(self, fault: Fault, times: int = 1, path: str = "*", method: str | None = "GET") -> None:
        """Add a fault of the next `times` requests that match."""
        left = times

        def rule(request: Request) -> Fault | None:
            nonlocal left
            if left == 0 or method not in (None, request.method) or not fnmatchcase(request.path, path):
                return None
            left -= 1
            return fault

        self.add(rule)

    def clear(self) -> None:
        """Remove all rules."""
        with self._lock:
            self._rules.clear()
