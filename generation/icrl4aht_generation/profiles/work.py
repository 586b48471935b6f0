"""Unit of work of a collection: one artefact, made by one process."""

from __future__ import annotations

from typing import NamedTuple

from icrl4aht_data.benchmark.tasks import Task


class Work(NamedTuple):
    """One artefact to make.

    Attributes:
        task: the task.
        source: how its histories are made: "ppo", by an ego that learns, "noise" or "search", by a script.
        learner: number of the learner among the independent ones of the task.
    """

    task: Task
    source: str = "ppo"
    learner: int = 0

    @property
    def name(self) -> str:
        """Name of the artefact's folder."""
        return f"{self.task.task_id}-l{self.learner}" if self.learner else self.task.task_id
