"""Paths and files of checkpoints: learned teammates in a release or a teammate suite, experts in a release."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.schema import EXPERTS, TEAMMATES
from icrl4aht_data.utils.files import check_file_size, resolve_inside

CHECKPOINT_BYTES = 64 * 2**20
"""Maximum size in bytes of a checkpoint file, sixty times the size of the paper's network."""


def checkpoint_folder(folder: Path, teammate: Mapping[str, Any]) -> Path:
    """Return the folder of a learned teammate's checkpoint.

    A release names the folders of checkpoints by hashes. A teammate suite (trained populations) has relative paths.

    Args:
        folder: the folder `TEAMMATES` of a release, or the folder of a suite.
        teammate: the task's field `teammate`, with kind "rl".
    """
    theta = teammate["theta"]
    return folder / (theta["sha256"] if (folder / theta["sha256"]).is_dir() else theta["checkpoint"])


def checkpoint_files(folder: Path, task: Task, root: Path | None = None) -> dict[str, Path]:
    """Return the checkpoint files of a task's learned teammate.

    Args:
        folder: the folder `TEAMMATES` of a release, or the folder of a suite.
        task: the task; a heuristic teammate has no files.
        root: the release folder that contains `folder`; symbolic links must not point outside the release.

    Returns:
        Files by path in a release; empty if the folder has no checkpoint.

    Raises:
        UnsafePathError: if a file is outside the release.
        IndexFormatError: if a file is not a regular file, or too large.
    """
    if task.teammate.get("kind") != "rl":
        return {}
    found = _policy_files(checkpoint_folder(folder, task.teammate), root)
    return {f"{TEAMMATES}/{task.teammate['theta']['sha256']}/{path.name}": path for path in found}


def expert_folder(sha256: str) -> str:
    """Return the path of an expert's checkpoint folder in a release, given the SHA-256 of the expert's weights."""
    return f"{EXPERTS}/{sha256}"


def expert_files(folder: Path, sha256: str, root: Path | None = None) -> dict[str, Path]:
    """Return the checkpoint files of the ego whose policy labelled a task's histories with expert actions.

    Args:
        folder: folder of the checkpoint; in a release, this is `expert_folder`.
        sha256: SHA-256 of the policy's weights.
        root: the release folder that contains `folder`; symbolic links must not point outside the release.

    Returns:
        Files by path in a release; empty if the folder has no checkpoint.

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
        check_file_size(path, CHECKPOINT_BYTES)
    return found
