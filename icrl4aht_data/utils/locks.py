"""Locks between processes whose files are gone when nobody holds them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from filelock import FileLock

T = TypeVar("T")

_ATTEMPTS = 100  # to make a file in a folder that other processes remove just then


@contextmanager
def process_lock(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold a lock between processes and threads. Its file is made, with the folder for it, and removed at the end.

    The file is removed while the lock is still held. A process that has opened it before and now gets its lock would
    hold the lock of a file that nobody else can find: FileLock (3.24 and later) notices that and opens the path again.

    Args:
        path: the lock's file.
        wait: until another process releases the lock, instead of raising.

    Raises:
        filelock.Timeout: if another process holds the lock and `wait` is False.
        OSError: if the file cannot be made.
    """
    lock = FileLock(path, timeout=-1 if wait else 0)
    in_new_folder(path, lock.acquire)
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file; there `release` removes it
            path.unlink()
        lock.release()


def lock_path(folder: Path) -> Path:
    """Path of a folder's lock: next to the folder, so that the folder can be renamed or removed meanwhile."""
    return folder.with_name(f".{folder.name}.lock")


def in_new_folder(path: Path, create: Callable[[], T]) -> T:
    """Call a function that creates a file, after making the file's folder; again, if another process has removed the
    folder in between because it was empty.

    Raises:
        OSError: if the folder or the file cannot be made.
    """
    for _ in range(_ATTEMPTS):
        with suppress(FileNotFoundError, FileExistsError):  # the second one if the folder was there, and then was not
            path.parent.mkdir(parents=True, exist_ok=True)
            return create()
    path.parent.mkdir(parents=True, exist_ok=True)  # something else is wrong, and is raised
    return create()


def remove_empty_folders(folder: Path) -> None:
    """Remove a folder and those below it, as far as they are empty. Symbolic links are not followed."""
    if folder.is_symlink():
        return
    with suppress(OSError):
        for path in folder.iterdir():
            if path.is_dir():
                remove_empty_folders(path)
        folder.rmdir()
