"""Releases in other forms: full <-> lite, the published code's two files, a Parquet index.

The published code keeps all histories in `histories.h5`, a group each, observations as float32 in gzip-6 chunks of 4096
steps, action ids in its own order, and an index `histories_index.jsonl` of the paper's 14 fields (App. D.3). What we
write beside that, its readers pass over: each group's `state` and `episode_end_state`, `tasks.jsonl` and
`provenance.json`. With them the way back loses nothing but the checkpoints of learned teammates. Without states, which
observations do not determine, it ends in a release of observations; without tasks, in one that knows them by name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import (
    KINDS,
    OBSERVATIONS,
    PROVENANCE,
    Kind,
)
from icrl4aht_data.writing.combine import release_tasks, stored_task
from icrl4aht_data.writing.release import write_release

if TYPE_CHECKING:
    pass


HistoriesDone = Callable[[int, int], None]
"""Called with how many histories are done, and how many there are."""


def _quiet(done: int, total: int) -> None:
    pass


def to_release(dataset: Dataset, target: Path, kind: Kind, *, advance: HistoriesDone = _quiet) -> Path:
    """The selection as a release of that kind, histories in order, numbered anew from 0.

    Args:
        dataset: all of a release, or a part.
        target: the folder to make; a release that is there is replaced.
        kind: "full", "lite" or "observations"; the last alone if the dataset has no states.
        advance: progress.

    Raises:
        OptionError: if `target` holds something else, or is the dataset's own folder, or if states are needed that are
            not there.
    """
    if kind in KINDS and not dataset.has_states:
        raise OptionError(
            f"{dataset.root}: has observations only, and a {kind} release is made of state records, which observations "
            f"do not determine; convert to {OBSERVATIONS}, published or parquet"
        )
    if target.resolve() == dataset.root.resolve():
        raise OptionError(f"{target}: the release itself; give another folder")
    given = {task.task_id: task for task in release_tasks(dataset)}
    provenance = read_provenance(dataset.origin.file(PROVENANCE))
    by_task: dict[str, list[int]] = {}
    for entry in dataset.entries:
        by_task.setdefault(entry.task_id, []).append(entry.history_id)
    done = iter(range(1, len(dataset) + 1))

    tasks = [
        stored_task(
            dataset.select(ids),
            given[name],
            provenance.get(name, Provenance()),
            kind,
            lambda: advance(next(done), len(dataset)),
        )
        for name, ids in by_task.items()
    ]
    return write_release(
        target,
        kind,
        tasks,
        data_version=dataset.info.data_version,
        kept_steps=dataset.info.environment.kept_steps,
    )
