"""Arrays built once and kept in the cache folder as plain .npy files, shared by processes, bounded in size.

A set of arrays is a folder with the name of its key. Its list of contents has a hash of every file and of itself; a set
is compared with it when it is opened (see `remembered` for when files are read again), and built again if anything
differs. All its files are on the disk before it gets its name.
"""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from filelock import Timeout

from icrl4aht_data.errors import CacheError, Icrl4ahtError, OptionError
from icrl4aht_data.utils.files import NO_ROOM, add_filename, allocate, process_lock, sync
from icrl4aht_data.utils.remembered import read_checked_json, remembered_block_hashes, write_checked_json
from icrl4aht_data.utils.system import CACHE_VARIABLES, cache_folder, cache_limit

_CONTENTS = "contents.json"
_KEY = re.compile(r"[a-z]+(-\d+)?-[0-9a-f]{32,64}")  # nothing else in the cache folder is removed to make room

Arrays = dict[str, np.ndarray]


def cache_room() -> int:
    """Bytes that one more set of arrays may take: what the limit and the disk allow; 0 if the folder is read-only."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # permissions alone do not say whether it can be written
            pass
        reusable = sum(size for _, size in _cached_sets(folder))
        return min(cache_limit(), shutil.disk_usage(folder).free + reusable)
    except OSError:
        return 0


def cached_arrays(key: str, size: int, build: Callable[[Path], None]) -> Arrays:
    """The arrays of a key, memory-mapped read-only, built first if they are not cached or damaged.

    If two processes need the same arrays, one builds them and the other waits. Sets that were not used for longest are
    removed while the folder would exceed its limit, or the disk is full; processes that have them mapped can still read
    them.

    Args:
        key: identifies the content; a file name that matches `<letters>-<number>-<hash>`, the number may be left out.
        size: approximate size of the arrays in bytes.
        build: called with a new folder, into which it writes `<name>.npy` files.

    Raises:
        OptionError: if the arrays alone exceed the limit.
        CacheError: if the folder cannot be written, or the disk has no room; nothing is left there.
    """
    assert _KEY.fullmatch(key), key
    folder = cache_folder() / key
    arrays = _open(folder)
    if arrays is not None:
        return arrays
    if size > cache_limit():
        raise OptionError(
            f"{folder.parent}: the arrays have {size:,} bytes, the cache may hold {cache_limit():,}: raise "
            f'ICRL4AHT_CACHE_BYTES, select fewer histories, or take cache="stream"'
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with process_lock(folder.with_name(f".{key}.lock")):
            arrays = _open(folder)
            if arrays is None:
                _make_room(folder.parent, size)
                _build(folder, build)
                arrays = _open(folder)
    except Icrl4ahtError:
        raise
    except OSError as error:
        raise _unusable(folder.parent, size, error) from error
    if arrays is None:
        raise CacheError(f"{folder}: arrays just written were read back with other bytes: check the disk")
    return arrays


def new_mapped_array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    """A writable array of zeros in a new .npy file, whose space on the disk is allocated.

    Raises:
        OSError: if the disk is full or not writable; names the file.
    """
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with add_filename(path), path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        allocate(stream, stream.tell() + math.prod(shape) * dtype.itemsize)
    return np.lib.format.open_memmap(path, mode="r+")


def _open(folder: Path) -> Arrays | None:
    """The arrays of a finished folder, which is marked as used; None if there are none, or anything is damaged."""
    contents = read_checked_json(folder / _CONTENTS)
    if contents is None or contents.get("key") != folder.name:
        return None
    try:
        if remembered_block_hashes(folder, list(contents["files"])) != contents["files"]:
            return None
        arrays = {
            name.removesuffix(".npy"): np.asarray(np.lib.format.open_memmap(folder / name, mode="r"))
            for name in contents["files"]
        }
    except (OSError, ValueError):  # removed or replaced meanwhile
        return None
    with suppress(OSError):  # another user's folder, or removed meanwhile: the mapping stays valid
        os.utime(folder)
    return arrays


def _build(folder: Path, build: Callable[[Path], None]) -> None:
    """Build a set of arrays, which replaces whatever has its name."""
    partial, removed = (folder.with_name(f".{folder.name}.{end}") for end in ("partial", f"removed-{os.getpid()}"))
    _remove(partial)
    partial.mkdir()
    try:
        build(partial)
        files = sorted(partial.glob("*.npy"))
        for path in files:
            sync(path)
        hashes = remembered_block_hashes(partial, [path.name for path in files])
        write_checked_json(partial / _CONTENTS, {"key": folder.name, "files": hashes})
        sync(partial / _CONTENTS)
        sync(partial)
        if os.path.lexists(folder):
            folder.rename(removed)
        partial.rename(folder)
        sync(folder.parent)
    finally:
        _remove(partial)
        _remove(removed)


def _unusable(folder: Path, size: int, error: OSError) -> CacheError:
    """The error for arrays that cannot be written to the cache folder."""
    if error.errno in NO_ROOM:
        free = ""
        with suppress(OSError):
            free = f", {shutil.disk_usage(folder).free:,} bytes are free"
        reason = f"has no room for arrays of {size:,} bytes ({error.strerror}{free}); free some space there"
    elif os.path.lexists(folder) and not folder.is_dir():
        reason = "is a file, expected a folder; move it away"
    else:
        where = f" ({error.filename})" if error.filename not in (None, str(folder)) else ""
        reason = f"cannot be used: {error.strerror or error}{where}; check its permissions and content"
    return CacheError(
        f"{folder}: the cache folder {reason}, set {CACHE_VARIABLES[0]} to another folder, or "
        f'take cache="ram" or cache="stream"'
    )


def _remove(path: Path) -> None:
    """Remove a file, a link or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _cached_sets(folder: Path) -> list[tuple[Path, int]]:
    """Finished sets and their bytes, the least recently used first. Other processes may remove sets meanwhile."""
    found = []
    for path in folder.iterdir():
        if _KEY.fullmatch(path.name) and path.is_dir():
            with suppress(OSError):  # removed meanwhile, or damaged: then it is no finished set
                size = sum(file.stat().st_size for file in path.glob("*.npy"))
                found.append((path.stat().st_mtime_ns, path, size))
    return [(path, size) for _, path, size in sorted(found)]


def _make_room(folder: Path, size: int) -> None:
    """Remove leftovers of killed processes, then the least recently used sets until `size` more bytes fit.

    Raises:
        OSError: if the disk has no room for them even without those sets.
    """
    with process_lock(folder / ".room.lock"):
        for left in folder.glob(".*.partial"):
            with suppress(Timeout), process_lock(left.with_suffix(".lock"), wait=False):  # held while a set is built
                _remove(left)
        for left in folder.glob(".*.removed-*"):
            _remove(left)
        found, free = _cached_sets(folder), shutil.disk_usage(folder).free
        total = sum(bytes_ for _, bytes_ in found)
        if size > free + total:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        excess = max(total + size - cache_limit(), size - free)
        for path, bytes_ in found:
            if excess <= 0:
                return
            removed = path.with_name(f".{path.name}.removed-{os.getpid()}")
            try:
                path.rename(removed)  # atomic, so that no process opens half of a set
            except FileNotFoundError:
                continue
            _remove(removed)
            excess -= bytes_
