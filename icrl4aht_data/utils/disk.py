"""Full disks: errors that say which disk is full, and how much of it is free."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from icrl4aht_data.errors import DiskFullError

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk, and of a used-up quota."""

NO_ROOM = (*FULL, errno.EFBIG)
"""Error numbers of a full disk, of a used-up quota, and of a limit on the size of files."""


def describe_disk(path: Path) -> str:
    """The disk that a path is on, which need not exist, and its free space, in words."""
    folder = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists()).resolve()
    disk = next(parent for parent in (folder, *folder.parents) if parent.is_mount() or parent == parent.parent)
    usage = shutil.disk_usage(folder)
    return f"{usage.free:,} of {usage.total:,} bytes are free on the disk of {disk}"


@contextmanager
def explain_full_disk(target: Path) -> Iterator[None]:
    """Raise errors of a full disk as ones that name the file or folder which is written, and the disk.

    Raises:
        DiskFullError: instead of an OSError that says so.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFullError) or error.errno not in FULL:
            raise
        raise DiskFullError(
            f"{target}: the disk is full: {describe_disk(target)}; free some space, or write to another disk"
        ) from error
