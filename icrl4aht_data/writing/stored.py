"""Input of `write_release` from existing releases, read one array at a time."""

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
"""Callback that receives the number of histories done and their total."""


class LazyArrays(Mapping[str, np.ndarray]):
    """Arrays of one history, each read on access, so that a shard's arrays need not fit in memory.

    Args:
        names: names of the fields.
        read: function that returns the array of a field.
    """

    def __init__(self, names: Sequence[str], read: Callable[[str], np.ndarray]) -> None:
        self._names, self._read = names, read

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        return self._read(name)

    def __contains__(self, name: object) -> bool:  # the inherited method would read the array
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def release_tasks(dataset: Dataset) -> list[Task]:
    """Return the tasks of a dataset's release; if it stores none, `NamedTask`s made from the selected entries."""
    if dataset.knows_tasks:
        return read_tasks(dataset.origin.file(TASKS))
    return list({entry.task_id: named_task(entry.to_json()) for entry in dataset.entries}.values())


def stored_task(
    dataset: Dataset, task: Task, provenance: Provenance, kind: Kind, done: Callable[[], None] = lambda: None
) -> NewTask:
    """Return a task to write, with its histories and the checkpoints of its teammate and expert.

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
        dataset.origin.below(f"{TEAMMATES}/{task.teammate['theta']['sha256']}")  # fetches and checks the checkpoint
    files = checkpoint_files(dataset.root / TEAMMATES, task, dataset.root)
    if provenance.expert is not None and (sha256 := provenance.expert.policy_sha256) is not None:
        files |= expert_files(dataset.origin.below(expert_folder(sha256)), sha256, dataset.root)
    return NewTask(task, with_source(provenance, dataset.entries[0].source), len(dataset), load, files)


def with_source(provenance: Provenance, source: str) -> Provenance:
    """Return provenance with the histories' source, which format version 3 stores only in the index."""
    return provenance if source == (provenance.source or "ppo") else replace(provenance, source=source)
