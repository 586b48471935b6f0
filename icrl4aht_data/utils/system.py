"""The machine: free memory, a pool of threads, and the folders for cached arrays and fetched releases.

The cache folder is $ICRL4AHT_CACHE_DIR, else the user's cache folder (`platformdirs`); its size limit is
$ICRL4AHT_CACHE_BYTES (100 GB by default). It is never the release folder: a release contains what its manifest lists
and nothing else, and is often read-only. Deleting the folder costs nothing but time.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs
from numpy.typing import DTypeLike

from icrl4aht_data.errors import OptionError

_PLENTY = 2**29  # bytes; smaller arrays are allocated without a check
_CGROUPS = (  # limit and use of a control group, versions 2 and 1
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def new_array(shape: tuple[int, ...], dtype: DTypeLike, what: str) -> np.ndarray:
    """An uninitialised array, if enough memory is free.

    Raises:
        OptionError: if not; names what is too large.
    """
    size = array_bytes(shape, dtype)
    if fits(size):
        with suppress(MemoryError):
            return np.empty(shape, dtype)
    raise OptionError(f"{what}: takes {gigabytes(size)} of memory, more than is free: read fewer steps at a time")


def array_bytes(shape: tuple[int, ...], dtype: DTypeLike) -> int:
    """Bytes of an array."""
    return math.prod(shape) * np.dtype(dtype).itemsize


def fits(size: int) -> bool:
    """Whether so many bytes of memory are free; a few are taken to be."""
    return size < _PLENTY or size <= free_memory()


def gigabytes(size: int) -> str:
    """Return a number of bytes as text, in GB."""
    number = size / 1e9
    return f"{number:,.0f} GB" if number >= 100 else f"{number:.3g} GB"


def free_memory() -> int:
    """Bytes that this process may still allocate on this machine, in its control group, and by its own limit."""
    free = []
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    for limit, used in _CGROUPS:
        with suppress(OSError, ValueError):  # there is no such group, or its limit is "max"
            free.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    with suppress(ImportError, OSError, ValueError):  # no such limits on this system
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            free.append(limit - pages * resource.getpagesize())
    if free:
        return max(0, min(free))
    try:  # not Linux: half of the machine's memory
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, ValueError, OSError):
        return 4 * 2**30


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


_DEFAULT_LIMIT = 100 * 10**9

CACHE_VARIABLES = ("ICRL4AHT_CACHE_DIR", "XDG_CACHE_HOME")
"""Environment variables that set the cache folder; below the second one it is called icrl4aht."""

DATA_VARIABLES = ("ICRL4AHT_DATA_DIR", "XDG_DATA_HOME")
"""Environment variables that set the data folder; below the second one it is called icrl4aht."""


def cache_folder() -> Path:
    """The folder of cached arrays, read from the environment at each call; ~/.cache/icrl4aht by default on Linux."""
    own = os.environ.get(CACHE_VARIABLES[0])
    return Path(own).expanduser() if own else platformdirs.user_cache_path("icrl4aht", appauthor=False)


def data_folder() -> Path:
    """The folder of fetched releases, read from the environment at each call; ~/.local/share/icrl4aht by default on
    Linux. It is not a cache: nothing in it is removed."""
    own = os.environ.get(DATA_VARIABLES[0])
    return Path(own).expanduser() if own else platformdirs.user_data_path("icrl4aht", appauthor=False)


def cache_limit() -> int:
    """Most bytes that the cache folder may contain.

    Raises:
        OptionError: if the environment variable is not a number of bytes.
    """
    given = os.environ.get("ICRL4AHT_CACHE_BYTES")
    if not given:
        return _DEFAULT_LIMIT
    try:
        limit = int(float(given))
    except (ValueError, OverflowError):
        limit = -1
    if limit < 0:
        raise OptionError(f"ICRL4AHT_CACHE_BYTES={given!r}: expected a number of bytes, such as 2e11")
    return limit
