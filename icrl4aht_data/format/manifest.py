"""MANIFEST.sha256: every file of a release and its hash, in sha256sum's format; and paths that stay in a release."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path

from icrl4aht_data.errors import IndexFormatError, UnsafePathError
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.utils.files import atomic_write, read_text
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import is_inside, resolve_inside

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def parse_manifest(text: str, path: Path | str) -> dict[str, str]:
    """File -> SHA-256.

    Raises:
        IndexFormatError: names the line.
        UnsafePathError: for a path that leads out of the release.
    """
    if text and not text.endswith("\n"):
        raise IndexFormatError(f"{path}: cut off: its last line has no end; fetch it again")
    listed: dict[str, str] = {}
    folded: dict[str, str] = {}  # as a disk sees names that does not tell upper from lower case
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise IndexFormatError(f"{path}, line {number}: expected '<sha256>  <path>', found {line[:200]!r}")
        digest, name = match.groups()
        if not is_inside(name):
            raise UnsafePathError(
                f"{path}, line {number}: {name!r} leads out of the release: do not use it, and tell whoever sent it"
            )
        if name in listed:
            raise IndexFormatError(f"{path}, line {number}: {name!r} stands twice")
        twin = folded.setdefault(unicodedata.normalize("NFC", name).casefold(), name)
        if twin != name:
            raise IndexFormatError(f"{path}, line {number}: {name!r} and {twin!r} are one file on some systems")
        listed[name] = digest
    for key, name in folded.items():
        ends = (place for place, character in enumerate(key) if character == "/")
        if any(key[:end] in folded for end in ends):
            raise IndexFormatError(f"{path}: {name!r} lies in what is a file by another line")
    return listed


def read_manifest(folder: Path) -> dict[str, str]:
    """The same of a release folder."""
    path = resolve_inside(folder, MANIFEST)
    return parse_manifest(read_text(path), path)


def write_manifest(root: Path, known: Mapping[str, str] | None = None) -> None:
    """Write MANIFEST.sha256 over every other file of a folder.

    Args:
        root: the folder.
        known: file -> SHA-256 of files that need not be read.
    """
    known = known or {}
    names = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    lines = [f"{known.get(name) or file_hash(root / name)}  {name}\n" for name in names if name != MANIFEST]
    with atomic_write(root / MANIFEST) as partial:
        partial.write_text("".join(lines), encoding="utf-8")
