"""MANIFEST.sha256: every file of a release and its hash, in sha256sum's format; and paths that stay in a release."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from icrl4aht_data.errors import IndexFormatError, UnsafePathError
from icrl4aht_data.files import file_in_place_of, read_text
from icrl4aht_data.schema import MANIFEST

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def parse_manifest(text: str, path: Path | str) -> dict[str, str]:
    """File -> SHA-256.

    Raises:
        IndexFormatError: names the line.
        UnsafePathError: for a path that leads out of the release.
    """
    listed: dict[str, str] = {}
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
        listed[name] = digest
    return listed


def read_manifest(folder: Path) -> dict[str, str]:
    """The same of a release folder."""
    return parse_manifest(read_text(folder / MANIFEST), folder / MANIFEST)


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


def hashes_hold(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether every file (path in the folder -> SHA-256) is as it was.

    Raises:
        OSError: if one cannot be read.
    """
    return all(file_hash(folder / name) == digest for name, digest in files.items())


def is_inside(name: str) -> bool:
    """Whether a relative path names a file below its root on every system: no "..", drive, backslash, control code."""
    parts = name.split("/")
    plain = all(part not in ("", ".", "..") for part in parts) and not PurePosixPath(name).is_absolute()
    return plain and not re.search(r'[\\:*?"<>|\x00-\x1f\x7f]', name) and len(name) < 1024


def inside(folder: Path, name: str) -> Path:
    """The path of a release's file, if it is in the release, symbolic links followed.

    A folder of the Hub's cache holds links to the blobs beside its snapshots; these are followed as well.

    Raises:
        UnsafePathError: names both.
    """
    path = folder / name
    allowed = [folder.resolve()]
    if folder.parent.name == "snapshots" and (folder.parent.parent / "blobs").is_dir():
        allowed.append((folder.parent.parent / "blobs").resolve())
    found = path.resolve()
    if not is_inside(name) or not any(found.is_relative_to(root) for root in allowed):
        raise UnsafePathError(f"{path}: leads out of the release, to {found}; do not use this release")
    return path
