"""Several releases as one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.tasks import Task, named_task, read_tasks
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.checkpoints import checkpoint_files
from icrl4aht_data.format.info import check_version
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import MANIFEST, PROVENANCE, TASKS, TEAMMATES, Kind, held_fields
from icrl4aht_data.remote.remote_release import is_address
from icrl4aht_data.utils.files import read_text
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.writing.dataset_card import SOURCE_CARD
from icrl4aht_data.writing.release import CARD, NewHistory, NewTask, write_release


def combine_releases(
    target: Path,
    roots: Sequence[str | Path],
    data_version: str | None = None,
    done: Callable[[Task], None] = lambda task: None,
) -> Path:
    """Write a release that has the histories of several, in order, under new history ids.

    Args:
        target: the folder to make; a release there is replaced when the new one is complete.
        roots: releases of one kind, one format and one episode length, no two with a task in common.
        data_version: of the combination; that of the releases by default, if they agree.
        done: called when a task's histories have been taken.

    Raises:
        OptionError: if the releases do not go together; names both, and what they disagree on; if `data_version` is
            not of the form of SemVer.
        ReleaseError: if one of them cannot be read.
    """
    if data_version is not None:
        check_version(data_version)
    if not roots:
        raise OptionError("expected at least one release to combine")
    datasets = [load_icrl4aht(root) for root in roots]
    for root in roots:
        if not is_address(root) and Path(root).resolve() == target.resolve():
            raise OptionError(f"{target}: is one of the releases to combine; give another folder")
    _check_alike(datasets)
    owners: dict[str, str] = {}
    new = []
    for dataset in datasets:
        provenance = read_provenance(dataset.origin.file(PROVENANCE))
        for task in release_tasks(dataset):
            if task.task_id in owners:
                raise OptionError(
                    f"{dataset.origin}: task {task.task_id} is also in {owners[task.task_id]}; leave one of them out"
                )
            owners[task.task_id] = str(dataset.origin)
            ids = dataset.index.query(task_id=task.task_id)
            new.append(
                stored_task(dataset.select(ids), task, provenance.get(task.task_id, Provenance()), dataset.info.kind)
            )
    first = datasets[0].info
    return write_release(
        target,
        first.kind,
        new,
        data_version=data_version or _one_version(datasets),
        source_card=_cards(datasets),
        kept_steps=first.environment.kept_steps,
        done=done,
    )


def _check_alike(datasets: Sequence[Dataset]) -> None:
    first = datasets[0]
    expected = first.info.to_json()
    for other in datasets[1:]:
        info = other.info.to_json()
        for name, remedy in (
            ("format_version", "rebuild the older one"),
            ("kind", "combine releases of one kind"),
            ("environment", "they cannot be combined"),
        ):
            if info[name] != expected[name]:
                raise OptionError(
                    f"{other.root}: {name} {info[name]!r}, but {first.root} has {expected[name]!r}; {remedy}"
                )


def _one_version(datasets: Sequence[Dataset]) -> str:
    versions = {dataset.info.data_version for dataset in datasets}
    if len(versions) > 1:
        raise OptionError(f"data versions {', '.join(sorted(versions))}: say which one the combination has")
    return versions.pop()


def release_tasks(dataset: Dataset) -> list[Task]:
    """The tasks of a selection's release; of a release whose tasks were not given, those of the selection, by name."""
    if dataset.knows_tasks:
        return read_tasks(dataset.origin.file(TASKS))
    return list({entry.task_id: named_task(entry.to_json()) for entry in dataset.entries}.values())


def stored_task(
    dataset: Dataset, task: Task, provenance: Provenance, kind: Kind, taken: Callable[[], None] = lambda: None
) -> NewTask:
    """A task for another release of that kind: all histories of the selection, in order, and the teammate's checkpoint.

    Args:
        dataset: histories of the task.
        taken: called after each history.
    """

    def load() -> Iterator[NewHistory]:
        for history in dataset:
            names = [field.name for field in held_fields(kind) if history.entry.has(field)]
            yield NewHistory(history.entry.env_idx, Deferred(names, history.read))
            taken()

    files = checkpoint_files(dataset.origin.below(TEAMMATES), task, dataset.root)
    return NewTask(task, provenance, len(dataset), load, files)


class Deferred(Mapping[str, np.ndarray]):
    """A history's arrays, each read when it is asked for, so that a shard's worth of them need not fit in memory."""

    def __init__(self, names: Sequence[str], read: Callable[[str], np.ndarray]) -> None:
        self._names, self._read = names, read

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        return self._read(name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _cards(datasets: Sequence[Dataset]) -> str:
    listed = [read_manifest(dataset.root) for dataset in datasets]
    parts = "\n".join(
        f"* {dataset.root.name}: data version {dataset.info.data_version}, {len(dataset):,} histories, "
        f"SHA-256 of its manifest {file_hash(dataset.root / MANIFEST)}"
        for dataset in datasets
    )
    cards = "\n".join(
        _text_of_card(read_text(dataset.origin.file(name)))
        for dataset, names in zip(datasets, listed, strict=True)
        for name in (CARD, SOURCE_CARD)
        if name == CARD or name in names
    )
    return (
        f"# ICRL4AHT learning histories, combined\n\nOf these releases, whose own cards follow:\n\n{parts}\n\n{cards}"
    )


def _text_of_card(card: str) -> str:
    """Without YAML, which may stand only at a file's beginning, and pictures, which do not go along."""
    return re.sub(r"\A---\n(?s:.*?)\n---\n|^!\[.*\n\n?", "", card, flags=re.MULTILINE)
