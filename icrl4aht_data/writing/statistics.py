"""A release's statistics per layout: the rows of the paper's table "Dataset statistics per layout"."""

from __future__ import annotations

import json
from collections.abc import Sequence
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np
from rich import box, filesize
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.info import LayoutStatistics, ReleaseInfo
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import Entry
from icrl4aht_data.overcooked.actions import ACTIONS

_ROWS = {
    "original_transitions": "Original transitions",
    "filtered_transitions": "Filtered transitions",
    "history_length": "History length",
    "teammates": "Num. teammates",
    "steps_per_episode": "Steps per episode",
    "obs_shape": "Obs. shape",
    "actions": "Num. actions",
    "mean_final_return": "Mean final return",
    "disk_bytes": "Disk size (compressed)",
}


def layout_statistics(
    root: Path, entries: Sequence[Entry], tasks: Sequence[Task], provenance: dict[str, Provenance], kept_steps: int
) -> dict[str, LayoutStatistics]:
    """layout -> the paper's properties, as numbers. The shards must be in `root`.

    original_transitions is what the learners' streams held before the filter, null where a provenance does not say;
    teammates is null where the tasks were not given; history_length is the shortest and the longest; mean_final_return
    is over histories, `return_end` of each.
    """
    return {
        layout: _of_layout(root, [e for e in entries if e.layout == layout], tasks, provenance, kept_steps)
        for layout in dict.fromkeys(entry.layout for entry in entries)
    }


def _of_layout(
    root: Path, entries: list[Entry], tasks: Sequence[Task], provenance: dict[str, Provenance], kept_steps: int
) -> LayoutStatistics:
    lengths = {entry.task_id: entry.T for entry in entries}
    steps = [entry.T for entry in entries]
    recorded = [provenance.get(task_id, Provenance()).streams_recorded for task_id in lengths]
    streams = [number for number in recorded if number is not None]
    teammates = {json.dumps(task.teammate, sort_keys=True) for task in tasks if task.task_id in lengths}
    return LayoutStatistics(
        original_transitions=sum(map(mul, streams, lengths.values())) if len(streams) == len(recorded) else None,
        filtered_transitions=sum(steps),
        history_length=(min(steps), max(steps)),
        teammates=len(teammates) or None,
        steps_per_episode=kept_steps,
        obs_shape=entries[0].obs_shape,
        actions=len(ACTIONS),
        mean_final_return=round(float(np.mean([entry.return_end for entry in entries])), 3),
        disk_bytes=sum((root / shard).stat().st_size for shard in {entry.shard for entry in entries}),
    )


def statistics_rows(statistics: dict[str, LayoutStatistics]) -> list[list[str]]:
    """The table in words: a row per property, which names it and has a cell per layout."""
    return [
        [label, *(_in_words(name, getattr(of_layout, name)) for of_layout in statistics.values())]
        for name, label in _ROWS.items()
    ]


def print_statistics(info: ReleaseInfo, console: Console) -> None:
    """The table of a release's meta/info.json: a row per property, a column per layout."""
    statistics = info.statistics
    table = Table("property", box=box.MARKDOWN, title=escape(f"{info.kind} release {info.data_version}"))
    for layout in statistics:
        table.add_column(layout, justify="right")
    for row in statistics_rows(statistics):
        table.add_row(*row)
    console.print(table, width=max(console.width, 30 + 16 * len(statistics)), crop=False)


def _in_words(name: str, value: Any) -> str:
    if value is None:
        return "unknown"
    if name == "history_length":
        return f"{value[0]:,}" if value[0] == value[1] else f"{value[0]:,} to {value[1]:,}"
    if name == "obs_shape":
        return f"({', '.join(map(str, value))})"
    if name == "disk_bytes":
        return filesize.decimal(value)
    return f"{value:,}"
