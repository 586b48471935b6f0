"""Files that commands write: one that exists is replaced only on demand, and only if it carries this package's mark."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from icrl4aht_data.errors import OptionError

MARK = "icrl4aht-data"
"""Text that pictures and tables of this package have as the name of the program that made them."""

_FORMS: dict[str, tuple[bytes, bytes]] = {
    ".png": (b"\x89PNG\r\n\x1a\n", b"tEXtSoftware\0" + MARK.encode()),
    ".gif": (b"GIF8", b"!\xfe" + bytes([len(MARK)]) + MARK.encode() + b"\0"),
    ".pdf": (b"%PDF-", b"/Creator (" + MARK.encode() + b")"),
    ".svg": (b"<?xml ", b"<dc:title>" + MARK.encode() + b"</dc:title>"),
    ".parquet": (b"PAR1", MARK.encode() + b"\x18\x05index"),
    ".html": (b"<!doctype html>\n", b"<title>ICRL4AHT report"),
    ".htm": (b"<!doctype html>\n", b"<title>ICRL4AHT report"),
}
"""Suffix -> the first bytes of a file that this package writes, and a text that is near its start or end."""

_ENDS = 2**16  # bytes at either end of a file that are searched


def check_new_file(path: Path, overwrite: bool, begins: bytes | tuple[bytes, ...] | None = None) -> None:
    """Check that a command may write a file: nothing is there, or with `overwrite` a file of the form that is written.

    Args:
        path: the file to write.
        overwrite: whether to replace a file of that form.
        begins: first bytes of such a file, or several possible ones; by default those that the path's suffix implies.

    Raises:
        OptionError: if the file may not be written.
    """
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise OptionError(f"{path}: a folder is where a file is needed; give another name")
    if not overwrite:
        raise OptionError(f"{path}: exists; give another name, or replace it by --overwrite")
    first, mark = (begins, b"") if begins is not None else _FORMS.get(path.suffix.lower(), _FORMS[".parquet"])
    if not _has_form(path, first, mark):
        raise OptionError(
            f"{path}: is not a file as this command writes it; --overwrite replaces only such files: remove it "
            f"yourself, or give another name"
        )


def check_new_files(folder: Path, overwrite: bool, begins: Mapping[str, bytes | tuple[bytes, ...] | None]) -> None:
    """Check that a command may write files into a folder, which is missing or empty, or has such files to overwrite.

    Args:
        folder: the folder.
        overwrite: whether to replace files; other files of the folder stay.
        begins: name of each file to write -> the first bytes that it has, see `check_new_file`.

    Raises:
        OptionError: names the folder or the file that may not be written.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: a file is where a folder is needed; give another folder")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise OptionError(f"{folder}: exists; give another folder, or replace its files by --overwrite")
    for name, first in begins.items():
        check_new_file(folder / name, overwrite, first)


def _has_form(path: Path, first: bytes | tuple[bytes, ...], mark: bytes) -> bool:
    if not path.is_file() or path.is_symlink():
        return False
    with path.open("rb") as stream:
        start = stream.read(_ENDS)
        stream.seek(max(0, path.stat().st_size - _ENDS))
        return start.startswith(first) and (mark in start or mark in stream.read())
