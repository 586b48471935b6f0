"""Hashes of files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def git_hash(content: bytes) -> str:
    """Git's hash of a file's content, hexadecimal: the Hub identifies small files by it."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def hashes_hold(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether every file (path in the folder -> SHA-256) still has its hash.

    Raises:
        OSError: if one cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())
