"""Context managers that limit time, memory, file size, disk size or permissions."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

PAGE = 4096


class HungError(Exception):
    """Error raised in a block that exceeds its time limit; not an OSError, because tested code might catch OSErrors."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise HungError if a block takes longer than `seconds`."""

    def raise_hung_error(*_: Any) -> None:
        raise HungError(f"not done after {seconds} s")

    handler = signal.signal(signal.SIGALRM, raise_hung_error)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)


@contextmanager
def _resource_limit(kind: int, value: int) -> Iterator[Callable[[], None]]:
    before = resource.getrlimit(kind)
    remove = partial(resource.setrlimit, kind, before)
    resource.setrlimit(kind, (value, before[1]))
    try:
        yield remove
    finally:
        remove()


def memory_limit(size: int) -> AbstractContextManager[object]:
    """Allow this process at most `size` more bytes of address space; allocations beyond this limit fail."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    return _resource_limit(resource.RLIMIT_AS, used + size)


def file_size_limit(size: int) -> AbstractContextManager[Callable[[], None]]:
    """Limit each file written by this process to `size` bytes; yield a function that removes the limit."""
    return _resource_limit(resource.RLIMIT_FSIZE, size)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[], None]]:
    """Mount a disk of `size` bytes at a folder; yield a function that enlarges the disk."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount(folder, f"size={size}")
    try:
        yield lambda: _mount(folder, "remount,size=64m")
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)  # files on this disk may still be mapped


def _mount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True, capture_output=True)


@cache
def can_mount() -> bool:
    """Return whether this user may mount disks."""
    try:
        with TemporaryDirectory() as folder, small_disk(Path(folder), PAGE):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


_CAPABILITIES = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, which let a process bypass file permissions
_VERSION = 0x20080522  # _LINUX_CAPABILITY_VERSION_3, an argument of capget and capset


@contextmanager
def enforced_permissions() -> Iterator[None]:
    """Enforce file permissions in this thread, even for root."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, before, reduced = (ctypes.c_uint32 * 2)(_VERSION, 0), (ctypes.c_uint32 * 6)(), (ctypes.c_uint32 * 6)()
    if libc.capget(header, before):
        raise OSError(ctypes.get_errno(), "capget")
    reduced[:] = list(before)
    reduced[0] &= ~_CAPABILITIES  # index 0 is the lower half of the effective capabilities
    if libc.capset(header, reduced):
        raise OSError(ctypes.get_errno(), "capset")
    try:
        yield
    finally:
        libc.capset(header, before)
