"""Releases of any number of histories, made from the bundled ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import TASKS, held_fields
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release


def write_many(folder: Path, layouts: Sequence[str], histories: int) -> Path:
    """Write a lite release with a number of histories of each layout: the bundled learners', rotated by episodes."""
    source = load_icrl4aht(split="train", source="ppo")
    first = {task.layout.name: task for task in reversed(read_tasks(source.root / TASKS))}
    tasks = [
        NewTask(first[name], Provenance(), histories, partial(_rotated, source.filter(layout=name), histories))
        for name in layouts
    ]
    return write_release(folder, "lite", tasks, data_version="0.0.0", card="# benchmark\n")


def _rotated(source: Dataset, histories: int) -> Iterator[NewHistory]:
    kept = source.info.environment.kept_steps
    for number in range(histories):
        history, episodes = source[number % len(source)], number // len(source)
        arrays = {
            field.name: np.roll(history.read(field.name), episodes * (kept if field.axis == "T" else 1), axis=0)
            for field in held_fields("lite")
            if history.entry.has(field)
        }
        yield NewHistory(number, arrays)
