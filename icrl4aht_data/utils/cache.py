"""Arrays built once and kept in a cache folder as plain .npy files, shared by processes, bounded in size.

The folder is $ICRL4AHT_CACHE_DIR, else the user's cache folder (`platformdirs`); its size limit is
$ICRL4AHT_CACHE_BYTES (100 GB by default). It is never the release folder: a release contains what its manifest lists
and nothing else, and is often read-only. Deleting the folder costs nothing but time.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs
from filelock import Timeout

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.locks import process_lock

_DEFAULT_LIMIT = 100 * 10**9
_TICK_NS = 10**8  # a file changed this recently may change again within one tick of its clock
_COARSE_TICK_NS = 2 * 10**9  # the tick of file systems whose times have no parts of a millisecond
_SMALL = 2**20  # bytes; hashing fewer is faster than looking up their hash

CACHE_VARIABLES = ("ICRL4AHT_CACHE_DIR", "XDG_CACHE_HOME")
"""Environment variables that set the cache folder; below the second one it is called icrl4aht."""

DATA_VARIABLES = ("ICRL4AHT_DATA_DIR", "XDG_DATA_HOME")
"""Environment variables that set the data folder; below the second one it is called icrl4aht."""

Arrays = dict[str, np.ndarray]


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


def cache_room() -> int:
    """Bytes that one more set of arrays may take: what the limit and the disk allow; 0 if the folder is read-only."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return 0
        reusable = sum(size for _, size in _cached_sets(folder))
        return min(cache_limit(), shutil.disk_usage(folder).free + reusable)
    except OSError:
        return 0


def cached_arrays(key: str, size: int, build: Callable[[Path], None]) -> Arrays:
    """The arrays of a key, memory-mapped read-only, built first if they are not cached.

    If two processes need the same arrays, one builds them and the other waits. Sets that were not used for longest are
    removed while the folder would exceed its limit; processes that have them mapped can still read them.

    Args:
        key: identifies the content; a file name.
        size: approximate size of the arrays in bytes.
        build: called with a new folder, into which it writes `<name>.npy` files.

    Raises:
        OptionError: if the arrays alone exceed the limit.
        OSError: if the folder cannot be written.
    """
    folder = cache_folder() / key
    arrays = _open(folder)
    if arrays is not None:
        return arrays
    if size > cache_limit():
        raise OptionError(
            f"{folder.parent}: the arrays have {size:,} bytes, the cache may hold {cache_limit():,}: raise "
            f'ICRL4AHT_CACHE_BYTES, select fewer histories, or take cache="stream"'
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with process_lock(folder.with_name(f".{key}.lock")):
        arrays = _open(folder)
        if arrays is None:
            _make_room(folder.parent, size)
            partial = folder.with_name(f".{key}.partial")
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            try:
                build(partial)
                shutil.rmtree(folder, ignore_errors=True)  # a set that could not be opened
                partial.rename(folder)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
            arrays = _open(folder)
    if arrays is None:
        raise OSError(f"{folder}: arrays just written cannot be opened")
    return arrays


def _open(folder: Path) -> Arrays | None:
    """The arrays of a finished folder, which is marked as used; None if there are none."""
    try:
        paths = sorted(folder.glob("*.npy"))
        arrays: Arrays = {path.stem: np.asarray(np.load(path, mmap_mode="r", allow_pickle=False)) for path in paths}
    except (OSError, ValueError):  # removed or replaced meanwhile, or damaged
        return None
    if not arrays:
        return None
    with suppress(OSError):  # another user's folder, or removed meanwhile: the mapping stays valid
        os.utime(folder)
    return arrays


def _cached_sets(folder: Path) -> list[tuple[Path, int]]:
    """Finished sets and their bytes, the least recently used first. Other processes may remove sets meanwhile."""
    found = []
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):
            with suppress(FileNotFoundError):
                size = sum(file.stat().st_size for file in path.glob("*.npy"))
                found.append((path.stat().st_mtime_ns, path, size))
    return [(path, size) for _, path, size in sorted(found)]


def _make_room(folder: Path, size: int) -> None:
    """Remove leftovers of killed processes, then the least recently used sets until `size` more bytes fit."""
    with process_lock(folder / ".room.lock"):
        for left in folder.glob(".*.partial"):
            with suppress(Timeout), process_lock(left.with_suffix(".lock"), wait=False):  # held while a set is built
                shutil.rmtree(left, ignore_errors=True)
        for left in folder.glob(".*.removed-*"):
            shutil.rmtree(left, ignore_errors=True)
        found = _cached_sets(folder)
        excess = sum(bytes_ for _, bytes_ in found) + size - cache_limit()
        for path, bytes_ in found:
            if excess <= 0:
                return
            doomed = path.with_name(f".{path.name}.removed-{os.getpid()}")
            try:
                path.rename(doomed)  # atomic, so that no process opens half of a set
            except FileNotFoundError:
                continue
            shutil.rmtree(doomed, ignore_errors=True)
            excess -= bytes_


def content_hash(path: Path) -> str:
    """A hash of a file's content (BLAKE2); for a large file it is stored in the cache until the file changes."""
    before = path.stat()
    if before.st_size < _SMALL:
        return _hash(path)
    unsettled = _unsettled_ns(before)
    if 0 < unsettled <= _TICK_NS:
        time.sleep(unsettled / 1e9)
        before = path.stat()
        unsettled = _unsettled_ns(before)
    signature = [before.st_size, before.st_mtime_ns, before.st_ctime_ns, before.st_ino]
    name = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:32]
    note = cache_folder() / ".hashes" / f"{name}.json"
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(note.read_text(encoding="utf-8"))
        if known["signature"] == signature:
            return str(known["hash"])
    content = _hash(path)
    if unsettled <= 0:
        with suppress(OSError):  # without a cache folder the hash is computed again next time
            note.parent.mkdir(parents=True, exist_ok=True)
            partial = note.with_suffix(f".{os.getpid()}")
            partial.write_text(json.dumps({"signature": signature, "hash": content}), encoding="utf-8")
            partial.replace(note)
    return content


def _unsettled_ns(status: os.stat_result) -> int:
    """For how long another change of the file might leave its times as they are; 0 or less if it cannot."""
    times = (status.st_mtime_ns, status.st_ctime_ns)
    tick = _TICK_NS if any(moment % 10**6 for moment in times) else _COARSE_TICK_NS
    return max(times) + tick - time.time_ns()


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
