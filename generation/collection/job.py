"""The job that every executor runs for a task, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from generation.collection.task import UpdateCallback, run_task
from generation.learners.resume import BusyError
from generation.profiles import Profile
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError


class CollectionError(Icrl4ahtError):
    """Some tasks have no finished artefact."""


@dataclass(frozen=True)
class TaskOutcome:
    """Result of a task.

    Attributes:
        task: the task.
        status: "done", now or before; "busy", another collector works on it; "failed".
        attempts: how often it was tried.
        error: type and message of the last error.
        trace: its traceback.
    """

    task: Task
    status: Literal["done", "busy", "failed"]
    attempts: int = 1
    error: str = ""
    trace: str = ""


@dataclass(frozen=True)
class CollectionJob:
    """Collects single tasks; it is called in this process or in a worker's.

    Attributes:
        profile: the profile of all tasks.
        artefacts: folder of all artefacts.
        suite: folder of the learned teammates, if the tasks have any.
        wait: whether to wait for other collectors instead of reporting "busy".
    """

    profile: Profile
    artefacts: Path
    suite: Path | None
    wait: bool

    def folder(self, task: Task) -> Path:
        """Folder of a task's artefact."""
        return self.artefacts / task.task_id

    def __call__(self, task: Task, on_update: UpdateCallback = lambda update, metrics: None) -> Literal["done", "busy"]:
        try:
            run_task(task, self.profile, self.folder(task), on_update, suite=self.suite, wait=self.wait)
        except BusyError:
            return "busy"
        return "done"
