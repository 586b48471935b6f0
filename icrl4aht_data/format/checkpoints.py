"""Checkpoints of learned teammates in a release or in a suite of populations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.schema import TEAMMATES
from icrl4aht_data.utils.files import plain_size
from icrl4aht_data.utils.paths import resolve_inside

CHECKPOINT_BYTES = 64 * 2**20
"""Most bytes of each file of a learned teammate, sixty times the paper's network."""


def checkpoint_folder(folder: Path, teammate: Mapping[str, Any]) -> Path:
    """Folder of a learned teammate's checkpoint: named by its hash in a release, by its path in a suite.

    Args:
        folder: TEAMMATES of a release, or a suite.
        teammate: the task's entry, of kind "rl".
    """
    theta = teammate["theta"]
    return folder / (theta["sha256"] if (folder / theta["sha256"]).is_dir() else theta["checkpoint"])


def checkpoint_files(folder: Path, task: Task, root: Path | None = None) -> dict[str, Path]:
    """The files of a task's learned teammate.

    Args:
        folder: see `checkpoint_folder`.
        task: the task; a heuristic teammate has no files.
        root: the release that the folder is in; symbolic links must not lead out of it.

    Returns:
        Path in a release -> file; empty if the folder has no checkpoint.

    Raises:
        UnsafePathError: if a file is outside the release.
        IndexFormatError: if a file is not a regular file, or too large.
    """
    if task.teammate.get("kind") != "rl":
        return {}
    found = sorted(checkpoint_folder(folder, task.teammate).glob("policy.*"))
    for path in found:
        if root is not None:
            resolve_inside(root, path.relative_to(root).as_posix())
        plain_size(path, CHECKPOINT_BYTES)
    return {f"{TEAMMATES}/{task.teammate['theta']['sha256']}/{path.name}": path for path in found}
