"""Text and JSON files: whatever is wrong with one becomes an error that names it; written whole or not at all.

What a file promises is bounded before it is read: it may be a pipe, which never ends, or have a hole of a terabyte.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import IndexFormatError

TEXT_BYTES = 64 * 2**20
"""What is read whole: the largest, the provenance of ten thousand tasks, has a sixth of it."""

LINE_BYTES = 2**20

_DEPTH = 64  # of JSON: beyond, what walks it would exceed Python's stack


def plain_size(path: Path, most: int) -> int:
    """Bytes of a file that may be opened.

    Raises:
        IndexFormatError: if it is missing, no plain file, or longer than `most`.
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
        IndexFormatError: if it is missing, unreadable, too long or not UTF-8.
    """
    plain_size(path, TEXT_BYTES)
    with wrap_read_errors(path):
        return path.read_text(encoding="utf-8")


def read_lines(path: Path) -> Iterator[str]:
    """A text file's lines, of which there may be any number.

    Raises:
        IndexFormatError: the same.
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
    """What reading a file raises becomes an error that names it.

    Raises:
        IndexFormatError: if it is missing, cannot be read, or is not UTF-8.
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
    except (ValueError, RecursionError) as error:  # also too many digits, too deep
        raise IndexFormatError(f"not JSON: {error}") from error
    level = [value]
    for _ in range(_DEPTH):
        level = [part for part in level if isinstance(part, (dict, list))]
        if not level:
            return value
        level = [part for whole in level for part in (whole.values() if isinstance(whole, dict) else whole)]
    raise IndexFormatError(f"not JSON as expected: more than {_DEPTH} levels deep")


def write_json(path: Path, content: Any) -> None:
    """Indented, for people."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def json_hash(content: Any) -> str:
    """Of settings: the first 16 hexadecimal digits of SHA-256 of their JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def has_content(path: Path, content: bytes) -> bool:
    """Whether a file has that content."""
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


@contextmanager
def add_filename(path: Path) -> Iterator[None]:
    """Errors of the disk name the file: those of writing to an open one do not."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to. At the end the file, by then on the disk, takes its place at once; after an
    error nothing changes."""
    partial = path.with_name(f".{path.name}.partial")
    partial.unlink(missing_ok=True)  # not to write through a link that somebody laid there
    try:
        with add_filename(path):
            yield partial
            with partial.open("rb+") as stream:
                os.fsync(stream.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
