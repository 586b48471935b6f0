"""Conversion of releases to another kind (full, lite, observations) and to the current format version."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from icrl4aht_data.benchmark.tasks import Task, named_task
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files, expert_folder
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import KINDS, OBSERVATIONS, TEAMMATES, Kind
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

HistoryProgress = Callable[[int, int], None]
"""Callback that receives the number of finished histories and the number of all histories."""


def release_tasks(dataset: Dataset) -> Mapping[str, Task]:
    """Return the tasks of a dataset by id; if the release stores no tasks, a `NamedTask` for each id in the index."""
    return dataset.tasks or {entry.task_id: named_task(entry.to_json()) for entry in dataset.entries}


def stored_task(
    dataset: Dataset,
    task: Task,
    provenance: Provenance,
    kind: Kind,
    done: Callable[[], None] = lambda: None,
    without: Collection[str] = (),
) -> NewTask:
    """Return a task of a release as a `NewTask`, with histories and the checkpoints of teammate and expert.

    Args:
        dataset: histories of the task.
        task: the task.
        provenance: how the histories were made.
        kind: kind of the release to write.
        done: function called after each history.
        without: names of fields to leave out of the histories.
    """

    def load_histories() -> Iterator[NewHistory]:
        for history in dataset:
            yield NewHistory.from_history(history, kind, without)
            done()

    files: dict[str, Path] = {}
    for one in provenance.played_tasks(task):
        if one.teammate.get("kind") == "rl":
            dataset.origin.fetch_folder(f"{TEAMMATES}/{one.teammate['theta']['sha256']}")
        files |= checkpoint_files(dataset.root / TEAMMATES, one, dataset.root)
    if provenance.expert is not None and (sha256 := provenance.expert.policy_sha256) is not None:
        files |= expert_files(dataset.origin.fetch_folder(expert_folder(sha256)), sha256, dataset.root)
    return NewTask(task, provenance, len(dataset), load_histories, files)


def to_release(
    dataset: Dataset,
    target: str | Path,
    kind: Kind,
    *,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Path:
    """Write a selection as a release of the current format version, with histories numbered from 0.

    Args:
        dataset: a release, or a selection of its histories.
        target: the folder to write.
        kind: "full", "lite" or "observations"; a dataset without states supports only "observations".
        overwrite: whether to replace a release at `target`.
        advance: function called with the number of written histories and the number of all histories.

    Raises:
        OptionError: if `target` may not be written, see `release_folder.check_target`, or if `kind` needs states but
            the dataset has no states.
    """
    if kind in KINDS and not dataset.has_states:
        raise OptionError(
            f"{dataset.root} has observations only, but a {kind} release needs state records, which cannot be derived "
            f"from observations; convert to {OBSERVATIONS}, published or parquet"
        )
    tasks, provenance = release_tasks(dataset), dataset.provenance
    numbers = iter(range(1, len(dataset) + 1))

    def count_history() -> None:
        advance(next(numbers), len(dataset))

    return write_release(
        target,
        kind,
        [
            stored_task(
                dataset.select([one.history_id for one in own]), tasks[name], provenance.of(name), kind, count_history
            )
            for name, own in grouped(dataset.entries, lambda entry: entry.task_id).items()
        ],
        data_version=dataset.info.data_version,
        kept_steps=dataset.info.environment.kept_steps,
        left_out=[task for task in dataset.info.left_out if task.layout in {one.name for one in dataset.layouts}],
        overwrite=overwrite,
        sources=[dataset.root],
    )
