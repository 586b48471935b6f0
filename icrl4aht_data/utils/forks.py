"""Locks and cached properties that keep working in a forked child, whatever the threads of its parent were doing."""

from __future__ import annotations

import functools
import os
import threading
import weakref
from contextlib import nullcontext
from typing import Any, TypeVar

T = TypeVar("T")

_locks: weakref.WeakSet[ForkSafeLock] = weakref.WeakSet()


class ForkSafeLock:
    """A lock for `with` blocks that is free in a forked child.

    A thread of the parent that held it does not exist in the child, where nobody would ever release the lock. What it
    guards must be valid at every moment: assigned in one step, or a cache.
    """

    def __init__(self) -> None:
        self.renew()
        _locks.add(self)

    def renew(self) -> None:
        """Replace the lock by a free one."""
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class cached_property(functools.cached_property[T]):
    """`functools.cached_property` as it is from Python 3.12 on: without a lock, which a fork could leave locked."""

    def __init__(self, func: Any) -> None:
        super().__init__(func)
        self.lock = nullcontext()  # that of Python 3.11, one for all instances


def _renew_locks() -> None:
    for lock in _locks:
        lock.renew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_locks)
