"""Hashes of files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from icrl4aht_data.utils.system import in_slices, usable_cores

_BLOCK = 2**24  # bytes hashed at a time by one thread


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def block_hash(path: Path) -> str:
    """SHA-256, hexadecimal, of the SHA-256 of each 16 MiB of a file: all cores work on a large file."""
    blocks = -(-path.stat().st_size // _BLOCK)
    digests = [b""] * blocks

    def work(start: int, stop: int) -> None:
        with path.open("rb", buffering=0) as stream:
            stream.seek(start * _BLOCK)
            for number in range(start, stop):
                digests[number] = hashlib.sha256(stream.read(_BLOCK)).digest()

    in_slices(work, blocks, usable_cores())
    return hashlib.sha256(b"".join(digests)).hexdigest()


def git_hash(content: bytes) -> str:
    """Git's hash of a file's content, hexadecimal: the Hub identifies small files by it."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def hashes_hold(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether every file (path in the folder -> SHA-256) still has its hash.

    Raises:
        OSError: if one cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())
