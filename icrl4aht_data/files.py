"""Text and JSON files: whatever is wrong with one becomes an error that names it; written whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import IndexFormatError


def read_text(path: Path) -> str:
    """A text file's content.

    Raises:
        IndexFormatError: if it is missing, unreadable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
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
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # also too many digits, too deep
        raise IndexFormatError(f"not JSON: {error}") from error


def write_json(path: Path, content: Any) -> None:
    """Indented, for people."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def json_hash(content: Any) -> str:
    """Of settings: the first 16 hexadecimal digits of SHA-256 of their JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the disk name the file: those of writing to an open one do not."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def file_in_place_of(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to. At the end the file takes its place at once; after an error nothing changes."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with naming(path):
            yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
