"""Checkpoints in a release: of learned teammates, which a suite of populations has too, and of egos as experts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.schema import EXPERTS, TEAMMATES
from icrl4aht_data.utils.files import plain_size, resolve_inside

CHECKPOINT_BYTES = 64 * 2**20
"""Most bytes of each file of a checkpoint, sixty times the paper's network."""


def checkpoint_folder(folder: Path, teammate: Mapping[str, Any]) -> Path:
    """Return the folder of a learned teammate's checkpoint: named by its hash in a release, by its path in a suite.

    Args:
        folder: TEAMMATES of a release, or a suite.
        teammate: the task's entry, of kind "rl".
    """
    theta = teammate["theta"]
    return folder / (theta["sha256"] if (folder / theta["sha256"]).is_dir() else theta["checkpoint"])


def checkpoint_files(folder: Path, task: Task, root: Path | None = None) -> dict[str, Path]:
    """Return the files of a task's learned teammate.

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
    found = _policy_files(checkpoint_folder(folder, task.teammate), root)
    return {f"{TEAMMATES}/{task.teammate['theta']['sha256']}/{path.name}": path for path in found}


def expert_folder(sha256: str) -> str:
    """Return the folder of an ego's checkpoint in a release, by the SHA-256 of its weights."""
    return f"{EXPERTS}/{sha256}"


def expert_files(folder: Path, sha256: str, root: Path | None = None) -> dict[str, Path]:
    """Return the files of the ego's checkpoint that the expert actions of a task come from.

    Args:
        folder: the checkpoint's folder, in a release `expert_folder`.
        sha256: SHA-256 of its weights.
        root: the release that the folder is in; symbolic links must not lead out of it.

    Returns:
        Path in a release -> file; empty if there is no checkpoint.

    Raises:
        UnsafePathError: if a file is outside the release.
        IndexFormatError: if a file is not a regular file, or too large.
    """
    return {f"{expert_folder(sha256)}/{path.name}": path for path in _policy_files(folder, root)}


def _policy_files(folder: Path, root: Path | None) -> list[Path]:
    found = sorted(folder.glob("policy.*"))
    for path in found:
        if root is not None:
            resolve_inside(root, path.relative_to(root).as_posix())
        plain_size(path, CHECKPOINT_BYTES)
    return found
