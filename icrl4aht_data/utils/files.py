"""Files and folders: text and JSON, atomic writes, locks between processes, safe paths, full disks.

Sizes are checked before a file is read: it may be a pipe, which never ends, or a sparse file of a terabyte.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from filelock import FileLock

from icrl4aht_data.errors import DiskFullError, IndexFormatError, OptionError, UnsafePathError

TEXT_BYTES = 64 * 2**20
"""Most bytes of a file that is read at once: six times the largest, the provenance of ten thousand tasks."""

LINE_BYTES = 2**20
"""Most bytes of a line."""

_DEPTH = 64  # nesting of JSON that is accepted, well below the depth of Python's stack


def plain_size(path: Path, most: int) -> int:
    """Size in bytes of a regular file.

    Raises:
        IndexFormatError: if it is missing, not a regular file, or larger than `most`.
    """
    with wrap_read_errors(path):
        status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise IndexFormatError(f"{path}: not a plain file")
    if status.st_size > most:
        raise IndexFormatError(f"{path}: expected at most {most:,} bytes, found {status.st_size:,}")
    return status.st_size


def read_text(path: Path) -> str:
    """A text file's content.

    Raises:
        IndexFormatError: if it is missing, unreadable, too large or not UTF-8.
    """
    plain_size(path, TEXT_BYTES)
    with wrap_read_errors(path):
        return path.read_text(encoding="utf-8")


def read_lines(path: Path) -> Iterator[str]:
    """The lines of a text file of any size, without their newlines.

    Raises:
        IndexFormatError: if the file is missing, unreadable or not UTF-8, or a line is too long.
    """
    plain_size(path, 2**62)
    with wrap_read_errors(path), path.open("rb") as stream:
        number = 0
        while line := stream.readline(LINE_BYTES):
            number += 1
            if len(line) == LINE_BYTES:
                raise IndexFormatError(f"{path}, line {number}: expected at most {LINE_BYTES:,} bytes")
            yield line.removesuffix(b"\n").decode()


@contextmanager
def wrap_read_errors(path: Path) -> Iterator[None]:
    """Turn errors of reading a file into ones that name it.

    Raises:
        IndexFormatError: if the file is missing, cannot be read, or is not UTF-8.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise IndexFormatError(f"{path}: missing; fetch the release again") from error
    except OSError as error:
        raise IndexFormatError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise IndexFormatError(f"{path}: not UTF-8 text: {error}") from error


def parse_json(text: str) -> Any:
    """A JSON value.

    Raises:
        IndexFormatError: without file and line, which the caller adds.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:  # also for too many digits or levels
        raise IndexFormatError(f"not JSON: {error}") from error
    level = [value]
    for _ in range(_DEPTH):
        level = [part for part in level if isinstance(part, (dict, list))]
        if not level:
            return value
        level = [inner for part in level for inner in (part.values() if isinstance(part, dict) else part)]
    raise IndexFormatError(f"not JSON as expected: more than {_DEPTH} levels deep")


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def json_hash(content: Any) -> str:
    """A hash of settings: the first 16 hexadecimal digits of SHA-256 of their JSON, keys sorted."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def has_content(path: Path, content: bytes) -> bool:
    """Whether a file exists with exactly this content."""
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


@contextmanager
def add_filename(path: Path) -> Iterator[None]:
    """Add the file's name to errors of the disk, which have none when they come from an open file."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def allocate(stream: BinaryIO, size: int) -> None:
    """Extend a new file to `size` bytes, for which the disk really has room.

    A sparse file would kill a process by a signal when it writes to a map of the file and the disk is full.

    Raises:
        OSError: if there is no room.
    """
    stream.flush()
    try:
        os.posix_fallocate(stream.fileno(), 0, size)
    except (AttributeError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL):
            raise
        for start in range(stream.tell(), size, LINE_BYTES):  # neither the system nor its C library can allocate
            stream.write(bytes(min(LINE_BYTES, size - start)))
        stream.flush()


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk.

    Raises:
        OSError: if they cannot be written.
    """
    if path.is_dir() and os.name == "nt":  # folders cannot be opened there
        return
    number = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        with add_filename(path):
            os.fsync(number)
    finally:
        os.close(number)


def final_name(name: str) -> str:
    """Path, in a folder, that a temporary file of `atomic_write` would have got; other paths unchanged."""
    return re.sub(r"(^|/)\.([^/]+)\.partial$", r"\1\2", name)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path to write to. At the end the file is synced to disk and renamed to `path`; an error changes
    nothing."""
    partial = path.with_name(f".{path.name}.partial")
    partial.unlink(missing_ok=True)  # writing would follow a link that somebody put there
    try:
        with add_filename(path):
            yield partial
            with partial.open("rb+") as stream:
                os.fsync(stream.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def check_output(path: Path, overwrite: bool, names: Iterable[str] | None = None) -> None:
    """Check that a command may write a file, or files into a folder: what exists is replaced with `overwrite` only.

    Folders and links are never replaced.

    Args:
        path: the file to write; with `names` the folder.
        overwrite: replace these files. Other files of a folder stay.
        names: names of the files to write into the folder.

    Raises:
        OptionError: names the file or folder that may not be written.
    """
    if names is not None and os.path.lexists(path):
        if not path.is_dir():
            raise OptionError(f"{path}: a file is where a folder is needed; give another folder")
        if not overwrite and any(path.iterdir()):
            raise OptionError(f"{path}: exists; give another folder, or replace its files by --overwrite")
    for file in [path] if names is None else [path / name for name in names]:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OptionError(f"{file}: a folder or a link is where a file is needed; give another name")
        if file.exists() and not overwrite:
            raise OptionError(f"{file}: exists; give another name, or replace it by --overwrite")


def check_own_folder(folder: Path, names: Collection[str], what: str) -> None:
    """Check that a folder may receive files with these names: it is missing, or has no others.

    Args:
        folder: the folder to write to.
        names: names of files and folders that the writer makes in it.
        what: what it holds then, such as "a run", for the message.

    Raises:
        OptionError: if it is no folder, or has files with other names; lists some of them.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: a file is where a folder is needed; give another folder")
    found = (final_name(path.name) for path in folder.iterdir()) if folder.is_dir() else ()
    foreign = sorted(name for name in found if name not in names)
    if foreign:
        raise OptionError(
            f"{folder}: has other files ({', '.join(foreign[:3])}), expected {what}, or an empty or new folder; give "
            f"another folder"
        )


T = TypeVar("T")


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
    path.parent.mkdir(parents=True, exist_ok=True)
    lock.acquire()
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file; there `release` removes it
            path.unlink()
        lock.release()


def lock_path(folder: Path) -> Path:
    """Path of a folder's lock: next to the folder, so that the folder can be renamed or removed meanwhile."""
    return folder.with_name(f".{folder.name}.lock")


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
