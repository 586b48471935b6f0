"""Combination of several releases into one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from msgspec.structs import replace

from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.provenance import MeanStreamReturns, Provenance
from icrl4aht_data.writing.convert import release_tasks, stored_task
from icrl4aht_data.writing.release import NewTask, write_release


def combine_releases(
    target: str | Path,
    roots: Sequence[str | Path | Dataset],
    data_version: str | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Combine releases, or selections of their histories, into one release whose histories are numbered from 0.

    As in new releases, a task's oracle actions are left out if the oracle earns less than the histories' final return.

    Args:
        target: the folder to write.
        roots: releases of the same kind and episode length without common tasks; a `Dataset` may be a selection of
            histories.
        data_version: version of the new release; by default the common version of the releases.
        overwrite: whether to replace a release at `target`.

    Raises:
        OptionError: if the releases differ in kind or environment, or share a task; if `data_version` is not SemVer; if
            `target` may not be written, see `release_folder.check_target`.
        ReleaseError: if a release cannot be read.
    """
    if not roots or isinstance(roots, (str, Path, Dataset)):
        raise OptionError(f"expected a list of at least one release to combine, found {roots!r}")
    datasets = [root if isinstance(root, Dataset) else load_icrl4aht(root) for root in roots]
    first = datasets[0].info
    for other, name in product(datasets[1:], ("kind", "environment")):
        found, expected = getattr(other.info, name), getattr(first, name)
        if found != expected:
            raise OptionError(
                f"{other.root} has {name} {found!r}, but {datasets[0].root} has {expected!r}; combine only releases of "
                f"one kind and environment"
            )
    versions = {dataset.info.data_version for dataset in datasets}
    if data_version is None and len(versions) > 1:
        raise OptionError(f"data versions {', '.join(sorted(versions))} differ: give the new release a data version")
    tasks = _new_tasks(datasets)
    written = {new.task.task_id for new in tasks}
    left_out = dict.fromkeys(task for dataset in datasets for task in dataset.info.left_out)
    return write_release(
        target,
        first.kind,
        tasks,
        data_version=versions.pop() if data_version is None else data_version,
        kept_steps=first.environment.kept_steps,
        left_out=[task for task in left_out if task.task_id not in written],
        overwrite=overwrite,
        sources=[dataset.root for dataset in datasets],
    )


def _new_tasks(datasets: Sequence[Dataset]) -> list[NewTask]:
    owners: dict[str, Dataset] = {}
    tasks = []
    for dataset in datasets:
        chosen = dataset.column("task_id")
        present = set(chosen.tolist())
        for task in (task for name, task in release_tasks(dataset).items() if name in present):
            histories = dataset.select(chosen == task.task_id)
            owner = owners.setdefault(task.task_id, dataset)
            if owner is not dataset:
                raise OptionError(
                    f"{dataset.origin}: task {task.task_id} is also in {owner.origin}; leave one of the tasks out, or "
                    f"generate one with another seed"
                )
            made = dataset.provenance.of(task.task_id)
            partial = len(histories) < len(dataset.index.query(task_id=task.task_id))
            if partial and made.streams_kept is not None:
                made = _partial_provenance(made, histories)
            weak = not made.is_oracle_useful(float(histories.column("return_end").mean()))
            without = ("oracle_actions",) if weak else ()
            tasks.append(stored_task(histories, task, made, dataset.info.kind, without=without))
    return tasks


def _partial_provenance(made: Provenance, histories: Dataset) -> Provenance:
    """Return a task's provenance for a release that has only some of the task's histories."""
    kept = len(histories)
    if made.filter is None:
        return replace(made, streams_kept=kept)
    start, end = (round(float(histories.column(name).mean()), 3) for name in ("return_start", "return_end"))
    return replace(made, streams_kept=kept, filter=replace(made.filter, after=MeanStreamReturns(kept, start, end)))
