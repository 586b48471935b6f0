"""TODO."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from icrl4aht_data.errors import UnsafePathError

LARGEST = 4 * 2**30
"""Bytes that a file of a release may have, if it is no shard."""


_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # a name that Windows keeps for itself


_RESERVED = re.compile(r'[\\:*?"<>|]')


_PART = 200  # bytes between two slashes: what is written beside a file has a longer name


def files_below(folder: Path) -> Iterator[str]:
    """The names of all that is in a folder, at any depth, but for folders; links are not followed."""
    folders = [""]
    while folders:
        at = folders.pop()
        entries = _entries(folder / at)
        if entries is None and at:
            yield at
        for name, is_folder in entries or ():
            if is_folder:
                folders.append(f"{at}{name}/")
            else:
                yield at + name


def _entries(folder: Path) -> list[tuple[str, bool]] | None:
    """What is in a folder: names, and whether each is a folder; None if it cannot be read."""
    try:
        with os.scandir(folder) as found:
            return [(entry.name, entry.is_dir(follow_symlinks=False)) for entry in found]
    except OSError:
        return None


def is_inside(name: str) -> bool:
    """Whether a relative path names a file below its root on every system: no "..", drive, backslash, control code."""
    if len(name) >= 1024 or not name.isprintable() or _RESERVED.search(name):
        return False
    return all(map(_is_part, name.split("/")))


def _is_part(part: str) -> bool:
    return 0 < len(part.encode()) <= _PART and part[-1] not in ". " and not _DEVICE.fullmatch(part)


def resolve_inside(folder: Path, name: str) -> Path:
    """The path of a release's file, if it is in the release, symbolic links followed, and a file or a folder if it is.

    A folder of the Hub's cache holds links to the blobs beside its snapshots; these are followed as well.

    Raises:
        UnsafePathError: names both.
    """
    path = folder / name
    if not is_inside(name):
        raise UnsafePathError(f"{folder}: {name[:200]!r} leads out of the release; do not use this release")
    allowed = [folder.resolve()]
    if folder.parent.name == "snapshots" and (folder.parent.parent / "blobs").is_dir():
        allowed.append((folder.parent.parent / "blobs").resolve())
    try:
        found = path.resolve()
        if not any(found.is_relative_to(root) for root in allowed):
            raise UnsafePathError(f"{path}: leads out of the release, to {found}; do not use this release")
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return path
    except (OSError, RuntimeError) as error:  # links in a circle, names that this disk does not take
        raise UnsafePathError(f"{path}: cannot be followed: {error}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnsafePathError(f"{path}: neither a file nor a folder; do not use this release")
    return path
