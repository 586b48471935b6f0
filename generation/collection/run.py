"""All tasks of a rebuild, in this process or on Ray. Failures are logged, and the other tasks continue."""

from __future__ import annotations

import traceback
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from rich.console import Console

from generation.collection.failures import FAILED, FailureLog
from generation.collection.job import CollectionError, CollectionJob, TaskOutcome
from generation.collection.options import CollectOptions
from generation.collection.ray_executor import run_on_ray
from generation.collection.task_folder import is_task_finished, last_timing
from generation.profiles import Profile
from generation.progress import ProgressBoard
from icrl4aht_data.benchmark.tasks import Task


class Executor(Protocol):
    """Runs tasks in any order; closing the generator cancels those that are not done."""

    def __call__(
        self, job: CollectionJob, tasks: Sequence[Task], board: ProgressBoard, options: CollectOptions
    ) -> Generator[TaskOutcome]: ...


def run_in_process(
    job: CollectionJob, tasks: Sequence[Task], board: ProgressBoard, options: CollectOptions
) -> Generator[TaskOutcome]:
    """Runs one task after the other."""
    for task in tasks:
        yield _attempt(job, task, board, options.retries + 1)


def _attempt(job: CollectionJob, task: Task, board: ProgressBoard, attempts: int) -> TaskOutcome:
    def on_update(update: int, metrics: dict[str, float]) -> None:
        board.show_running(task.task_id, update + 1, metrics["steps_per_second"])

    outcome = TaskOutcome(task, "failed")
    for attempt in range(1, attempts + 1):
        try:
            return TaskOutcome(task, job(task, on_update), attempt)
        except Exception as error:  # whatever it is, the other tasks continue
            outcome = TaskOutcome(task, "failed", attempt, f"{type(error).__name__}: {error}", traceback.format_exc())
    return outcome


def collect_tasks(
    tasks: Sequence[Task],
    profile: Profile,
    out: Path,
    console: Console,
    options: CollectOptions,
    suite: Path | None = None,
) -> None:
    """Make every task's artefact under out/artefacts.

    Tasks that another collector works on are left to it, and waited for at the end.

    Args:
        tasks: the tasks.
        profile: their profile.
        out: folder of the rebuild.
        console: where progress is printed.
        options: how to collect.
        suite: folder of the learned teammates, if the tasks have any.

    Raises:
        CollectionError: if an artefact is missing at the end; out/failed.jsonl has the reasons.
    """
    job = CollectionJob(profile, out / "artefacts", suite, wait=False)
    todo = []
    for task in tasks:
        if is_task_finished(job.folder(task), task, profile):
            console.print(f"{_label(task, tasks)}: finished before")
        else:
            todo.append(task)
    missing = {task.task_id for task in todo}
    failures, last_error = FailureLog(out / FAILED), ""
    with (
        ProgressBoard(console, len(todo), profile.ego.updates) as board,
        closing(_run_all(job, todo, board, options)) as outcomes,
    ):
        for outcome in outcomes:
            label = _label(outcome.task, tasks)
            if outcome.status == "busy":
                console.print(f"{label}: another collector works on it")
                continue
            board.show_ended(outcome.task.task_id)
            console.print(f"{label}: {_describe(outcome, job.folder(outcome.task))}")
            if outcome.status == "done":
                missing.remove(outcome.task.task_id)
                failures.forget([outcome.task.task_id])
                continue
            failures.add(outcome)
            last_error = outcome.error
            if options.fail_fast:
                raise CollectionError(f"{failures.path}: the first failure: {outcome.error}")
    failures.forget({task.task_id for task in tasks} - missing)
    if missing:
        reasons = f"{failures.path} has the reasons"
        if not failures.is_written:
            reasons = f"{failures.path} cannot be written, the disk is full; the last failure: {last_error}"
        raise CollectionError(
            f"{len(missing)} of {len(tasks)} tasks have no artefact: {', '.join(sorted(missing))}; {reasons}, and the "
            f"same command tries them again"
        )


def _run_all(
    job: CollectionJob, tasks: Sequence[Task], board: ProgressBoard, options: CollectOptions
) -> Generator[TaskOutcome]:
    """Runs every task, then again, waiting, those that another collector worked on."""
    execute = _executor(options)
    for wait in (False, True):
        busy: list[Task] = []
        with closing(execute(replace(job, wait=wait), tasks, board, options)) as outcomes:
            for outcome in outcomes:
                if outcome.status == "busy":
                    busy.append(outcome.task)
                yield outcome
        tasks = busy


def _executor(options: CollectOptions) -> Executor:
    if options.executor == "local":
        return run_in_process

    return run_on_ray


def _label(task: Task, tasks: Sequence[Task]) -> str:
    return f"task {tasks.index(task) + 1}/{len(tasks)} {task.layout.name} with {task.teammate_kind}"


def _describe(outcome: TaskOutcome, folder: Path) -> str:
    if outcome.status == "failed":
        times = "once" if outcome.attempts == 1 else f"{outcome.attempts} times"
        return f"failed {times}: {outcome.error}"
    timing = last_timing(folder)
    return f"finished at {timing['steps_per_second']:,.0f} steps/s" if timing else "finished"
