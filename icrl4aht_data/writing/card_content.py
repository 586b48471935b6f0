"""The parts of a release that its card describes, and what they say about tasks and teammates."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import PARQUET_EPISODES, PROVENANCE, TASKS, Entry
from icrl4aht_data.utils.files import files_below

PARQUET_INDEX = "index"
"""Folder of the index as Parquet files, `index/<layout>/<split>.parquet`, in a release built for publication."""


@dataclass(frozen=True)
class CardContent:
    """The parts of a release that its card describes.

    Args:
        info: meta/info.json.
        entries: the index.
        tasks: the tasks; empty if they are unknown.
        provenance: task id -> how its histories were made.
        files: paths in the release; the card refers to those figures, Parquet files and source cards that are there.
    """

    info: ReleaseInfo
    entries: Sequence[Entry]
    tasks: Sequence[Task]
    provenance: Mapping[str, Provenance]
    files: frozenset[str] = field(default_factory=frozenset)

    @property
    def has_parquet(self) -> bool:
        """Whether the release has the index as Parquet files."""
        return any(name.startswith(f"{PARQUET_INDEX}/") for name in self.files)

    @property
    def has_parquet_episodes(self) -> bool:
        """Whether the release has the episodes as Parquet files."""
        return any(name.startswith(f"{PARQUET_EPISODES}/") for name in self.files)

    def distinct(self, name: str) -> list[Any]:
        """Return the values of a field of the tasks' provenance, each once."""
        values = [getattr(of_task, name) for of_task in self.provenance.values()]
        found = {json.dumps(value, default=asdict): value for value in values if value is not None}
        return [found[text] for text in sorted(found)]

    def groups(self, *names: str) -> dict[tuple[str, ...], list[Entry]]:
        """Return the index entries grouped by the values of some fields, in order of first appearance."""
        groups: dict[tuple[str, ...], list[Entry]] = {}
        for entry in self.entries:
            groups.setdefault(tuple(getattr(entry, name) for name in names), []).append(entry)
        return groups

    @cached_property
    def histories(self) -> dict[str, list[Entry]]:
        """Return the index entries of each task."""
        return {task_id: members for (task_id,), members in self.groups("task_id").items()}

    @cached_property
    def headroom(self) -> dict[str, bool]:
        """Return for each layout whether the ego matters with any of its teammates; empty where it is unknown."""
        layouts: dict[str, bool] = {}
        for task_id, members in self.histories.items():
            references = self.provenance.get(task_id, Provenance()).references
            if references is not None:
                layout = members[0].layout
                layouts[layout] = layouts.get(layout, False) or references.matters
        return layouts


def read_content(root: Path) -> CardContent:
    """Return the content of a release on disk; it needs no README.md and no manifest yet.

    Raises:
        ReleaseError: if the release cannot be read.
    """
    index, provenance = read_index(root), read_provenance(root / PROVENANCE)
    return CardContent(
        index.info, list(index.entries), read_tasks(root / TASKS), provenance, frozenset(files_below(root))
    )


def mean_rise(histories: Sequence[Entry]) -> float:
    """Mean of what the last episodes of histories earn more than the first."""
    return float(np.mean([entry.return_end - entry.return_start for entry in histories]))


def share_risen(histories: Sequence[Entry], least: float) -> float:
    """Share of the histories whose last episodes earn more than the first by at least so much."""
    return float(np.mean([entry.return_end - entry.return_start >= least for entry in histories]))
