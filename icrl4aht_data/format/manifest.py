"""MANIFEST.sha256: path and SHA-256 of every file of a release, in the format of `sha256sum`.

The manifest has hashes of the chunk tables in `meta/chunks/`, and the chunk tables have hashes of all parts of the
shards, so every byte of a release can be checked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

from icrl4aht_data.errors import ChunkTableError, IndexFormatError, UnsafePathError
from icrl4aht_data.format.schema import EXPERTS, INDEX_FILES, MANIFEST, PARQUET_EPISODES, PARQUET_INDEX, TEAMMATES
from icrl4aht_data.utils.files import (
    file_hash,
    is_safe_path,
    read_text,
    resolve_inside,
    size_checked_hash,
    write_atomically,
)

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")

_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"
_KNOWN = re.compile(
    "|".join(
        (
            r"README\.md|card\.json|LICENSE|CITATION\.cff|croissant\.json",
            r"meta/(info\.json|histories\.jsonl|tasks\.jsonl|layouts\.jsonl|provenance\.json|source_card\.md)",
            rf"data/{_NAME}/{_NAME}/{_NAME}\.h5",
            rf"meta/chunks/{_NAME}/{_NAME}/{_NAME}\.npy",
            rf"({TEAMMATES}|{EXPERTS})/[0-9a-f]{{64}}/(policy\.json|policy\.safetensors|README\.md)",
            rf"figures/{_NAME}\.(png|svg)",
            rf"({PARQUET_INDEX}|{PARQUET_EPISODES})/{_NAME}/{_NAME}\.parquet",
        )
    )
)
"""Pattern of the paths that a release may contain. All other paths are rejected, because other programs could run the
content of a downloaded file such as .git/config, sitecustomize.py or x.pth."""


@lru_cache(maxsize=16)
def parse_manifest(text: str, path: Path | str) -> Mapping[str, str]:
    """Parse a manifest, and return the SHA-256 of each file by path in the release; results are cached.

    Args:
        text: content of the manifest.
        path: path or address of the manifest, for error messages.

    Raises:
        IndexFormatError: if the manifest is empty or a line is malformed; the message has the line number.
        UnsafePathError: if a path points outside the release, or is not the path of a release's file.
    """
    if not text:
        raise IndexFormatError(f"{path} is empty: expected a line for each file of the release; download it again")
    if not text.endswith("\n"):
        raise IndexFormatError(f"{path} is cut off: the last line does not end with a newline; download it again")
    listed: dict[str, str] = {}
    folded: dict[str, str] = {}  # lower-case name -> name, to find names that differ only in case
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise IndexFormatError(f"{path}, line {number}: expected '<sha256>  <path>', found {line[:200]!r}")
        digest, name = match.groups()
        if not is_safe_path(name):
            raise UnsafePathError(
                f"{path}, line {number}: {name!r} points outside the release: do not use it, and warn the publisher"
            )
        if not _KNOWN.fullmatch(name):
            raise UnsafePathError(
                f"{path}, line {number}: {name[:200]!r} is not a file that a release may contain: do not use it, and "
                f"warn the publisher; if a later version of this package wrote the release, update the package"
            )
        if name in listed:
            raise IndexFormatError(f"{path}, line {number}: {name!r} is listed twice; fetch the release again")
        twin = folded.setdefault(name.casefold(), name)
        if twin != name:
            raise IndexFormatError(
                f"{path}, line {number}: {name!r} and {twin!r} are the same file on some systems: warn the publisher"
            )
        listed[name] = digest
    return MappingProxyType(listed)


def read_manifest(folder: Path) -> Mapping[str, str]:
    """Read the manifest of a release folder; `parse_manifest` describes the result and the errors."""
    path = resolve_inside(folder, MANIFEST)
    return parse_manifest(read_text(path), path)


def check_against_manifest(root: Path, names: Iterable[str]) -> None:
    """Check files of a release folder against their hashes in the manifest.

    Args:
        root: the release folder.
        names: paths of the files, relative to `root`.

    Raises:
        IndexFormatError, ChunkTableError: if a file is missing, not listed or has another hash, or if the manifest is
            missing or invalid; the message has the expected and the found hash.
    """
    manifest, listed = root / MANIFEST, read_manifest(root)
    for name in names:
        path = resolve_inside(root, name)
        kind = ChunkTableError if name.startswith("meta/chunks/") else IndexFormatError
        try:
            found = size_checked_hash(path)
        except IndexFormatError as error:
            raise kind(str(error)) from error
        if name not in listed:
            raise kind(f"{path}: {manifest} does not list this file; fetch the release again")
        if found != listed[name]:
            raise kind(
                f"{path}: expected sha256 {listed[name]} from {MANIFEST}, found {found}: the file is damaged or was "
                f"edited; `icrl4aht-data download` replaces the file"
            )


def check_meta(root: Path) -> None:
    """Check the files in `INDEX_FILES` that are listed or present, see `check_against_manifest`."""
    listed = read_manifest(root)
    check_against_manifest(root, sorted(name for name in INDEX_FILES if name in listed or (root / name).exists()))


def write_manifest(root: Path, known: Mapping[str, str] | None = None) -> None:
    """Write MANIFEST.sha256 with the hashes of all other files of a folder.

    Args:
        root: the folder.
        known: SHA-256 by path, for files that need not be hashed again.

    Raises:
        UnsafePathError: if the folder has a file that a release may not contain.
    """
    known = known or {}
    names = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    foreign = [name for name in names if name != MANIFEST and not _KNOWN.fullmatch(name)]
    if foreign:
        raise UnsafePathError(f"{root}: {foreign[0]!r} is not a file that a release may contain; remove it")
    lines = [f"{known.get(name) or file_hash(root / name)}  {name}\n" for name in names if name != MANIFEST]
    write_atomically(root / MANIFEST, "".join(lines))
