"""TODO."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from icrl4aht_data.errors import OptionError

_PLENTY = 2**29  # bytes that need no look at what is free


def new_array(shape: tuple[int, ...], dtype: DTypeLike, what: str) -> np.ndarray:
    """np.empty, if the memory is there.

    Raises:
        OptionError: says what is too large.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < _PLENTY or size <= free_memory():
        with suppress(MemoryError):
            return np.empty(shape, dtype)
    raise OptionError(f"{what}: takes {size / 1e9:.3g} GB of memory, more than is free: read fewer steps at a time")


def free_memory() -> int:
    """Bytes of memory that this process may still take: of the machine, and of its control group if that has less."""
    free = []
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError):
        pass
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            free.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # no such group, or "max"
            continue
    if free:
        return max(0, min(free))
    try:  # no Linux: half of the machine's memory
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, ValueError, OSError):
        return 4 * 2**30
