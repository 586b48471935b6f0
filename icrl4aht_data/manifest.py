"""MANIFEST.sha256: every file of a release and its hash, in sha256sum's format; and paths that stay in a release."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import unicodedata
from collections.abc import Iterator, Mapping
from pathlib import Path

from icrl4aht_data.errors import IndexFormatError, UnsafePathError
from icrl4aht_data.files import file_in_place_of, read_text
from icrl4aht_data.schema import MANIFEST

LARGEST = 4 * 2**30
"""Bytes that a file of a release may have, if it is no shard."""

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # a name that Windows keeps for itself
_RESERVED = re.compile(r'[\\:*?"<>|]')
_PART = 200  # bytes between two slashes: what is written beside a file has a longer name


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
    path = inside(folder, MANIFEST)
    return parse_manifest(read_text(path), path)


def write_manifest(root: Path) -> None:
    """MANIFEST.sha256 over every other file of the folder."""
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != MANIFEST)
    lines = [f"{file_hash(path)}  {path.relative_to(root).as_posix()}\n" for path in files]
    with file_in_place_of(root / MANIFEST) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def git_hash(content: bytes) -> str:
    """Git's name for a file's content, hexadecimal: the Hub's for what it keeps in git itself."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def hashes_hold(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether every file (path in the folder -> SHA-256) is as it was.

    Raises:
        OSError: if one cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())


def files_below(folder: Path) -> Iterator[str]:
    """The names of all that is in a folder, at any depth, but for folders; links are not followed."""
    folders = [""]
    while folders:
        at = folders.pop()
        entries = _entries(folder / at)
        if entries is None and at:
            yield at
        for name, is_folder in entries or ():
            if is_folder:
                folders.append(f"{at}{name}/")
            else:
                yield at + name


def _entries(folder: Path) -> list[tuple[str, bool]] | None:
    """What is in a folder: names, and whether each is a folder; None if it cannot be read."""
    try:
        with os.scandir(folder) as found:
            return [(entry.name, entry.is_dir(follow_symlinks=False)) for entry in found]
    except OSError:
        return None


def is_inside(name: str) -> bool:
    """Whether a relative path names a file below its root on every system: no "..", drive, backslash, control code."""
    if len(name) >= 1024 or not name.isprintable() or _RESERVED.search(name):
        return False
    return all(map(_is_part, name.split("/")))


def _is_part(part: str) -> bool:
    return 0 < len(part.encode()) <= _PART and part[-1] not in ". " and not _DEVICE.fullmatch(part)


def inside(folder: Path, name: str) -> Path:
    """The path of a release's file, if it is in the release, symbolic links followed, and a file or a folder if it is.

    A folder of the Hub's cache holds links to the blobs beside its snapshots; these are followed as well.

    Raises:
        UnsafePathError: names both.
    """
    path = folder / name
    if not is_inside(name):
        raise UnsafePathError(f"{folder}: {name[:200]!r} leads out of the release; do not use this release")
    allowed = [folder.resolve()]
    if folder.parent.name == "snapshots" and (folder.parent.parent / "blobs").is_dir():
        allowed.append((folder.parent.parent / "blobs").resolve())
    try:
        found = path.resolve()
        if not any(found.is_relative_to(root) for root in allowed):
            raise UnsafePathError(f"{path}: leads out of the release, to {found}; do not use this release")
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return path
    except (OSError, RuntimeError) as error:  # links in a circle, names that this disk does not take
        raise UnsafePathError(f"{path}: cannot be followed: {error}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnsafePathError(f"{path}: neither a file nor a folder; do not use this release")
    return path
