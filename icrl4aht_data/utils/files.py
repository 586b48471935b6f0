"""Utilities for files: text and JSON, hashes, atomic writes, locks between processes, safe paths, disk-full errors.

Sizes are checked before reading: a pipe never ends, and a sparse file may have a terabyte.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock

from icrl4aht_data.errors import DiskFullError, IndexFormatError, OptionError, UnsafePathError

TEXT_BYTES = 64 * 2**20
"""Maximum bytes of a text file: six times our largest text file, the provenance of ten thousand tasks."""

LARGEST = 2**30
"""Maximum bytes of a file of a release, except shards; an index of this size has 1.5 million histories."""

LINE_BYTES = 2**20
"""Maximum bytes of a line of a text file."""

PAGE_START = b'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>ICRL4AHT '
"""First bytes of the HTML pages that `browse` and `report` write."""

_STARTS = {
    ".gif": b"GIF8",
    ".htm": PAGE_START,
    ".html": PAGE_START,
    ".json": b'{"format":',
    ".parquet": b"PAR1",
    ".pdf": b"%PDF-",
    ".png": b"\x89PNG\r\n",
    ".svg": b"<?xml",
}  # first bytes of the files that commands write, by suffix

_DEPTH = 64  # maximum nesting depth of JSON, well below Python's recursion limit


def check_file_size(path: Path, most: int) -> None:
    """Check that a file is a regular file of at most `most` bytes.

    Raises:
        IndexFormatError: if the file is missing, not a regular file, or larger than `most`.
    """
    with wrap_read_errors(path):
        status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise IndexFormatError(f"{path}: not a regular file")
    if status.st_size > most:
        raise IndexFormatError(f"{path}: expected at most {most:,} bytes, found {status.st_size:,}")


def read_text(path: Path) -> str:
    """Return the content of a text file.

    Raises:
        IndexFormatError: if the file is missing, unreadable, too large or not UTF-8.
    """
    check_file_size(path, TEXT_BYTES)
    with wrap_read_errors(path):
        return path.read_text(encoding="utf-8")


def read_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file of at most `LARGEST` bytes, without newlines.

    Raises:
        IndexFormatError: if the file is missing, unreadable, too large or not UTF-8, or a line is too long.
    """
    check_file_size(path, LARGEST)
    with wrap_read_errors(path), path.open("rb") as stream:
        for number, line in enumerate(iter(lambda: stream.readline(LINE_BYTES), b""), start=1):
            if len(line) == LINE_BYTES:
                raise IndexFormatError(f"{path}, line {number}: expected at most {LINE_BYTES:,} bytes")
            yield line.removesuffix(b"\n").decode()


@contextmanager
def wrap_read_errors(path: Path) -> Iterator[None]:
    """Convert errors of reading a file to `IndexFormatError`, whose message has the file's name.

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
    """Parse a JSON text.

    Raises:
        IndexFormatError: if the text is not JSON; the caller adds the file and the line to the message.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:  # also for a number with too many digits, or deep nesting
        raise IndexFormatError(f"not JSON: {error}") from error
    level = [value]
    for _ in range(_DEPTH):
        level = [part for part in level if isinstance(part, (dict, list))]
        if not level:
            return value
        level = [inner for part in level for inner in (part.values() if isinstance(part, dict) else part)]
    raise IndexFormatError(f"expected JSON of at most {_DEPTH} levels, found more")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        IndexFormatError: if the file cannot be read, or is not JSON.
    """
    text = read_text(path)
    try:
        return parse_json(text)
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: {error}") from error


def write_json(path: Path, content: Any, indent: int | None = 2) -> None:
    """Write a JSON file atomically, indented or on one line."""
    write_atomically(path, json.dumps(content, indent=indent) + "\n")


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def size_checked_hash(path: Path) -> str:
    """Return the SHA-256 of a file of at most `LARGEST` bytes as hexadecimal digits.

    Raises:
        IndexFormatError: if the file is missing, not a regular file, too large or unreadable.
    """
    check_file_size(path, LARGEST)
    with wrap_read_errors(path):
        return file_hash(path)


def hashes_match(folder: Path, files: Mapping[str, str]) -> bool:
    """Return whether the listed files of a folder have the listed SHA-256 hashes.

    Args:
        folder: the folder that contains the files.
        files: SHA-256 of each file, by path in the folder.

    Raises:
        OSError: if a file cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())


def short_hash(data: bytes, digits: int = 16) -> str:
    """Return the first hexadecimal digits of the SHA-256 of the given bytes."""
    return hashlib.sha256(data).hexdigest()[:digits]


