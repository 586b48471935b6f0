"""What the executors of a collection share: jobs, their outcomes, the log of failures, and the progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.utils.files import NO_ROOM, atomic_write, process_lock, read_text
from icrl4aht_generation.collection.noise import is_noise_finished, run_noise
from icrl4aht_generation.collection.task import UpdateCallback, run_task
from icrl4aht_generation.collection.task_folder import is_task_finished
from icrl4aht_generation.learners.resume import BusyError
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.work import Work

FAILED = "failed.jsonl"
"""File name of the log of failed units of work and their errors; its `task_id` is the name of the artefact."""


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


class FailureLog:
    """One line per failed task that still has no artefact. Collectors may share the file.

    On a full disk, changes are kept in memory until a later write succeeds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: dict[str, dict[str, Any] | None] = {}  # name -> its new line, or None to remove it

    @property
    def is_written(self) -> bool:
        """Whether all changes have been written to the disk."""
        return not self._waiting

    def add(self, outcome: TaskOutcome) -> None:
        """Add a task's line, or replace the one of an earlier attempt."""
        name, details = outcome.work.name, {"attempts": outcome.attempts, "error": outcome.error}
        self._change({name: {"task_id": name, **details, "traceback": outcome.trace}})

    def forget(self, names: Iterable[str]) -> None:
        """Remove the lines of tasks that are finished."""
        self._change(dict.fromkeys(names))

    def _change(self, changes: dict[str, dict[str, Any] | None]) -> None:
        self._waiting |= changes
        try:
            with process_lock(self.path.with_name(f".{self.path.name}.lock")):
                found = [json.loads(x) for x in read_text(self.path).splitlines()] if self.path.exists() else []
                before = {line["task_id"]: line for line in found}
                after = {name: line for name, line in (before | self._waiting).items() if line}
                if not after:
                    self.path.unlink(missing_ok=True)
                elif after != before:
                    with atomic_write(self.path) as partial:
                        partial.write_text("".join(json.dumps(x) + "\n" for x in after.values()), encoding="utf-8")
            self._waiting.clear()
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise


class TaskBoard:
    """Progress display that sums the reports of single tasks.

    Args:
        show: function of `progress_bars`.
        updates: name of each task's artefact -> number of its updates.
    """

    def __init__(self, show: Callable[..., None], updates: Mapping[str, int]) -> None:
        self._show_bar, self._updates = show, dict(updates)
        self._ended: set[str] = set()
        self._running: dict[str, tuple[int, float]] = {}
        self._show()

    def show_running(self, name: str, updates: int, steps_per_second: float) -> None:
        """Show the number of updates that a running task has done."""
        self._running[name] = updates, steps_per_second
        self._show()

    def show_ended(self, name: str) -> None:
        """Show that a task is finished or has failed."""
        self._running.pop(name, None)
        self._ended.add(name)
        self._show()

    def _show(self) -> None:
        updates = sum(self._updates[name] for name in self._ended) + sum(done for done, _ in self._running.values())
        speed = sum(speed for _, speed in self._running.values())
        note = f"{len(self._ended)}/{len(self._updates)} tasks" + (f", {speed:,.0f} steps/s" if speed else "")
        self._show_bar("all tasks", updates, sum(self._updates.values()), note)
