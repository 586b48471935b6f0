"""What a test's server may do wrong, and when."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from email.message import Message
from fnmatch import fnmatchcase


@dataclass
class Request:
    """One request, as a server's log keeps it; all but sent is there before the first byte of its answer goes out.

    path is decoded and has no query, target is what the client sent; start and stop are the bytes [start, stop) asked
    for, None without a Range that the body can satisfy; sent counts the bytes of the body handed to the socket; began
    is of time.monotonic(). Rules see method, path, target, headers and began only: the answer is not known yet.
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
    """The right headers, `after` bytes of the body, then a closed socket."""

    after: int = 0


@dataclass(frozen=True)
class Status:
    """Another status, with a line of text for a body."""

    code: int
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Slow:
    """`delay` seconds before the answer, then no more than `bytes_per_second`."""

    delay: float = 0.0
    bytes_per_second: float | None = None


@dataclass(frozen=True)
class Short:
    """`by` bytes less than asked, in headers that agree with one another."""

    by: int = 1


@dataclass(frozen=True)
class Long:
    """`by` bytes more than asked, in headers that agree with one another: the file's own, zeros past its end."""

    by: int = 1


@dataclass(frozen=True)
class Flip:
    """The right length; `bits` of the byte at `position` of this body are inverted. Negative positions count from its
    end."""

    position: int = 0
    bits: int = 0xFF


@dataclass(frozen=True)
class Etag:
    """`value` is the ETag of this path from now on."""

    value: str


@dataclass(frozen=True)
class IgnoreRange:
    """200 and the whole body, whatever range was asked for."""


@dataclass(frozen=True)
class Redirect:
    """To another path of this server, or to a URL."""

    to: str
    code: int = 302


Fault = Cut | Status | Slow | Short | Long | Flip | Etag | IgnoreRange | Redirect
Rule = Callable[[Request], Fault | None]


class Faults:
    """Rules asked in their order: the first that answers decides what goes wrong with a request. Thread safe.

    path is a pattern of fnmatch (`*` crosses `/`); method None is any method.
    """

    def __init__(self, *rules: Rule) -> None:
        self._lock = threading.Lock()
        self._rules = list(rules)

    def __call__(self, request: Request) -> Fault | None:
        with self._lock:
            return next((fault for rule in self._rules if (fault := rule(request)) is not None), None)

    def add(self, rule: Rule) -> None:
        """A rule of the caller's own, asked under a lock: it may count without one."""
        with self._lock:
            self._rules.append(rule)

    def next(self, fault: Fault, times: int = 1, path: str = "*", method: str | None = "GET") -> None:
        """The next `times` requests that match."""
        left = times

        def rule(request: Request) -> Fault | None:
            nonlocal left
            if left == 0 or not _matches(request, path, method):
                return None
            left -= 1
            return fault

        self.add(rule)

    def every(self, k: int, fault: Fault, path: str = "*", method: str | None = "GET") -> None:
        """The k-th request that matches, the 2k-th, and so on; all of them where k is 1."""
        seen = 0

        def rule(request: Request) -> Fault | None:
            nonlocal seen
            if not _matches(request, path, method):
                return None
            seen += 1
            return fault if seen % k == 0 else None

        self.add(rule)

    def clear(self) -> None:
        """Nothing goes wrong any more; ETags that were changed stay."""
        with self._lock:
            self._rules.clear()


def _matches(request: Request, path: str, method: str | None) -> bool:
    return (method is None or request.method == method) and fnmatchcase(request.path, path)
