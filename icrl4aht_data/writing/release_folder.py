"""Atomic writing of folders; a folder is replaced only on request, and only if this package wrote the folder."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import Timeout

from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.fetch import is_address
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.utils.files import explain_full_disk, files_below, lock_file_path, process_lock

HISTORIES_H5, HISTORIES_INDEX = "histories.h5", "histories_index.jsonl"
"""Names of the two main files of the published format."""

_CONVERTED = (
    {HISTORIES_H5, HISTORIES_INDEX, "tasks.jsonl", "provenance.json"},
    {"data/main_data.hdf5", "data/metadata.json"},
)
"""Files in folders that this package converted: to the published format, and to a Minari dataset."""


def as_path(target: object) -> Path:
    """Return the given path of an output folder or file as a `Path`.

    Raises:
        OptionError: if the argument is neither a path nor a string.
    """
    if not isinstance(target, (str, Path)):
        raise OptionError(f"{target!r:.100}: expected the path of a folder or file to write")
    return Path(target)


@contextmanager
def atomic_folder(target: Path, *, overwrite: bool = False, sources: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Yield a temporary folder to fill, which is renamed to `target` if the block ends without an error.

    Args:
        target: the folder to write.
        overwrite: whether to replace a release, or a folder of converted files, at `target`.
        sources: folders that the block reads; addresses of remote releases are ignored.

    Raises:
        OptionError: if `check_target` fails before or after the block, or another process is writing the folder.
        DiskFullError: if the disk is full; the temporary folder is removed.
    """
    sources = tuple(sources)
    check_target(target, overwrite, sources)
    target = target.resolve()
    new, old = (target.with_name(f".{target.name}.{end}") for end in ("partial", "old"))
    with explain_full_disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with process_lock(lock_file_path(target), wait=False):
                if old.exists() and not target.exists():  # a run was killed between the two steps of `_replace`
                    old.rename(target)
                    check_target(target, overwrite, sources)
                for leftover in (new, old):
                    shutil.rmtree(leftover, ignore_errors=True)
                try:
                    new.mkdir()
                    with explain_full_disk(target):  # measure the free space before `new` is removed
                        yield new
                    check_target(target, overwrite, sources)
                    _replace(target, new, old)
                finally:
                    for leftover in (new, old):
                        shutil.rmtree(leftover, ignore_errors=True)
        except Timeout as error:
            raise OptionError(
                f"{target}: another process is writing this folder; wait until it ends, or give another folder"
            ) from error


def check_target(target: Path, overwrite: bool, sources: Iterable[str | Path] = ()) -> bool:
    """Check that a folder may be written, that is, that the folder is missing, empty, or may be replaced.

    Args:
        target: the folder to write.
        overwrite: whether to allow replacing a release, or a folder of converted files, that has no other files.
        sources: folders to read from; none may be the target, be inside it, or contain it.

    Returns:
        Whether the target exists and will be replaced.

    Raises:
        OptionError: if the folder may not be written.
    """
    resolved = target.resolve()
    for source in (Path(source) for source in sources if not is_address(source)):
        read = source.resolve()
        if read.is_relative_to(resolved) or resolved.is_relative_to(read):
            raise OptionError(f"{target}: overlaps the input folder {source}; give another folder to write")
    if not os.path.lexists(target) or (resolved.is_dir() and not any(resolved.iterdir())):
        return False
    if not overwrite:
        raise OptionError(f"{target}: exists; give another folder, or use --overwrite to replace it")
    if fault := _refusal_reason(resolved):
        raise OptionError(
            f"{target} {fault}; --overwrite replaces only releases and converted files: remove the folder, or give "
            f"another folder"
        )
    return True


def _refusal_reason(folder: Path) -> str | None:
    """Return why a path may not be replaced, such as "is not a folder"; None for a folder that this package made."""
    if not folder.is_dir():
        return "is not a folder"
    present = set(files_below(folder))
    if any(files & present and present <= files for files in _CONVERTED):
        return None
    if MANIFEST not in present:
        return f"is not a release: it has no {MANIFEST}"
    try:
        foreign = sorted(present - {MANIFEST, *read_manifest(folder)})
    except Icrl4ahtError as error:
        return f"is not a release: {error}"
    return f"contains {foreign[0]}, which {MANIFEST} does not list" if foreign else None


def _replace(target: Path, new: Path, old: Path) -> None:
    """Rename the folder `target`, if it exists, to `old`, and the folder `new` to `target`."""
    if target.exists():
        target.rename(old)
    try:
        new.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise
