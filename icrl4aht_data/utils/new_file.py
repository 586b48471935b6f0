"""Names of `icrl4aht_data.utils.files.check_output` that are to go."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from icrl4aht_data.utils.files import check_output


def check_new_file(path: Path, overwrite: bool, begins: object = None) -> None:
    """Check that a command may write a file, see `check_output`."""
    check_output(path, overwrite)


def check_new_files(folder: Path, overwrite: bool, begins: Iterable[str]) -> None:
    """Check that a command may write files into a folder, see `check_output`."""
    check_output(folder, overwrite, begins)
