"""Paths that stay inside a release folder, on every system."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from icrl4aht_data.errors import IndexFormatError, UnsafePathError

LARGEST = 4 * 2**30
"""Most bytes of a release's file that is not a shard."""

_WINDOWS_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_RESERVED = re.compile(r'[\\:*?"<>|]')
_PART_BYTES = 200  # between two slashes; leaves room for the longer names of temporary files


def files_below(folder: Path) -> Iterator[str]:
    """Names of everything in a folder, at any depth, except folders; symbolic links are not followed."""
    folders = [""]
    while folders:
        prefix = folders.pop()
        try:
            with os.scandir(folder / prefix) as found:
                entries = [(prefix + entry.name, entry.is_dir(follow_symlinks=False)) for entry in found]
        except OSError:
            if prefix:  # a folder that cannot be listed is itself reported
                yield prefix
            continue
        for name, is_folder in entries:
            if is_folder:
                folders.append(f"{name}/")
            else:
                yield name


def is_inside(name: str) -> bool:
    """Whether a relative path names a file below its root on every system: no "..", drive, backslash, control code."""
    if len(name) >= 1024 or not name.isprintable() or _RESERVED.search(name):
        return False
    return all(
        0 < len(part.encode()) <= _PART_BYTES and part[-1] not in ". " and not _WINDOWS_DEVICE.fullmatch(part)
        for part in name.split("/")
    )


def resolve_inside(folder: Path, name: str) -> Path:
    """The path of a release's file, checked to stay in the release and to be a file or folder if it exists.

    A snapshot folder of the Hub's cache contains links to blobs outside of it; these are allowed.

    Raises:
        UnsafePathError: names the folder and the file.
        IndexFormatError: if a folder on the way cannot be read.
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
    except PermissionError as error:
        reason = f"cannot be read: {error.strerror}; check the permissions of its folder"
        raise IndexFormatError(f"{path}: {reason}") from error
    except (OSError, RuntimeError) as error:  # circular links, or names that this disk does not accept
        raise UnsafePathError(f"{path}: cannot be followed: {error}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnsafePathError(f"{path}: neither a file nor a folder; do not use this release")
    return path
