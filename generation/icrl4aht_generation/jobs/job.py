"""Code that the executors of a queue share: jobs, outcomes, the log of failures, and the progress display."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.utils.files import NO_ROOM, atomic_write, lock_file_path, process_lock, read_text
from icrl4aht_data.utils.system import keep_freed_memory
from icrl4aht_generation.jobs.options import request_determinism
from icrl4aht_generation.learners.resume import BusyError, limit_xla_threads

FAILED = "failed.jsonl"
"""File name of the log of failed jobs and their errors; the field `task_id` is a job's name."""

OnUpdate = Callable[[int, float], None]
"""Function called after an update with the number of finished updates and the steps per second."""


class FailedJobsError(Icrl4ahtError):
    """Error: some jobs of a queue failed or did not finish."""


class Job(Protocol):
    """A long computation that writes one folder and can resume. Jobs are pickled for worker processes."""

    @property
    def name(self) -> str:
        """Name of the job, unique in its queue."""
        ...

    @property
    def label(self) -> str:
        """Description of the job for messages."""
        ...

    @property
    def updates(self) -> int:
        """Number of updates of the job; progress is counted in updates."""
        ...

    @property
    def xla_threads(self) -> int | None:
        """Number of CPU threads of XLA, which affects the last bits of results; None for all cores."""
        ...

    @property
    def is_quick(self) -> bool:
        """Whether the job takes only seconds. Quick jobs share a process and its compiled functions; every other job
        has a new process, which releases its memory."""
        ...

    def is_finished(self) -> bool:
        """Return whether the result of the job is complete and unchanged."""
        ...

    def progress(self) -> tuple[int, float] | None:
        """Return the number of finished updates and the steps per second that the job's folder records."""
        ...

    def finished_text(self) -> str:
        """Return a message that the job is finished."""
        ...

    def run(self, on_update: OnUpdate, wait: bool) -> None:
        """Run the job, or resume it from its last save.

        Args:
            on_update: called after each update.
            wait: whether to wait while another process runs the job.

        Raises:
            BusyError: if another process runs the job and `wait` is false.
        """
        ...


@dataclass(frozen=True)
class JobOutcome:
    """Status of a job after it was run, and its last error.

    Attributes:
        job: job that was run.
        status: "done" if the job is finished, "busy" if another process runs the job, or "failed".
        attempts: number of attempts.
        error: type and message of the last error.
        trace: traceback of the last error.
    """

    job: Job
    status: Literal["done", "busy", "failed"]
    attempts: int = 1
    error: str = ""
    trace: str = ""


def run_job(job: Job, wait: bool, on_update: OnUpdate = lambda update, speed: None) -> Literal["done", "busy"]:
    """Run a job in this process, and return "done", or "busy" if another process runs the job."""
    try:
        job.run(on_update, wait)
    except BusyError:
        return "busy"
    return "done"


def run_in_worker(job: Job, wait: bool) -> Literal["done", "busy"]:
    """Run a job in a worker process, in which all jobs have the same number of XLA threads."""
    keep_freed_memory()
    request_determinism()
    if job.xla_threads:
        limit_xla_threads(job.xla_threads)
    return run_job(job, wait)


def update_failures(path: Path, lines: dict[str, Any]) -> bool:
    """Update the log of failed jobs, one line for each job; several processes may share the file.

    Args:
        path: path of the log, which is deleted if no failures remain.
        lines: new line of each job by name, or None to remove the job's line. Lines of other jobs remain.

    Returns:
        Whether the log is up to date; False if the disk is full and the log is unchanged.
    """
    try:
        with process_lock(lock_file_path(path)):
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
    """Progress display that sums the progress of all jobs.

    Args:
        show: display function that `progress_bars` returns.
        updates: number of updates of each job by name.
    """

    def __init__(self, show: Callable[..., None], updates: Mapping[str, int]) -> None:
        self._show_bar, self._updates = show, dict(updates)
        self._finished: set[str] = set()
        self._failed: set[str] = set()
        self._running: dict[str, tuple[int, float]] = {}
        self._show()

    def show_running(self, name: str, updates: int, steps_per_second: float) -> None:
        """Show the number of finished updates of a running job."""
        self._running[name] = updates, steps_per_second
        self._show()

    def show_recorded(self, jobs: Iterable[Job]) -> None:
        """Show the progress that is recorded in the folders of running jobs."""
        for job in jobs:
            if progress := job.progress():
                self.show_running(job.name, *progress)

    def show_ended(self, name: str, failed: bool) -> None:
        """Show that a job is finished or has failed. The updates of failed jobs no longer count."""
        self._running.pop(name, None)
        (self._failed if failed else self._finished).add(name)
        self._show()

    def _show(self) -> None:
        updates = sum(self._updates[name] for name in self._finished) + sum(done for done, _ in self._running.values())
        total = sum(number for name, number in self._updates.items() if name not in self._failed)
        speed = sum(speed for _, speed in self._running.values())
        notes = [f"{len(self._finished)}/{len(self._updates)} jobs"]
        notes += [f"{len(self._failed)} failed"] * bool(self._failed) + [f"{speed:,.0f} steps/s"] * bool(speed)
        self._show_bar("all jobs", updates, total, ", ".join(notes))
