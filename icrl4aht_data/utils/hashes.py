"""Hashes of files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def short_hash(data: bytes, digits: int = 16) -> str:
    """Return the first hexadecimal digits of a text's SHA-256."""
    return hashlib.sha256(data).hexdigest()[:digits]


def hashes_hold(folder: Path, files: Mapping[str, str]) -> bool:
    """Return whether all files of a folder (path -> SHA-256) have the given hashes.

    Raises:
        OSError: if a file cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())
