"""Select teammates of tasks from the checkpoints of a suite (paper, App. B.1 "Checkpoint Quality Filtering")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from icrl4aht_data.benchmark.facts import ALGORITHMS, TRACKS, layout_number, layout_track
from icrl4aht_data.benchmark.tasks import Task, make_task, write_tasks
from icrl4aht_data.utils.files import file_hash, lock_file_path, process_lock
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS
from icrl4aht_generation.populations.train import SuiteCheckpoint, suite_checkpoints

THRESHOLD = 20.0
"""Return of 400 steps that a teammate must exceed (paper, App. B.1)."""


@dataclass(frozen=True)
class TeammateSelection:
    """Teammates selected from one population.

    Attributes:
        layout: name of the layout.
        algorithm: the population's algorithm.
        candidates: number of the population's checkpoints.
        good: number of checkpoints with returns above the threshold.
        train: teammates of training tasks.
        heldout: teammates of held-out tasks.
    """

    layout: str
    algorithm: str
    candidates: int
    good: int
    train: list[SuiteCheckpoint]
    heldout: list[SuiteCheckpoint]


def select_teammates(
    suite: Path, layout: str, algorithm: str, train: int, heldout: int, seed: int = 0
) -> TeammateSelection:
    """Select random teammates from the checkpoints whose return as a teammate is above the threshold.

    The members of the population take turns, because checkpoints of one member are similar. If the checkpoints are too
    few for both splits, at most a fifth of the checkpoints is held out.

    Args:
        suite: the suite's folder.
        layout: name of the layout.
        algorithm: the population's algorithm.
        train: maximum number of training teammates.
        heldout: maximum number of held-out teammates.
        seed: seed of the random selection.

    Raises:
        OptionError: if the population is not finished.
    """
    candidates = list(suite_checkpoints(suite, layout, algorithm))
    good = [point for point in candidates if point.card["teammate_return"] > THRESHOLD]
    order = np.random.default_rng([seed, ALGORITHMS.index(algorithm)]).permutation(len(good))
    held_out = min(heldout, max(len(good) - train, len(good) // 5))
    chosen = _members_in_turn([good[k] for k in order])
    return TeammateSelection(
        layout, algorithm, len(candidates), len(good), chosen[held_out : held_out + train], chosen[:held_out]
    )


def _members_in_turn(points: Sequence[SuiteCheckpoint]) -> list[SuiteCheckpoint]:
    """Reorder checkpoints: the first checkpoint of every member, then the second of every member, and so on."""
    members = pd.Series([point.card["member"] for point in points], dtype=int)
    turns = members.groupby(members).cumcount()
    return [points[k] for k in np.argsort(turns, kind="stable")]


def make_tasks(suite: Path, selections: Sequence[TeammateSelection], split: str) -> list[Task]:
    """Return one task for each teammate, with a seed that does not depend on the rest of the suite."""
    tasks = []
    for selection in selections:
        first = 10_000 * (layout_number(selection.layout) + 1) + 1_000 * ALGORITHMS.index(selection.algorithm)
        chosen = selection.train if split == "train" else selection.heldout
        for number, point in enumerate(chosen):
            entry = {
                "kind": "rl",
                "family": selection.algorithm,
                "theta_id": number,
                "base_seed": point.card["seed"],
                "theta": {"checkpoint": point.path, "sha256": file_hash(suite / point.path / POLICY_WEIGHTS)},
            }
            seed = first + number + (split != "train") * len(selection.train)
            tasks.append(make_task(layout_track(selection.layout), split, selection.layout, entry, seed))
    return tasks


def write_manifests(suite: Path, selections: Sequence[TeammateSelection]) -> list[Path]:
    """Write manifests for all tracks that have teammates, and return their paths.

    The files are SUITE/manifests/<track>_train.jsonl and SUITE/manifests/<track>_heldout.jsonl.
    """
    folder = suite / "manifests"
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with process_lock(lock_file_path(folder)):  # several processes may train one suite
        for track in TRACKS:
            own = [selection for selection in selections if layout_track(selection.layout) == track]
            for split in ("train", "heldout"):
                path, tasks = folder / f"{track}_{split}.jsonl", make_tasks(suite, own, split)
                if not tasks:
                    path.unlink(missing_ok=True)
                    continue
                write_tasks(path, tasks)
                written.append(path)
    return written
