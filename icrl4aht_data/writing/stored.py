"""Histories of existing releases as input of `write_release`, read one array at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from icrl4aht_data.benchmark.tasks import Task, named_task, read_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files, expert_folder
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import TASKS, TEAMMATES, Kind, held_fields
from icrl4aht_data.writing.release import NewHistory, NewTask

HistoryProgress = Callable[[int, int], None]
"""Called with the number of histories done, and their total."""


class LazyArrays(Mapping[str, np.ndarray]):
    """The arrays of one history, each read when it is accessed, so that a shard's arrays need not fit in memory.

    Args:
        names: names of the fields.
        read: returns the array of a field.
    """

    def __init__(self, names: Sequence[str], read: Callable[[str], np.ndarray]) -> None:
        self._names, self._read = names, read

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        return self._read(name)

    def __contains__(self, name: object) -> bool:  # the base class would read the array
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def release_tasks(dataset: Dataset) -> list[Task]:
    """Return the tasks of a selection's release; without given tasks those of the selection, known by name only."""
    if dataset.knows_tasks:
        return read_tasks(dataset.origin.file(TASKS))
    return list({entry.task_id: named_task(entry.to_json()) for entry in dataset.entries}.values())


def stored_task(
    dataset: Dataset, task: Task, provenance: Provenance, kind: Kind, done: Callable[[], None] = lambda: None
) -> NewTask:
    """Return a task to write, with all histories of a selection in order, and the checkpoints of teammate and expert.

    Args:
        dataset: histories of the task.
        task: the task.
        provenance: how the histories were made.
        kind: kind of the release to write.
        done: called after each history.
    """

    def load() -> Iterator[NewHistory]:
        for history in dataset:
            stored = history.entry.stored_fields(kind)
            names = [field.name for field in held_fields(kind) if field in stored]
            yield NewHistory(history.entry.env_idx, LazyArrays(names, history.read), history.entry.learner)
            done()

    if task.teammate.get("kind") == "rl":
        dataset.origin.below(f"{TEAMMATES}/{task.teammate['theta']['sha256']}")  # fetched and checked
    files = checkpoint_files(dataset.root / TEAMMATES, task, dataset.root)
    if provenance.expert is not None and (sha256 := provenance.expert.policy_sha256) is not None:
        files |= expert_files(dataset.origin.below(expert_folder(sha256)), sha256, dataset.root)
    return NewTask(task, with_source(provenance, dataset.entries[0].source), len(dataset), load, files)


def with_source(provenance: Provenance, source: str) -> Provenance:
    """Return provenance that says how the histories were made, which releases of version 3 say in the index only."""
    return provenance if source == (provenance.source or "ppo") else replace(provenance, source=source)
