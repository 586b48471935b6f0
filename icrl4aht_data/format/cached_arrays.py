"""Cache of arrays as .npy files, shared by processes and limited in size.

A set of arrays is a folder whose name contains a hash of its inputs. The folder is written under a temporary name and
renamed when complete. Only sizes and headers are checked when it is read: delete the cache after a disk failure.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from icrl4aht_data.errors import CacheError, Icrl4ahtError, OptionError
from icrl4aht_data.utils.files import NO_ROOM, add_filename, allocate, describe_disk
from icrl4aht_data.utils.system import CACHE_VARIABLE, cache_folder, cache_limit

_CONTENTS = "contents.json"  # name -> [dtype, shape] of every array
_KEY = re.compile(r"[a-z]+-[0-9a-f]{32,64}")  # only folders that match are evicted
_ABANDONED = 24 * 3600  # seconds after which an unfinished set counts as left by a killed process

Arrays = dict[str, np.ndarray]


def cache_room() -> int:
    """Return the maximum size in bytes of a new set of arrays; 0 if the cache folder is not writable."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # permissions alone do not show whether a folder is writable
            pass
        reusable = sum(size for _, size in _cached_sets(folder))
        return min(cache_limit(), shutil.disk_usage(folder).free + reusable)
    except OSError:
        return 0


def cached_arrays(key: str, size: int, build: Callable[[Path], None]) -> Arrays:
    """Return the cached arrays of a key, memory-mapped and read-only; build them first if needed.

    Removes the least recently used sets if the cache would exceed its limit or fill the disk. Processes that have
    mapped a removed set can still read it.

    Args:
        key: identifies the content; a file name of the form `<letters>-<hash>`.
        size: approximate size of the arrays in bytes.
        build: called with a new folder, into which it writes `<name>.npy` files.

    Raises:
        OptionError: if the arrays alone exceed the limit.
        CacheError: if the folder is not writable or the disk is full; unfinished files are removed.
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
        _make_room(folder.parent, size)
        with tempfile.TemporaryDirectory(prefix=f".{key}.partial-", dir=folder.parent) as scratch:
            return _build(folder, Path(scratch), build)
    except Icrl4ahtError:
        raise
    except OSError as error:
        raise _unusable(folder.parent, size, error) from error


def new_mapped_array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    """Create a .npy file with its disk space allocated, and return it as a writable memory map of zeros.

    Raises:
        OSError: if the disk is full or not writable; names the file.
    """
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with add_filename(path), path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        allocate(stream, stream.tell() + math.prod(shape) * dtype.itemsize)
    return np.lib.format.open_memmap(path, mode="r+")


def _open(folder: Path) -> Arrays | None:
    """Return the arrays of a folder and mark it as used; None if it is missing or a size or header is wrong."""
    arrays = {}
    if not all(path.is_file() for path in (folder / _CONTENTS, *folder.glob("*.npy"))):  # opening a pipe would hang
        return None
    try:
        for name, described in json.loads((folder / _CONTENTS).read_text(encoding="utf-8")).items():
            path = folder / f"{name}.npy"
            array = np.lib.format.open_memmap(path, mode="r")
            if _describe(array) != described or array.offset + array.nbytes != path.stat().st_size:
                return None
            arrays[name] = np.asarray(array)
    except (OSError, ValueError, AttributeError):
        return None
    with suppress(OSError):  # the folder belongs to another user or was just removed; the mapping stays valid
        os.utime(folder)
    return arrays


def _describe(array: np.ndarray) -> list:
    return [array.dtype.str, list(array.shape)]


def _build(folder: Path, scratch: Path, build: Callable[[Path], None]) -> Arrays:
    """Build a set of arrays in `scratch`, rename it unless another process was faster, and return the arrays."""
    new = scratch / "new"
    new.mkdir()
    build(new)
    paths = sorted(new.glob("*.npy"))
    contents = {path.stem: _describe(np.lib.format.open_memmap(path, mode="r")) for path in paths}
    (new / _CONTENTS).write_text(json.dumps(contents), encoding="utf-8")
    for _ in range(3):
        arrays = _open(folder)
        if arrays is not None:
            return arrays
        with suppress(OSError):  # a damaged set, or another file or folder of that name
            folder.rename(scratch / "damaged")
        with suppress(OSError):  # another process has just renamed its own set
            new.rename(folder)
    raise CacheError(f"{folder}: arrays just written cannot be read: check the disk")


def _unusable(folder: Path, size: int, error: OSError) -> CacheError:
    """Return a `CacheError` for a failed write to the cache folder."""
    if error.errno in NO_ROOM:
        room = describe_disk(folder)
        reason = f"has no room for arrays of {size:,} bytes ({error.strerror}; {room}); free some space there"
    else:
        reason = f"cannot be used: {error.strerror or error} ({error.filename}); check its permissions and content"
    return CacheError(
        f"{folder}: the cache folder {reason}, set {CACHE_VARIABLE} to another folder, or "
        f'take cache="ram" or cache="stream"'
    )


def _cached_sets(folder: Path) -> list[tuple[Path, int]]:
    """Return the finished sets and their bytes, the least recently used first."""
    found = []
    for path in folder.iterdir():
        if _KEY.fullmatch(path.name) and path.is_dir():
            with suppress(OSError):  # just removed by another process
                size = sum(file.stat().st_size for file in path.glob("*.npy"))
                found.append((path.stat().st_mtime_ns, path, size))
    return [(path, size) for _, path, size in sorted(found)]


def _make_room(folder: Path, size: int) -> None:
    """Remove files of killed processes, then the least recently used sets until `size` more bytes fit.

    Raises:
        OSError: if the disk has too little space even after that.
    """
    for left in folder.glob(".*.partial-*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > _ABANDONED:
                shutil.rmtree(left, ignore_errors=True)
    found, free = _cached_sets(folder), shutil.disk_usage(folder).free
    total = sum(bytes_ for _, bytes_ in found)
    if size > free + total:
        raise OSError(NO_ROOM[0], os.strerror(NO_ROOM[0]))
    excess = max(total + size - cache_limit(), size - free)
    for path, bytes_ in found:
        if excess <= 0:
            return
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.partial-", dir=folder) as scratch, suppress(OSError):
            path.rename(Path(scratch) / "removed")  # renaming is atomic: no process opens a partly removed set
            excess -= bytes_
