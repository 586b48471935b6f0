"""Atomic writing of a folder, which replaces another one only on demand, and only one that this package provably wrote.

A folder is proved by its manifest: it lists every file of the folder, and each has the hash that the manifest says.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import Timeout

from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError
from icrl4aht_data.format.manifest import is_known_file, read_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST
from icrl4aht_data.remote.remote_release import is_address
from icrl4aht_data.utils.files import (
    explain_full_disk,
    files_below,
    final_name,
    lock_path,
    process_lock,
    read_text,
    resolve_inside,
)
from icrl4aht_data.utils.hashes import file_hash

HISTORIES_H5, HISTORIES_INDEX = "histories.h5", "histories_index.jsonl"
"""File names of the published code."""

PUBLISHED_FILES = (HISTORIES_H5, HISTORIES_INDEX, "tasks.jsonl", "provenance.json")
"""Files that a conversion to the published format writes."""

MINARI_FILES = ("data/main_data.hdf5", "data/metadata.json")
"""Files of a Minari dataset."""

CONVERTED_FILES = (*PUBLISHED_FILES, *MINARI_FILES)
"""Files that conversions write to folders that are not releases."""

LISTING = "files.sha256"
"""Their hashes, in sha256sum's format."""

Snapshot = dict[str, tuple[int, int, int]]
"""File of a folder -> its inode, size and time of change in nanoseconds."""


@contextmanager
def atomic_folder(
    target: Path, *, overwrite: bool = False, sources: Iterable[str | Path] = (), keep_equal: bool = False
) -> Iterator[Path]:
    """Yield a new folder to fill, which becomes `target` if the block ends without an error.

    Args:
        target: the folder to write.
        overwrite: replace a release or converted published files at `target`.
        sources: folders that are read meanwhile; addresses are ignored.
        keep_equal: without `overwrite`, accept a folder that would be replaced if the new one has the same files.

    Raises:
        OptionError: as `check_target`, before the block and again after it; if another process is writing the folder;
            if a folder has the name of a temporary one.
        DiskFullError: if the disk is full; nothing is left of the new folder then.
    """
    sources = tuple(sources)
    before = _published_files(target, sources) if keep_equal and not overwrite else {}
    before = before or check_target(target, overwrite, sources)
    target = target.resolve()
    with explain_full_disk(target), _locked_folder(target, overwrite or bool(before), sources, before) as folder:
        yield folder
        if before and not overwrite and _hashes(folder) != _hashes(target):
            raise OptionError(f"{target}: exists with other files; give another folder, or replace it by --overwrite")


@contextmanager
def _locked_folder(target: Path, overwrite: bool, sources: Iterable[str | Path], before: Snapshot) -> Iterator[Path]:
    target.parent.mkdir(parents=True, exist_ok=True)
    new, old = (target.with_name(f".{target.name}.{end}") for end in ("partial", "old"))
    lock = lock_path(target)
    try:
        with process_lock(lock, wait=False):
            for leftover in (new, old):
                if not _was_left_by_a_writer(leftover):
                    raise OptionError(f"{leftover}: was not left by this package; move it away, or give another folder")
            try:
                if old.exists() and not target.exists():  # a writer was killed between the two renames below
                    old.rename(target)
                    before = check_target(target, overwrite, sources)
                for leftover in (new, old):
                    shutil.rmtree(leftover, ignore_errors=True)
                new.mkdir()
                with explain_full_disk(target):  # before the space is freed
                    yield new
                _replace(target, new, old, overwrite, before)
            finally:
                for leftover in (new, old):
                    shutil.rmtree(leftover, ignore_errors=True)
    except Timeout as error:
        raise OptionError(f"{target}: another process is writing it; wait for it, or give another folder") from error


