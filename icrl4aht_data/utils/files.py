"""Reading and writing text and JSON files, with errors that name the file.

Sizes are checked before a file is read: it may be a pipe, which never ends, or a sparse file of a terabyte.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from icrl4aht_data.errors import IndexFormatError

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
