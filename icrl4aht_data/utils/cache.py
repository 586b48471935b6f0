"""Arrays made once and kept in a cache folder as plain .npy files, shared by processes, bounded in size.

The folder is $ICRL4AHT_CACHE_DIR, else icrl4aht below $XDG_CACHE_HOME or ~/.cache; its size limit is
$ICRL4AHT_CACHE_BYTES (100 GB by default). It is never the release folder: a release holds what its manifest lists and
nothing else, and is often read-only. Deleting the folder loses nothing but time.
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
from filelock import FileLock, Timeout

from icrl4aht_data.errors import OptionError

_DEFAULT_LIMIT = 100 * 10**9
_TICK_NS = 10**8  # a file changed this recently may change again within one tick of its clock
_COARSE_TICK_NS = 2 * 10**9  # where the clock shows no parts of a millisecond
_SMALL = 2**20  # hashing this is quicker than remembering

CACHE_VARIABLES = ("ICRL4AHT_CACHE_DIR", "XDG_CACHE_HOME")
DATA_VARIABLES = ("ICRL4AHT_DATA_DIR", "XDG_DATA_HOME")
"""Environment variables that say where a folder is; below the second one it is called icrl4aht."""

Arrays = dict[str, np.ndarray]


def cache_folder() -> Path:
    """Where arrays are kept; read from the environment at each call."""
    return _folder(CACHE_VARIABLES, "~/.cache")


def data_folder() -> Path:
    """Where remote releases come to: $ICRL4AHT_DATA_DIR, else icrl4aht below $XDG_DATA_HOME or ~/.local/share; read
    from the environment at each call. It is no cache: what is in it stays."""
    return _folder(DATA_VARIABLES, "~/.local/share")


def _folder(variables: tuple[str, str], default: str) -> Path:
    own, shared = map(os.environ.get, variables)
    return Path(own).expanduser() if own else Path(shared or default).expanduser() / "icrl4aht"


def cache_limit() -> int:
    """Bytes that the cache folder may hold.

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
    """Bytes that one more set of arrays may have: what the limit and the disk allow; 0 where nothing can be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return 0
        reusable = sum(_size(kept) for kept in _kept(folder))
        return min(cache_limit(), shutil.disk_usage(folder).free + reusable)
    except OSError:
        return 0


def cached_arrays(key: str, size: int, build: Callable[[Path], None]) -> Arrays:
    """The arrays of that key, memory-mapped read-only, built first if they are not there.

    Two processes that ask at once build once: the other one waits. Sets that were not used for longest are removed
    while the folder would exceed its limit; whoever has them mapped keeps them.

    Args:
        key: names the content, so that another content has another key; a file name.
        size: about how many bytes the arrays have.
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
    with FileLock(folder.with_name(f".{key}.lock")):
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
    """The arrays of a finished folder, and a mark that they were used; None where there are none."""
    try:
        paths = sorted(folder.glob("*.npy"))
        arrays: Arrays = {path.stem: np.asarray(np.load(path, mmap_mode="r", allow_pickle=False)) for path in paths}
    except (OSError, ValueError):  # removed or replaced while we looked, or damaged
        return None
    if not arrays:
        return None
    with suppress(OSError):  # somebody else's folder, or removed since: the mapping holds
        os.utime(folder)
    return arrays


def _kept(folder: Path) -> list[Path]:
    """Finished sets, the least recently used first."""
    used = []
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):
            try:
                used.append((path.stat().st_mtime_ns, path))
            except FileNotFoundError:
                continue
    return [path for _, path in sorted(used)]


def _size(folder: Path) -> int:
    total = 0
    for path in folder.glob("*.npy"):
        try:
            total += path.stat().st_size
        except FileNotFoundError:
            continue
    return total


def _make_room(folder: Path, size: int) -> None:
    with FileLock(folder / ".room.lock"):
        _sweep(folder)
        kept = _kept(folder)
        sizes = [_size(path) for path in kept]
        excess = sum(sizes) + size - cache_limit()
        for path, bytes_ in zip(kept, sizes, strict=True):
            if excess <= 0:
                return
            doomed = path.with_name(f".{path.name}.removed-{os.getpid()}")
            try:
                path.rename(doomed)  # at once, so that nobody opens half of it
            except FileNotFoundError:
                continue
            shutil.rmtree(doomed, ignore_errors=True)
            excess -= bytes_


def _sweep(folder: Path) -> None:
    """Remove what killed processes left: sets half built, which nobody holds the lock of, and half removed."""
    for left in folder.glob(".*.partial"):
        with suppress(Timeout), FileLock(left.with_suffix(".lock"), timeout=0):
            shutil.rmtree(left, ignore_errors=True)
    for left in folder.glob(".*.removed-*"):
        shutil.rmtree(left, ignore_errors=True)


def content_hash(path: Path) -> str:
    """A hash of a file's content (BLAKE2); that of a large file is remembered until the file changes."""
    before = path.stat()
    if before.st_size < _SMALL:
        return _hash(path)
    unsettled = _unsettled_ns(before)
    if 0 < unsettled <= _TICK_NS:
        time.sleep(unsettled / 1e9)
        before = path.stat()
        unsettled = _unsettled_ns(before)
    signature = [before.st_size, before.st_mtime_ns, before.st_ctime_ns, before.st_ino]
    name = hash_text(str(path.resolve()))
    note = cache_folder() / ".hashes" / f"{name}.json"
    try:
        known = json.loads(note.read_text(encoding="utf-8"))
        if known["signature"] == signature:
            return str(known["hash"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    content = _hash(path)
    if unsettled <= 0:
        try:
            note.parent.mkdir(parents=True, exist_ok=True)
            partial = note.with_suffix(f".{os.getpid()}")
            partial.write_text(json.dumps({"signature": signature, "hash": content}), encoding="utf-8")
            partial.replace(note)
        except OSError:  # not remembered, then
            pass
    return content


def _unsettled_ns(status: os.stat_result) -> int:
    """For how long another change of the file might leave its times as they are; 0 or less if it cannot."""
    times = (status.st_mtime_ns, status.st_ctime_ns)
    tick = _TICK_NS if any(moment % 10**6 for moment in times) else _COARSE_TICK_NS
    return max(times) + tick - time.time_ns()


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]


def hash_text(text: str) -> str:
    """SHA-256 of a text, its first 32 hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]
