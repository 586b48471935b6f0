"""Facts that `list` and `show` print: of the tasks of a selection, and of a selection."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import numpy as np
from rich.table import Table

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.format.info import describe
from icrl4aht_data.format.schema import FIELDS, Entry
from icrl4aht_data.reading.history import LABELS


def summarize_tasks(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the facts of each task with histories among `entries`, as JSON."""
    by_task: dict[str, list[Entry]] = {}
    for entry in entries:
        by_task.setdefault(entry.task_id, []).append(entry)
    return [
        {
            "task_id": task_id,
            "layout": some[0].layout,
            "track": some[0].track,
            "split": some[0].split,
            "teammate": f"{some[0].teammate_family}/{some[0].teammate_kind}",
            "histories": len(some),
            "learners": len({entry.learner for entry in some}),
            "transitions": sum(entry.T for entry in some),
            "return_start": fmean(entry.return_start for entry in some),
            "return_end": fmean(entry.return_end for entry in some),
            "source": some[0].source,
            "labels": [kind for kind in LABELS if all(entry.has(FIELDS[f"{kind}_actions"]) for entry in some)],
            "expert_return": some[0].expert_return,
            "expert_return_sampled": some[0].expert_return_sampled,
        }
        for task_id, some in by_task.items()
    ]


def task_table(tasks: Sequence[dict[str, Any]]) -> Table:
    """Return a table of what `summarize_tasks` returned, with a row for each task."""
    names = ("layout", "split", "teammate", "source", "histories", "learners")
    table = Table(box=None, pad_edge=False)
    for name in (*names, "transitions", "return", "labels", "task"):
        table.add_column(name, no_wrap=True)
    for task in tasks:
        returns = f"{task['return_start']:.1f} -> {task['return_end']:.1f}"
        earned = "" if task["expert_return"] is None else f" {task['expert_return']:.1f}"
        labels = ", ".join(kind + earned * (kind == "expert") for kind in task["labels"]) or "-"
        facts = [str(task[name]) for name in names]
        table.add_row(*facts, f"{task['transitions']:,}", returns, labels, task["task_id"])
    return table


def summarize_selection(dataset: Dataset) -> dict[str, Any]:
    """Return the facts of a selection, as JSON: where it is, kind, versions, and counts of what it has."""
    info, remote, missing = dataset.info, dataset.origin.remote, _missing(dataset)
    content = describe(
        info.kind, info.data_version, info.environment.kept_steps, dataset.entries, info.format_version
    ).to_json()
    return {
        "root": str(dataset.origin),
        **({"revision": remote.revision, "folder": str(dataset.root)} if remote else {}),
        **content,
        "splits": dataset.counts("split"),
        "sources": dataset.counts("source"),
        "learners": len(np.unique(dataset.column("learner"))),
        "labels": dataset.counts("labels"),
        **({"missing": missing} if missing else {}),
        "cache": f"{dataset.cache.cache}: {dataset.cache.reason}",
    }


def _missing(dataset: Dataset) -> list[str]:
    """Return the parts of a full or lite release that this one does not have, in words."""
    without = len(dataset) - int(dataset.column("has_teammate_actions").sum())
    missing = {
        "state records: nothing can be replayed or drawn, obs='state' is refused": not dataset.has_states,
        "tasks: teammates are known by family and kind only": not dataset.knows_tasks,
        f"teammate actions of {without} histories": without > 0,
    }
    return [what for what, is_missing in missing.items() if is_missing]
