"""One pool of threads for decoding and rendering, whose inner loops run without the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_pool: ThreadPoolExecutor | None = None


def usable_cores() -> int:
    """Cores that this process may run on."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def in_slices(work: Callable[[int, int], None], n: int, threads: int, least: int = 1) -> None:
    """Call `work(start, stop)` for slices that cover 0..n, on up to `threads` threads, none shorter than `least`.

    The caller's thread does its share. An exception of any slice reaches the caller, after all have ended.
    """
    parts = max(1, min(threads, n // max(least, 1)))
    edges = [n * part // parts for part in range(parts + 1)]
    futures = [_get_pool().submit(work, edges[k], edges[k + 1]) for k in range(1, parts)]
    try:
        work(edges[0], edges[1])
    finally:
        errors = [future.exception() for future in futures]
    for error in errors:
        if error is not None:
            raise error


def _get_pool() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max_workers=2 * usable_cores(), thread_name_prefix="icrl4aht")
    return _pool


def _forget() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # a child process has none of its parent's threads
    os.register_at_fork(after_in_child=_forget)
