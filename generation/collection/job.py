"""TODO."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from generation.collection.task import Report, run_task
from generation.learners.resume import BusyError
from generation.profiles import Profile
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError


class CollectionError(Icrl4ahtError):
    """Some tasks have no finished artefact."""


@dataclass(frozen=True)
class Outcome:
    """What became of a task: done (here or before), left to the collector that is at it, or failed."""

    task: Task
    status: Literal["done", "busy", "failed"]
    attempts: int = 1
    error: str = ""
    trace: str = ""


@dataclass(frozen=True)
class Job:
    """What an executor does with a task."""

    profile: Profile
    artefacts: Path
    suite: Path | None  # of the learned teammates
    wait: bool  # for other collectors

    def folder(self, task: Task) -> Path:
        return self.artefacts / task.task_id

    def __call__(self, task: Task, report: Report = lambda update, metrics: None) -> Literal["done", "busy"]:
        try:
            run_task(task, self.profile, self.folder(task), report, suite=self.suite, wait=self.wait)
        except BusyError:
            return "busy"
        return "done"