def json_hash(content: Any) -> str:
    """Return a hash of settings: the `short_hash` of their JSON with sorted keys."""
    return short_hash(json.dumps(content, sort_keys=True).encode())


@contextmanager
def add_filename(path: Path) -> Iterator[None]:
    """Set the file name of an OSError that has none, such as an error of an operation on an open file."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def allocate(stream: BinaryIO, size: int) -> None:
    """Extend a new file to `size` bytes, and allocate these bytes on the disk.

    On a full disk, writing to the memory map of a sparse file would kill the process by a signal.

    Raises:
        OSError: if the disk is full.
    """
    stream.flush()
    try:
        os.posix_fallocate(stream.fileno(), 0, size)
    except (AttributeError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL):
            raise
        for start in range(stream.tell(), size, LINE_BYTES):  # some systems cannot reserve disk space
            stream.write(bytes(min(LINE_BYTES, size - start)))
        stream.flush()


def sync(path: Path) -> None:
    """Wait until the content of a file is on the disk.

    Raises:
        OSError: if the content cannot be written.
    """
    with add_filename(path), path.open("r+b") as stream:
        os.fsync(stream.fileno())


def final_name(name: str) -> str:
    """Return `NAME` for a temporary file `.NAME.partial` or a lock file `.NAME.lock`; other paths are unchanged."""
    return re.sub(r"(^|/)\.([^/]+)\.(partial|lock)$", r"\1\2", name)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, then sync the file and rename it to `path`.

    If an error is raised, the file at `path` is unchanged.
    """
    partial = path.with_name(f".{path.name}.partial")
    partial.unlink(missing_ok=True)  # otherwise writing would follow a symbolic link
    try:
        with add_filename(path):
            yield partial
            sync(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a binary or a UTF-8 text file with `atomic_write`."""
    with atomic_write(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def check_output(path: Path, overwrite: bool, names: Iterable[str] | None = None) -> None:
    """Check that a command may write a file, or files into a folder.

    Folders and links are never replaced. A single file with one of the suffixes in `_STARTS` is only replaced if it has
    the kind that its suffix says.

    Args:
        path: the file to write; with `names`, the folder.
        overwrite: accept existing files, which the command replaces. Other files in the folder are kept.
        names: names of the files to write into the folder.

    Raises:
        OptionError: if a file exists or the folder is not empty, and `overwrite` is False; or if a folder, a link or
            a file of another kind has the path of a file.
    """
    if names is not None and os.path.lexists(path):
        if not path.is_dir():
            raise OptionError(f"{path}: expected a folder, found a file; give the path of a folder")
        if not overwrite and any(path.iterdir()):
            raise OptionError(f"{path}: exists; give another folder, or use --overwrite to replace its files")
    for file in [path] if names is None else [path / name for name in names]:
        if file.is_symlink() or (file.exists() and not file.is_file()):
            raise OptionError(f"{file}: expected a file, found a folder or a link; give another name")
        if file.exists() and not overwrite:
            raise OptionError(f"{file}: exists; give another name, or use --overwrite to replace it")
        start = _STARTS.get(file.suffix, b"") if names is None else b""
        if file.exists() and not starts_with(file, start):
            wrong = f"{file}: not a {file.suffix} file that this package writes"
            raise OptionError(f"{wrong}, so --overwrite does not replace the file; give another name, or remove it")


def starts_with(path: Path, start: bytes) -> bool:
    """Return whether a file starts with the given bytes, or white space and these bytes, as older pages do."""
    with path.open("rb") as stream:
        return stream.read(len(start) + 64).lstrip().startswith(start)


def check_folder_content(folder: Path, names: Collection[str], what: str) -> None:
    """Check that a folder is missing, or contains no files except files that will be written.

    Args:
        folder: the folder to write to.
        names: names of the files and folders to write.
        what: the expected content in words, such as "a run", for the message.

    Raises:
        OptionError: if `folder` is not a folder or has other files; the message lists some of the other files.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: expected a folder, found a file; give the path of a folder")
    found = [final_name(path.name) for path in folder.iterdir()] if folder.is_dir() else []
    foreign = sorted(name for name in found if name not in names)
    if foreign:
        raise OptionError(
            f"{folder}: has other files ({', '.join(foreign[:3])}), expected {what}, or an empty or new folder; give "
            f"another folder"
        )


@contextmanager
def process_lock(path: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold a lock between processes and threads. Creates the lock file and its folder, and removes the file at the end.

    The file is removed while the lock is held. A waiting process may then lock the deleted file: FileLock (3.24 and
    later) detects that and opens the path again.

    Args:
        path: the lock file.
        wait: wait until another process releases the lock, instead of raising.

    Raises:
        filelock.Timeout: if another process holds the lock and `wait` is False.
        OSError: if the lock file cannot be created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path, timeout=-1 if wait else 0):
        try:
            yield
        finally:
            with suppress(OSError):  # Windows cannot remove an open file; on Windows, `FileLock` removes the lock file
                path.unlink()


def lock_file_path(folder: Path) -> Path:
    """Return the path of the lock file of a folder or file, next to it, so that a locked folder can be renamed."""
    folder = folder.resolve()  # "." has no name
    return folder.with_name(f".{folder.name}.lock")


_WINDOWS_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_RESERVED = re.compile(r'[\\:*?"<>|]')
_PART_BYTES = 200  # maximum bytes of a path component; temporary files have longer names


def files_below(folder: Path) -> Iterator[str]:
    """Yield the relative paths of all files below a folder; symbolic links are not followed."""
    folders = [""]  # no `os.walk`, which in Python 3.11 fails on folders deeper than the recursion limit
    while folders:
        prefix = folders.pop()
        try:
            with os.scandir(folder / prefix) as found:
                entries = [(prefix + entry.name, entry.is_dir(follow_symlinks=False)) for entry in found]
        except OSError:
            if prefix:  # yield the path of a folder that cannot be listed
                yield prefix
            continue
        for name, is_folder in entries:
            if is_folder:
                folders.append(f"{name}/")
            else:
                yield name


def is_safe_path(name: str) -> bool:
    """Return whether a relative path is safe on every system: no "..", drive, backslash or control character."""
    if len(name) >= 1024 or not name.isprintable() or _RESERVED.search(name):
        return False
    return all(
        0 < len(part.encode()) <= _PART_BYTES and part[-1] not in ". " and not _WINDOWS_DEVICE.fullmatch(part)
        for part in name.split("/")
    )


def resolve_inside(folder: Path, name: str) -> Path:
    """Return the path of a file of a release after checking that the file is inside the release.

    In the cache of the Hugging Face Hub, links from a snapshot folder to the folder of blobs are allowed.

    Raises:
        UnsafePathError: if `name` is not a safe path (see `is_safe_path`), or points outside the release, or to neither
            a file nor a folder.
        IndexFormatError: if a folder on the path cannot be read.
    """
    path = folder / name
    if not is_safe_path(name):
        raise UnsafePathError(
            f"{folder}: {name[:200]!r} points outside the release or is not a valid path; do not use this release"
        )
    allowed = [folder.resolve()]
    if folder.parent.name == "snapshots" and (folder.parent.parent / "blobs").is_dir():
        allowed.append((folder.parent.parent / "blobs").resolve())
    try:
        found = path.resolve()
        if not any(found.is_relative_to(root) for root in allowed):
            raise UnsafePathError(f"{path}: points outside the release, to {found}; do not use this release")
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return path
    except PermissionError as error:
        reason = f"cannot be read: {error.strerror}; check the permissions of its folder"
        raise IndexFormatError(f"{path}: {reason}") from error
    except (OSError, RuntimeError) as error:  # circular link, or a name that the file system rejects
        raise UnsafePathError(f"{path}: cannot be resolved: {error}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnsafePathError(f"{path}: neither a file nor a folder; do not use this release")
    return path


FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk and of an exceeded quota."""

NO_ROOM = (*FULL, errno.EFBIG)
"""Error numbers of a full disk, an exceeded quota, and an exceeded limit on file sizes."""


def describe_disk(path: Path) -> str:
    """Return text that states the free space on the disk of a path. The path need not exist."""
    folder = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists()).resolve()
    disk = next(parent for parent in (folder, *folder.parents) if parent.is_mount() or parent == parent.parent)
    usage = shutil.disk_usage(folder)
    return f"{usage.free:,} of {usage.total:,} bytes are free on the disk of {disk}"


@contextmanager
def explain_full_disk(target: Path) -> Iterator[None]:
    """Convert an OSError of a full disk to `DiskFullError`, whose message has `target`, the disk and its free space.

    Raises:
        DiskFullError: if the disk is full.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFullError) or error.errno not in FULL:
            raise
        raise DiskFullError(
            f"{target}: the disk is full: {describe_disk(target)}; free some space, or write to another disk"
        ) from error
