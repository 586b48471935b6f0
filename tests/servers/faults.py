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

    Rules see method, path, target, headers and began only, because the answer is not known yet.

    Args:
        method: GET, HEAD, ...
        path: decoded and without the query.
        start: first byte of the requested range; None without a Range header that the body can satisfy.
        stop: end of the requested range, exclusive.
        status: of the answer.
        sent: bytes of the body that were written to the socket.
        target: path and query as the client sent them.
        headers: of the request.
        began: time.monotonic() at its arrival.
    """

    method: str
    path: str
    start: int | None = None
    stop: int | None = None
    status: int = 0
    sent: int = 0
    target: str = ""
    headers: Message = field(default_factory=Message, repr=False)
    began: float = 0.0


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
    """A body of the right length, with `bits` of the byte at `position` inverted; negative ones count from the end."""

    position: int = 0
    bits: int = 0xFF


@dataclass(frozen=True)
class Redirect:
    """A redirect to another path of this server, or to a URL."""

    to: str
    code: int = 302


Fault = Cut | Status | Slow | Short | Long | Flip | Redirect
Rule = Callable[[Request], Fault | None]


class Faults:
    """Rules in order: the first that returns a fault decides what goes wrong with a request. Thread safe.

    `path` is a pattern of fnmatch (`*` crosses `/`); `method` None is any method.
    """

    def __init__(self, *rules: Rule) -> None:
        self._lock = threading.Lock()
        self._rules = list(rules)

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
            if left == 0 or not _matches(request, path, method):
                return None
            left -= 1
            return fault

        self.add(rule)

    def every(self, k: int, fault: Fault, path: str = "*", method: str | None = "GET") -> None:
        """Add a fault of the k-th request that matches, the 2k-th, and so on."""
        seen = 0

        def rule(request: Request) -> Fault | None:
            nonlocal seen
            if not _matches(request, path, method):
                return None
            seen += 1
            return fault if seen % k == 0 else None

        self.add(rule)

    def clear(self) -> None:
        """Remove all rules."""
        with self._lock:
            self._rules.clear()


def _matches(request: Request, path: str, method: str | None) -> bool:
    return (method is None or request.method == method) and fnmatchcase(request.path, path)
