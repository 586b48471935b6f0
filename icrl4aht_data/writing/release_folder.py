"""Atomic replacement of a release folder."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import Timeout

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import INFO
from icrl4aht_data.utils.locks import lock_beside, process_lock


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield a new folder to fill, which replaces the release at `target` if the block ends without an error.

    Raises:
        OptionError: if `target` exists and is not a release, or if another process is writing it.
    """
    target = target.resolve()
    check_replaceable(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    new, old = (target.with_name(f".{target.name}.{end}") for end in ("partial", "old"))
    try:
        with process_lock(lock_beside(target), wait=False):
            if old.exists() and not target.exists():  # a writer was killed between the two renames below
                old.rename(target)
            for leftover in (new, old):
                shutil.rmtree(leftover, ignore_errors=True)
            new.mkdir()
            try:
                yield new
                if target.exists():
                    target.rename(old)
                new.rename(target)
            finally:
                for leftover in (new, old):
                    shutil.rmtree(leftover, ignore_errors=True)
    except Timeout as error:
        raise OptionError(f"{target}: another process is writing it; wait for it, or give another folder") from error


def check_replaceable(target: Path) -> None:
    """Check that a release may be written at a path: nothing, an empty folder or a release may be there.

    Raises:
        OptionError: if there is anything else.
    """
    if target.exists() and not (target.is_dir() and ((target / INFO).exists() or not any(target.iterdir()))):
        raise OptionError(f"{target}: exists and is not a release; give another folder or remove it")
