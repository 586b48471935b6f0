"""Cache of arrays as .npy files, shared by processes and limited in size.

A set of arrays is a folder named by a hash of the set's inputs. The folder is written under a temporary name and
renamed when complete. Reading checks only sizes and headers, so delete the cache folder after a disk failure.
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

_CONTENTS = "contents.json"  # file with dtype and shape of every array
_KEY = re.compile(r"[a-z]+-[0-9a-f]{32,64}")  # only folders with a name of this form are removed to free space
_ABANDONED = 24 * 3600  # age in seconds at which an unfinished set is removed


def cacheable_bytes() -> int:
    """Return the maximum size in bytes of a new set of arrays; 0 if the cache folder is not writable."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # a read-only disk is not visible in the folder's permissions
            pass
        reusable = sum(size for _, size in _cached_sets(folder))
        return min(cache_limit(), shutil.disk_usage(folder).free + reusable)
    except OSError:
        return 0


def cached_arrays(key: str, size: int, build: Callable[[Path], None]) -> dict[str, np.ndarray]:
    """Return the set of cached arrays of a key, memory-mapped and read-only; build a missing or damaged set first.

    The least recently used sets are removed if the cache would exceed its limit or fill the disk. Processes that have
    mapped a removed set can still read the set.

    Args:
        key: name of the set, of the form `<letters>-<hash>`, with a hash of everything that determines the content.
        size: approximate size of the arrays in bytes.
        build: function of a new folder that writes the arrays to this folder as `<name>.npy` files.

    Raises:
        OptionError: if the arrays are larger than the limit of the cache.
        CacheError: if the folder is not writable or the disk is full; unfinished files are removed.
    """
    assert _KEY.fullmatch(key), key
    folder = cache_folder() / key
    arrays = _open_arrays(folder)
    if arrays is not None:
        return arrays
    if size > cache_limit():
        raise OptionError(
            f"{folder.parent}: the arrays have {size:,} bytes, but the cache is limited to {cache_limit():,}: raise "
            f'ICRL4AHT_CACHE_BYTES, select fewer histories, or use cache="stream"'
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _make_room(folder.parent, size)
        with tempfile.TemporaryDirectory(prefix=f".{key}.partial-", dir=folder.parent) as scratch:
            return _build(folder, Path(scratch), build)
    except Icrl4ahtError:
        raise
    except OSError as error:
        raise _cache_error(folder.parent, size, error) from error


def new_mapped_array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    """Create a .npy file with its disk space allocated, and return it as a writable memory map of zeros.

    Raises:
        OSError: if the disk is full or not writable; the error names the file.
    """
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with add_filename(path), path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        allocate(stream, stream.tell() + math.prod(shape) * dtype.itemsize)
    return np.lib.format.open_memmap(path, mode="r+")


def _open_arrays(folder: Path) -> dict[str, np.ndarray] | None:
    """Return the arrays of a folder, and mark the folder as used; None if a file is missing, cut off or damaged."""
    arrays = {}
    if not all(path.is_file() for path in (folder / _CONTENTS, *folder.glob("*.npy"))):  # opening a FIFO would hang
        return None
    try:
        for name, described in json.loads((folder / _CONTENTS).read_text(encoding="utf-8")).items():
            path = folder / f"{name}.npy"
            array = np.lib.format.open_memmap(path, mode="r")
            if _dtype_and_shape(array) != described or array.offset + array.nbytes != path.stat().st_size:
                return None
            arrays[name] = np.asarray(array)
    except (OSError, ValueError, AttributeError):
        return None
    with suppress(OSError):  # if the folder is another user's or was just removed, the arrays are still readable
        os.utime(folder)
    return arrays


def _dtype_and_shape(array: np.ndarray) -> list:
    return [array.dtype.str, list(array.shape)]


def _build(folder: Path, scratch: Path, build: Callable[[Path], None]) -> dict[str, np.ndarray]:
    """Build arrays in `scratch`, move them to `folder` unless another process was faster, and return the arrays."""
    new = scratch / "new"
    new.mkdir()
    build(new)
    paths = sorted(new.glob("*.npy"))
    contents = {path.stem: _dtype_and_shape(np.lib.format.open_memmap(path, mode="r")) for path in paths}
    (new / _CONTENTS).write_text(json.dumps(contents), encoding="utf-8")
    for _ in range(3):
        arrays = _open_arrays(folder)
        if arrays is not None:
            return arrays
        with suppress(OSError):  # move a damaged set, or a file of this name, out of the way
            folder.rename(scratch / "damaged")
        with suppress(OSError):  # another process may just have moved a set to this folder
            new.rename(folder)
    raise CacheError(f"{folder}: arrays just written cannot be read: check the disk")


def _cache_error(folder: Path, size: int, error: OSError) -> CacheError:
    """Return a `CacheError` for a failed write to the cache folder."""
    if error.errno in NO_ROOM:
        room = describe_disk(folder)
        reason = f"has no room for arrays of {size:,} bytes ({error.strerror}; {room}); free some space there"
    else:
        reason = f"cannot be used: {error.strerror or error} ({error.filename}); check its permissions and content"
    return CacheError(
        f"{folder}: the cache folder {reason}, set {CACHE_VARIABLE} to another folder, or "
        f'use cache="ram" or cache="stream"'
    )


def _cached_sets(folder: Path) -> list[tuple[Path, int]]:
    """Return paths and sizes in bytes of the finished sets of arrays, the least recently used set first."""
    found = []
    for path in folder.iterdir():
        if _KEY.fullmatch(path.name) and path.is_dir():
            with suppress(OSError):  # fails if another process has just removed the set
                size = sum(file.stat().st_size for file in path.glob("*.npy"))
                found.append((path.stat().st_mtime_ns, path, size))
    return [(path, size) for _, path, size in sorted(found)]


def _make_room(folder: Path, size: int) -> None:
    """Remove files left by killed processes, then the least recently used sets until `size` more bytes fit.

    Raises:
        OSError: if the disk has too little space even without any cached set.
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
            path.rename(Path(scratch) / "removed")  # a rename is atomic, so no process opens a partly removed set
            excess -= bytes_
