"""All tasks of a rebuild: in this process, or on Ray. What fails is written down, the rest goes on."""

from __future__ import annotations

import traceback
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from rich.console import Console

from generation.collection.failures import FAILED, FailureLog
from generation.collection.job import CollectionError, Job, Outcome
from generation.collection.options import Options
from generation.collection.task_folder import is_finished, last_timing
from generation.profiles import Profile
from generation.progress import Board
from icrl4aht_data.benchmark.tasks import Task


class Execute(Protocol):
    """Does tasks in any order; closing the generator calls off those that are not done."""

    def __call__(self, job: Job, tasks: Sequence[Task], board: Board, options: Options) -> Generator[Outcome]: ...


def in_process(job: Job, tasks: Sequence[Task], board: Board, options: Options) -> Generator[Outcome]:
    """One task after the other."""
    for task in tasks:
        yield _attempt(job, task, board, options.retries + 1)


def _attempt(job: Job, task: Task, board: Board, attempts: int) -> Outcome:
    def report(update: int, metrics: dict[str, float]) -> None:
        board.running(task.task_id, update + 1, metrics["steps_per_second"])

    outcome = Outcome(task, "failed")
    for attempt in range(1, attempts + 1):
        try:
            return Outcome(task, job(task, report), attempt)
        except Exception as error:  # whatever it is, the other tasks go on
            outcome = Outcome(task, "failed", attempt, f"{type(error).__name__}: {error}", traceback.format_exc())
    return outcome


def collect_tasks(
    tasks: Sequence[Task],
    profile: Profile,
    out: Path,
    console: Console,
    options: Options,
    suite: Path | None = None,
) -> None:
    """Make every task's artefact under out/artefacts. Tasks that another collector is at are left to it, then checked.

    Args:
        suite: the folder of the learned teammates, where the tasks have any.

    Raises:
        CollectionError: if an artefact is missing at the end; out/failed.jsonl says why.
    """
    artefacts = out / "artefacts"
    todo = []
    for task in tasks:
        if is_finished(artefacts / task.task_id, task, profile):
            console.print(f"{_label(task, tasks)}: finished before")
        else:
            todo.append(task)
    missing = {task.task_id for task in todo}
    failures = FailureLog(out / FAILED)
    job = Job(profile, artefacts, suite, wait=False)
    with Board(console, len(todo), profile.ego.updates) as board, closing(_outcomes(job, todo, board, options)) as ends:
        for outcome in ends:
            label = _label(outcome.task, tasks)
            if outcome.status == "busy":
                console.print(f"{label}: another collector is at it")
                continue
            board.ended(outcome.task.task_id)
            console.print(f"{label}: {_in_words(outcome, job.folder(outcome.task))}")
            if outcome.status == "done":
                missing.remove(outcome.task.task_id)
                failures.forget([outcome.task.task_id])
                continue
            failures.add(outcome)
            if options.fail_fast:
                raise CollectionError(f"{failures.path}: the first failure: {outcome.error}")
    failures.forget({task.task_id for task in tasks} - missing)
    if missing:
        raise CollectionError(
            f"{len(missing)} of {len(tasks)} tasks have no artefact: {', '.join(sorted(missing))}; "
            f"{failures.path} says why, and the same command tries them again"
        )


def _outcomes(job: Job, tasks: Sequence[Task], board: Board, options: Options) -> Generator[Outcome]:
    """Of every task; those that another collector is at come again at the end, when it has been waited for."""
    execute = _executor(options)
    for wait in (False, True):
        busy: list[Task] = []
        with closing(execute(replace(job, wait=wait), tasks, board, options)) as outcomes:
            for outcome in outcomes:
                if outcome.status == "busy":
                    busy.append(outcome.task)
                yield outcome
        tasks = busy


def _executor(options: Options) -> Execute:
    if options.executor == "local":
        return in_process
    from generation.collection.ray_executor import on_ray

    return on_ray


def _label(task: Task, tasks: Sequence[Task]) -> str:
    return f"task {tasks.index(task) + 1}/{len(tasks)} {task.layout.name} with {task.teammate_kind}"


def _in_words(outcome: Outcome, folder: Path) -> str:
    if outcome.status == "failed":
        times = "once" if outcome.attempts == 1 else f"{outcome.attempts} times"
        return f"failed {times}: {outcome.error}"
    timing = last_timing(folder)
    return f"finished at {timing['steps_per_second']:,.0f} steps/s" if timing else "finished"
