"""The job that every executor runs for a unit of work, and its outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_generation.collection.noise import is_noise_finished, run_noise
from icrl4aht_generation.collection.task import UpdateCallback, run_task
from icrl4aht_generation.collection.task_folder import is_task_finished
from icrl4aht_generation.learners.resume import BusyError
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.work import Work


class CollectionError(Icrl4ahtError):
    """Error: some tasks have no finished artefact."""


def _functions(source: str) -> tuple[Callable[..., bool], Callable[..., bool]]:
    """Return the functions that record the histories of a source, and that check whether they are complete."""
    return {"ppo": (run_task, is_task_finished), "noise": (run_noise, is_noise_finished)}[source]


@dataclass(frozen=True)
class TaskOutcome:
    """Result of a unit of work.

    Attributes:
        work: the unit.
        status: "done", now or before; "busy", another collector works on it; "failed".
        attempts: how often it was tried.
        error: type and message of the last error.
        trace: its traceback.
    """

    work: Work
    status: Literal["done", "busy", "failed"]
    attempts: int = 1
    error: str = ""
    trace: str = ""


@dataclass(frozen=True)
class CollectionJob:
    """Collects single units of work; it is called in this process or in a worker's.

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

    def folder(self, work: Work) -> Path:
        """Return the folder of the artefact."""
        return self.artefacts / work.name

    def is_finished(self, work: Work) -> bool:
        """Return whether the artefact is complete and unchanged."""
        return _functions(work.source)[1](self.folder(work), work, self.profile)

    def __call__(self, work: Work, on_update: UpdateCallback = lambda update, metrics: None) -> Literal["done", "busy"]:
        try:
            run, _ = _functions(work.source)
            run(work, self.profile, self.folder(work), on_update, suite=self.suite, wait=self.wait)
        except BusyError:
            return "busy"
        return "done"
