"""Free memory, and arrays that are allocated only if they fit into it."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
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
