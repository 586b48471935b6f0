"""Functions that damage a file in different ways."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np


def file_contents(folder: Path) -> dict[str, bytes]:
    """Return the content of each file below a folder, by relative path."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def flip_bit(path: Path, position: int = -1, bit: int = 0) -> None:
    """Invert one bit of a file."""
    data = bytearray(path.read_bytes())
    data[position] ^= 1 << bit
    path.write_bytes(bytes(data))


def _flip_bit_keeping_times(path: Path) -> None:
    """Invert one bit of a file and restore the file's access and modification times."""
    before = path.stat()
    flip_bit(path, before.st_size // 2)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def _replace_by_array(path: Path) -> None:
    """Replace a file by a valid NumPy file with an unrelated array."""
    np.save(path.with_name("other.npy"), np.arange(7))
    path.with_name("other.npy").replace(path)


def _make_folder(path: Path) -> None:
    path.unlink()
    (path / "deep").mkdir(parents=True)


def _make_link(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.with_name("nowhere"))


def _make_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "a bit flipped": flip_bit,
    "a bit flipped, times as before": _flip_bit_keeping_times,
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "longer": lambda path: os.truncate(path, path.stat().st_size + 1),
    "missing": lambda path: path.unlink(),
    "foreign": _replace_by_array,
    "text": lambda path: path.write_text("hello\n"),
    "a folder": _make_folder,
    "a dangling link": _make_link,
    "a pipe": _make_pipe,
}
"""Name of a damage -> function that damages an existing file in this way."""


def restore_file(path: Path, data: bytes) -> None:
    """Write a file with the given content, after removing the file, folder or link at its path."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.write_bytes(data)
