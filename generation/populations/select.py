"""From a suite's checkpoints to tasks: the quality filter (paper, App. B.1 "Checkpoint Quality Filtering")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from generation.learners.checkpoint import WEIGHTS
from generation.populations.train import Checkpoint, checkpoints
from icrl4aht_data.benchmark.facts import ALGORITHMS, LAYOUT_NAMES, TRACKS, track_of
from icrl4aht_data.benchmark.tasks import Task, make_task, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.hashes import file_hash

THRESHOLD = 20.0
"""Returns of 400 steps that a teammate must exceed (paper, App. B.1)."""


@dataclass(frozen=True)
class Selection:
    """What the filter left of one population."""

    layout: str
    algorithm: str
    candidates: int
    good: int  # above the threshold
    train: list[Checkpoint]
    heldout: list[Checkpoint]


def select(suite: Path, layout: str, algorithm: str, train: int, heldout: int, seed: int = 0) -> Selection:
    """Draw teammates from the checkpoints whose return as teammates exceeds the threshold.

    Drawn from the sorted list with a fixed seed. Where there are too few for both, the held-out ones are at most a
    fifth.

    Raises:
        OptionError: if the population was not finished.
    """
    candidates = list(checkpoints(suite, layout, algorithm))
    good = [point for point in candidates if _return_as_teammate(suite, point) > THRESHOLD]
    order = np.random.default_rng([seed, ALGORITHMS.index(algorithm)]).permutation(len(good))
    apart = min(heldout, max(len(good) - train, len(good) // 5))
    chosen = [good[k] for k in order]
    return Selection(layout, algorithm, len(candidates), len(good), chosen[apart : apart + train], chosen[:apart])


def _return_as_teammate(suite: Path, point: Checkpoint) -> float:
    try:
        return point.card["teammate_return"]
    except KeyError as error:
        raise OptionError(
            f"{suite / point.path}: its card lacks 'teammate_return', it was made by an earlier version: train the "
            f"suite anew, in another folder"
        ) from error


def make_tasks(suite: Path, selections: Sequence[Selection], split: str) -> list[Task]:
    """One task per teammate, each with a seed of its own, whatever else is in the suite."""
    tasks = []
    for selection in selections:
        first = 10_000 * (layout_number(selection.layout) + 1) + 1_000 * ALGORITHMS.index(selection.algorithm)
        chosen = selection.train if split == "train" else selection.heldout
        for number, point in enumerate(chosen):
            entry = _entry(suite, selection.algorithm, number, point)
            seed = first + number + (split != "train") * len(selection.train)
            tasks.append(make_task(track_of(selection.layout), split, selection.layout, entry, seed))
    return tasks


def layout_number(layout: str) -> int:
    """A layout's place among all, for seeds."""
    return LAYOUT_NAMES.index(layout)


def _entry(suite: Path, algorithm: str, number: int, point: Checkpoint) -> dict[str, Any]:
    return {
        "kind": "rl",
        "family": algorithm,
        "theta_id": number,
        "base_seed": point.card["seed"],
        "theta": {"checkpoint": point.path, "sha256": file_hash(suite / point.path / WEIGHTS)},
    }


def write_manifests(suite: Path, selections: Sequence[Selection]) -> list[Path]:
    """SUITE/manifests/<track>_train.jsonl and _heldout.jsonl of the tracks that have teammates."""
    folder = suite / "manifests"
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with FileLock(folder.with_name(f".{folder.name}.lock")):  # several processes may train one suite
        for track in TRACKS:
            own = [selection for selection in selections if track_of(selection.layout) == track]
            for split in ("train", "heldout"):
                path, tasks = folder / f"{track}_{split}.jsonl", make_tasks(suite, own, split)
                if not tasks:
                    path.unlink(missing_ok=True)
                    continue
                with atomic_write(path) as partial:
                    write_tasks(partial, tasks)
                written.append(path)
    return written
