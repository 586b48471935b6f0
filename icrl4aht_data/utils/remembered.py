"""Hashes of large files, which are computed once and noted in the cache folder until a file changes.

A file counts as changed if its size, inode or one of its times differs; the time of its last change of status (ctime)
cannot be set by hand. Notes are valid until the machine restarts, so that a disk is read again at least that often, and
carry a hash of their own content. Without a cache folder that can be written, hashes are computed every time.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import stat
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.hashes import block_hash, file_hash
from icrl4aht_data.utils.system import cache_folder

_TICK_NS = 10**8  # a file changed this recently may change again within one tick of its clock
_COARSE_TICK_NS = 2 * 10**9  # the tick of file systems whose times have no parts of a millisecond
_SMALL = 2**20  # bytes; hashing fewer is faster than looking up their hash

Signature = list[int]
"""Properties of a file that differ after a change: size, mtime, ctime and inode."""


def remembered_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal.

    Raises:
        OSError: if it cannot be read, or is not a regular file.
    """
    where = str(path.resolve())
    name = hashlib.sha256(f"{platform.node()} {where}".encode()).hexdigest()[:32]
    return _remembered({where: path}, file_hash, cache_folder() / ".hashes" / f"{name}.json")[where]


def remembered_block_hashes(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """File -> `block_hash`, for files of a folder, which also receives the note.

    Raises:
        OSError: if one cannot be read, or is not a regular file.
    """
    return _remembered({name: folder / name for name in names}, block_hash, folder / f"checked-{platform.node()}.json")


def _remembered(files: Mapping[str, Path], compute: Callable[[Path], str], note: Path) -> dict[str, str]:
    signatures = {name: _signature(path) for name, path in files.items()}
    if sum(size for size, *_ in signatures.values()) < _SMALL:
        return {name: compute(path) for name, path in files.items()}
    unsettled = max(map(_unsettled_ns, signatures.values()))
    if 0 < unsettled <= _TICK_NS:
        time.sleep(unsettled / 1e9)
        signatures = {name: _signature(path) for name, path in files.items()}
        unsettled = max(map(_unsettled_ns, signatures.values()))
    state = {"boot": _boot_id(), "signatures": signatures}
    known = read_checked_json(note)
    if known is not None and known | state == known:
        return known["hashes"]
    hashes = {name: compute(path) for name, path in files.items()}
    if unsettled <= 0:
        with suppress(OSError):
            note.parent.mkdir(parents=True, exist_ok=True)
            write_checked_json(note, state | {"hashes": hashes})
    return hashes


def write_checked_json(path: Path, content: Any) -> None:
    """Write JSON after a line with its SHA-256; the file appears complete or not at all."""
    text = json.dumps(content)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}", encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_checked_json(path: Path) -> dict[str, Any] | None:
    """An object that `write_checked_json` wrote; None if the file is missing or anything else."""
    with suppress(OSError, Icrl4ahtError):
        digest, _, text = read_text(path).partition("\n")
        content = parse_json(text) if hashlib.sha256(text.encode()).hexdigest() == digest else None
        return content if isinstance(content, dict) else None
    return None


def _signature(path: Path) -> Signature:
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise OSError(f"{path}: not a plain file")
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def _unsettled_ns(signature: Signature) -> int:
    """For how long another change of the file might leave its times as they are; 0 or less if it cannot."""
    times = signature[1:3]
    tick = _TICK_NS if any(moment % 10**6 for moment in times) else _COARSE_TICK_NS
    return max(times) + tick - time.time_ns()


@cache
def _boot_id() -> str:
    """Identifier of the time since the machine started; empty where the system does not say."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""
