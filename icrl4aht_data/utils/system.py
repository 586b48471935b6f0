"""Amount of free memory, reuse of memory, a pool of threads, and the folders for cached arrays and fetched releases.

The cache folder is $ICRL4AHT_CACHE_DIR, else the user's cache folder (`platformdirs`); its size limit is
$ICRL4AHT_CACHE_BYTES (100 GB by default). Release folders are not used as caches: they contain only files of the
manifest, and are often read-only. Deleting the cache folder is always safe.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import platformdirs
from numpy.typing import DTypeLike

from icrl4aht_data.errors import OptionError

_KEEP_FREED_MEMORY = {-8: 1, -4: 0, -1: 2**31 - 1}
"""Options of `mallopt` and values: M_ARENA_MAX, M_MMAP_MAX and M_TRIM_THRESHOLD, see <malloc.h>."""

_PLENTY = 2**29  # bytes; smaller arrays are allocated without a check
_CGROUP = Path("/sys/fs/cgroup")


def new_array(shape: tuple[int, ...], dtype: DTypeLike, what: str) -> np.ndarray:
    """Return an uninitialized array, if enough memory is free.

    Raises:
        OptionError: if too little memory is free; the message has the array's name and size.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < _PLENTY or size <= free_memory():
        with suppress(MemoryError):
            return np.empty(shape, dtype)
    raise OptionError(
        f"{what}: takes {gigabytes(size)} of memory, more than is free: read fewer steps, or take a smaller batch"
    )


def gigabytes(size: int) -> str:
    """Return a number of bytes as text, in GB."""
    number = size / 1e9
    return f"{number:,.0f} GB" if number >= 100 else f"{number:.3g} GB"


def keep_freed_memory() -> None:
    """Keep freed memory in this process for later allocations, instead of returning it to the system; needs glibc.

    XLA programs on CPUs allocate memory for intermediate arrays in each call, and page faults then take up to a third
    of a training step. Call this function before other threads start.
    """
    with suppress(TypeError, OSError, AttributeError):  # the C library is not glibc
        set_option = ctypes.CDLL(None).mallopt
        for option, value in _KEEP_FREED_MEMORY.items():
            set_option(option, value)


def free_memory() -> int:
    """Return the bytes that this process can still allocate within the limits of the machine and the control group."""
    free = []
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    with suppress(OSError, ValueError):  # no control group, or no limit ("max")
        free.append(int((_CGROUP / "memory.max").read_text()) - int((_CGROUP / "memory.current").read_text()))
    if free:
        return max(0, min(free))
    try:  # on systems other than Linux, half of the machine's memory
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, ValueError, OSError):
        return 4 * 2**30


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # the system does not support CPU affinity
        return os.cpu_count() or 1


def run_in_slices(work: Callable[[int, int], None], n: int, threads: int, least: int = 1) -> None:
    """Call `work(start, stop)` on slices that cover 0..n, on up to `threads` threads including the caller's.

    If `work` raises errors, one of them is raised after all slices are finished.

    Args:
        work: function that processes the range from `start` to `stop`.
        n: length of the complete range.
        threads: maximum number of slices.
        least: minimum length of a slice.
    """
    parts = max(1, min(threads, n // max(least, 1)))
    edges = [n * part // parts for part in range(parts + 1)]
    futures = [_get_pool().submit(work, edges[k], edges[k + 1]) for k in range(1, parts)]
    try:
        work(edges[0], edges[1])
    finally:
        wait(futures)
    for future in futures:
        future.result()


@cache
def _get_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=2 * usable_cores(), thread_name_prefix="icrl4aht")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_get_pool.cache_clear)


CACHE_VARIABLE, DATA_VARIABLE = "ICRL4AHT_CACHE_DIR", "ICRL4AHT_DATA_DIR"
"""Environment variables that set the cache folder and the data folder."""


def cache_folder() -> Path:
    """Return the folder of cached arrays: $ICRL4AHT_CACHE_DIR if set, else ~/.cache/icrl4aht on Linux."""
    own = os.environ.get(CACHE_VARIABLE)
    return Path(own).expanduser() if own else platformdirs.user_cache_path("icrl4aht", appauthor=False)


def data_folder() -> Path:
    """Return the folder of fetched releases: $ICRL4AHT_DATA_DIR if set, else ~/.local/share/icrl4aht on Linux.

    Unlike in the cache folder, no file is removed automatically.
    """
    own = os.environ.get(DATA_VARIABLE)
    return Path(own).expanduser() if own else platformdirs.user_data_path("icrl4aht", appauthor=False)


def cache_limit() -> int:
    """Return the maximum size of the cache folder in bytes.

    Raises:
        OptionError: if $ICRL4AHT_CACHE_BYTES is not a number of bytes.
    """
    given = os.environ.get("ICRL4AHT_CACHE_BYTES") or "1e11"
    try:
        limit = int(float(given))
    except (ValueError, OverflowError):
        limit = -1
    if limit < 0:
        raise OptionError(f"ICRL4AHT_CACHE_BYTES={given!r}: expected a number of bytes, such as 2e11")
    return limit
