"""Input of `write_release` from existing releases, read one history at a time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from icrl4aht_data.benchmark.tasks import Task, named_task, read_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files, expert_folder
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import TASKS, TEAMMATES, Kind
from icrl4aht_data.writing.release import NewHistory, NewTask

HistoryProgress = Callable[[int, int], None]
"""Callback that receives the number of histories done and their total."""


def release_tasks(dataset: Dataset) -> list[Task]:
    """Return the tasks of a dataset's release; if it stores none, `NamedTask`s made from the selected entries."""
    if dataset.knows_tasks:
        return read_tasks(dataset.origin.file(TASKS))
    return list({entry.task_id: named_task(entry.to_json()) for entry in dataset.entries}.values())


def stored_task(
    dataset: Dataset,
    task: Task,
    provenance: Provenance,
    kind: Kind,
    done: Callable[[], None] = lambda: None,
    without: Collection[str] = (),
) -> NewTask:
    """Return a task to write, with its histories and the checkpoints of its teammate and expert.

    Args:
        dataset: histories of the task.
        task: the task.
        provenance: how the histories were made.
        kind: kind of the release to write.
        done: called after each history.
        without: fields of the histories to leave out.
    """

    def load() -> Iterator[NewHistory]:
        for history in dataset:
            yield NewHistory.from_history(history, kind, without)
            done()

    files: dict[str, Path] = {}
    for one in provenance.played(task):
        if one.teammate.get("kind") == "rl":
            dataset.origin.below(f"{TEAMMATES}/{one.teammate['theta']['sha256']}")  # fetches and checks the checkpoint
        files |= checkpoint_files(dataset.root / TEAMMATES, one, dataset.root)
    if provenance.expert is not None and (sha256 := provenance.expert.policy_sha256) is not None:
        files |= expert_files(dataset.origin.below(expert_folder(sha256)), sha256, dataset.root)
    return NewTask(task, provenance, len(dataset), load, files)