def check_target(target: Path, overwrite: bool, sources: Iterable[str | Path] = ()) -> Snapshot:
    """Check that a folder may be written: it must not exist, except empty, or with `overwrite` as a folder of ours.

    Args:
        target: the folder to write.
        overwrite: whether to replace a release or converted published files.
        sources: folders that are read meanwhile, none equal to the target, inside or around it.

    Returns:
        The files to replace.

    Raises:
        OptionError: if the folder may not be written.
    """
    resolved = target.resolve()
    for source in (Path(source) for source in sources if not is_address(source)):
        read = source.resolve()
        if read == resolved:
            raise OptionError(f"{target}: is also read; give another folder")
        if read.is_relative_to(resolved) or resolved.is_relative_to(read):
            relation = "contains" if read.is_relative_to(resolved) else "is inside"
            raise OptionError(f"{target}: {relation} {source}, which is read; give another folder")
    if not os.path.lexists(target) or (resolved.is_dir() and not any(resolved.iterdir())):
        return {}
    if not overwrite:
        raise OptionError(f"{target}: exists; give another folder, or replace it by --overwrite")
    before = _snapshot(resolved)
    fault = _foreign_content(resolved, before)
    if fault:
        raise OptionError(
            f"{target}: {fault}; --overwrite replaces only what this package wrote, unchanged: remove the folder "
            f"yourself, or give another one"
        )
    return before


def write_listing(folder: Path) -> None:
    """Write the hashes of converted files, published or Minari's, next to them."""
    names = [name for name in CONVERTED_FILES if (folder / name).is_file()]
    (folder / LISTING).write_text("".join(f"{file_hash(folder / name)}  {name}\n" for name in names), encoding="utf-8")


def _read_listing(folder: Path) -> dict[str, str]:
    """Return the hashes that `write_listing` wrote.

    Raises:
        IndexFormatError: if there is no such file, or if it has another form.
    """
    lines = [line.split("  ", 1) for line in read_text(resolve_inside(folder, LISTING)).splitlines()]
    if not all(len(line) == 2 and line[1] in CONVERTED_FILES for line in lines):
        raise IndexFormatError(f"{folder / LISTING}: expected hashes of {', '.join(CONVERTED_FILES)}")
    return {name: digest for digest, name in lines}


def _published_files(target: Path, sources: Iterable[str | Path]) -> Snapshot:
    """Return the files of a folder that `to_published` wrote; empty for anything else."""
    try:
        return check_target(target, True, sources) if (target / LISTING).is_file() else {}
    except OptionError:
        return {}


def _hashes(folder: Path) -> dict[str, str]:
    return {name: file_hash(folder / name) for name in files_below(folder)}


def _was_left_by_a_writer(folder: Path) -> bool:
    """Return whether nothing is there, or a folder with files as this package writes them only."""
    own = {*CONVERTED_FILES, LISTING, MANIFEST}
    if not os.path.lexists(folder):
        return True
    if folder.is_symlink() or not folder.is_dir():
        return False
    names = map(final_name, files_below(folder))
    return all(name in own or is_known_file(name) for name in names)


def _snapshot(folder: Path) -> Snapshot:
    statuses = {name: (folder / name).lstat() for name in files_below(folder)} if folder.is_dir() else {}
    return {name: (status.st_ino, status.st_size, status.st_mtime_ns) for name, status in statuses.items()}


def _foreign_content(folder: Path, present: Iterable[str]) -> str | None:
    """Return what of a folder this package did not write, in words; None if it wrote everything."""
    if not folder.is_dir():
        return "is not a folder"
    if not {MANIFEST, LISTING} & set(present):
        return f"is not a release: it has no {MANIFEST}"
    try:
        own, listed = (MANIFEST, read_manifest(folder)) if MANIFEST in present else (LISTING, _read_listing(folder))
    except Icrl4ahtError as error:
        return f"is not a release: {error}"
    kinds = ({INFO, HISTORIES}, {HISTORIES_H5, HISTORIES_INDEX}, set(MINARI_FILES))
    if not any(files <= listed.keys() for files in kinds):
        return f"is not a release: its {own} does not list {INFO}"
    for name in sorted(set(present) - {own}):
        if name not in listed:
            return f"has {name}, which its {own} does not list"
        if (folder / name).is_symlink() or file_hash(folder / name) != listed[name]:
            return f"{name} is not the file that was written, its hash differs from {own}"
    return None


def _replace(target: Path, new: Path, old: Path, overwrite: bool, before: Snapshot) -> None:
    """Rename the new folder to the target, and what was there to `old`."""
    if target.is_dir() and any(target.iterdir()):
        if not overwrite or _snapshot(target) != before:
            raise OptionError(f"{target}: was changed while its replacement was written; nothing is replaced")
        target.rename(old)
    try:
        new.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise
