"""One pool of threads for decoding and rendering, whose inner loops release the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_pool: ThreadPoolExecutor | None = None


def usable_cores() -> int:
    """Number of cores that this process may run on."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # the system has no affinities
        return os.cpu_count() or 1


def in_slices(work: Callable[[int, int], None], n: int, threads: int, least: int = 1) -> None:
    """Call `work(start, stop)` for slices that cover 0..n, on up to `threads` threads.

    The caller's thread works too. If slices raise, one of the errors is raised here after all slices have ended.

    Args:
        work: handles the range from `start` to `stop`.
        n: length of the complete range.
        threads: at most this many slices.
        least: shortest slice that is worth a thread.
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


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_forget_pool)
