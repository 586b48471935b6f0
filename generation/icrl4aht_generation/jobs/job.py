"""What the executors of a queue share: jobs, their outcomes, the log of failures, and the progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.utils.files import NO_ROOM, atomic_write, process_lock, read_text
from icrl4aht_generation.jobs.options import request_determinism
from icrl4aht_generation.learners.resume import BusyError, limit_xla_threads

FAILED = "failed.jsonl"
"""File name of the log of failed jobs and their errors; its `task_id` is the name of the job."""

OnUpdate = Callable[[int, float], None]
"""Called with (updates done, steps per second)."""


class FailedJobsError(Icrl4ahtError):
    """Error: some jobs have not finished."""


class Job(Protocol):
    """A long computation that makes one folder and resumes by itself. Jobs are pickled for workers."""

    @property
    def name(self) -> str:
        """Name that no other job of the queue has."""
        ...

    @property
    def label(self) -> str:
        """Name for people."""
        ...

    @property
    def updates(self) -> int:
        """Number of its updates, the unit of its progress."""
        ...

    @property
    def xla_threads(self) -> int | None:
        """Threads of XLA on a CPU, on which its bits depend; None for all cores."""
        ...

    @property
    def is_quick(self) -> bool:
        """Whether it takes seconds. Quick jobs share a process and what it compiled; others have their own process, so
        that its memory is released."""
        ...

    def is_finished(self) -> bool:
        """Return whether its result is complete and unchanged."""
        ...

    def progress(self) -> tuple[int, float] | None:
        """Return updates done and steps per second as its folder states them, perhaps written by another process."""
        ...

    def finished_text(self) -> str:
        """Return the text on the finished job."""
        ...

    def run(self, on_update: OnUpdate, wait: bool) -> None:
        """Do it, or what is left of it.

        Args:
            on_update: called after each update.
            wait: whether to wait for another process that does it.

        Raises:
            BusyError: if another process does it and this one is not to wait.
        """
        ...


@dataclass(frozen=True)
class JobOutcome:
    """Outcome of a job.

    Attributes:
        job: the job.
        status: "done", now or before; "busy", another process does it; "failed".
        attempts: how often it was tried.
        error: type and message of the last error.
        trace: its traceback.
    """

    job: Job
    status: Literal["done", "busy", "failed"]
    attempts: int = 1
    error: str = ""
    trace: str = ""


def run_job(job: Job, wait: bool, on_update: OnUpdate = lambda update, speed: None) -> Literal["done", "busy"]:
    """Run a job in this process."""
    try:
        job.run(on_update, wait)
    except BusyError:
        return "busy"
    return "done"


def run_in_worker(job: Job, wait: bool) -> Literal["done", "busy"]:
    """Run a job in a process that runs nothing but jobs with this number of threads."""
    request_determinism()
    if job.xla_threads:
        limit_xla_threads(job.xla_threads)
    return run_job(job, wait)


def update_failures(path: Path, lines: dict[str, Any]) -> bool:
    """Write the log of failed jobs that still have no result, one line each. Several processes may share the file.

    Args:
        path: the file; without failures there is none.
        lines: name of a job -> its new line, or None to remove it. Other jobs keep theirs.

    Returns:
        False if the disk is full: the file is unchanged.
    """
    try:
        with process_lock(path.with_name(f".{path.name}.lock")):
            found = [json.loads(line) for line in read_text(path).splitlines()] if path.exists() else []
            before = {line["task_id"]: line for line in found}
            after = {name: line for name, line in (before | lines).items() if line}
            if not after:
                path.unlink(missing_ok=True)
            elif after != before:
                with atomic_write(path) as partial:
                    partial.write_text("".join(json.dumps(line) + "\n" for line in after.values()), encoding="utf-8")
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        return False
    return True


class JobBoard:
    """Progress display that sums the reports of single jobs.

    Args:
        show: function of `progress_bars`.
        updates: name of each job -> number of its updates.
    """

    def __init__(self, show: Callable[..., None], updates: Mapping[str, int]) -> None:
        self._show_bar, self._updates = show, dict(updates)
        self._ended: set[str] = set()
        self._running: dict[str, tuple[int, float]] = {}
        self._show()

    def show_running(self, name: str, updates: int, steps_per_second: float) -> None:
        """Show the number of updates that a running job has done."""
        self._running[name] = updates, steps_per_second
        self._show()

    def show_stated(self, jobs: Iterable[Job]) -> None:
        """Show what the folders of running jobs state."""
        for job in jobs:
            if progress := job.progress():
                self.show_running(job.name, *progress)

    def show_ended(self, name: str) -> None:
        """Show that a job is finished or has failed."""
        self._running.pop(name, None)
        self._ended.add(name)
        self._show()

    def _show(self) -> None:
        updates = sum(self._updates[name] for name in self._ended) + sum(done for done, _ in self._running.values())
        speed = sum(speed for _, speed in self._running.values())
        note = f"{len(self._ended)}/{len(self._updates)} jobs" + (f", {speed:,.0f} steps/s" if speed else "")
        self._show_bar("all jobs", updates, sum(self._updates.values()), note)
