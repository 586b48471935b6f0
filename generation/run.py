"""All tasks of a rebuild: in this process, or on Ray. What fails is written down, the rest goes on."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

from filelock import FileLock
from rich.console import Console

from generation.artefact import is_finished, last_timing
from generation.collect import Report, TaskBusyError, run_task
from generation.options import Options
from generation.profiles import Profile
from generation.progress import Board
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.files import file_in_place_of, read_text
from icrl4aht_data.tasks import Task

FAILED = "failed.jsonl"


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
        except TaskBusyError:
            return "busy"
        return "done"


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


class FailureLog:
    """failed.jsonl: one line per failed task that is still without an artefact. Collectors may share it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = FileLock(path.with_name(f".{path.name}.lock"))

    def add(self, outcome: Outcome) -> None:
        line = {
            "task_id": outcome.task.task_id,
            "attempts": outcome.attempts,
            "error": outcome.error,
            "traceback": outcome.trace,
        }
        self._change(lambda lines: [*(old for old in lines if old["task_id"] != line["task_id"]), line])

    def forget(self, task_ids: Iterable[str]) -> None:
        """Drop the lines of tasks that are finished."""
        finished = set(task_ids)
        self._change(lambda lines: [line for line in lines if line["task_id"] not in finished])

    def _change(self, change: Callable[[list[dict]], list[dict]]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._lock:
            before = [json.loads(x) for x in read_text(self.path).splitlines()] if self.path.exists() else []
            after = change(before)
            if not after:
                self.path.unlink(missing_ok=True)
            elif after != before:
                with file_in_place_of(self.path) as partial:
                    partial.write_text("".join(json.dumps(line) + "\n" for line in after), encoding="utf-8")


def _executor(options: Options) -> Execute:
    if options.executor == "local":
        return in_process
    from generation.on_ray import on_ray

    return on_ray


def _label(task: Task, tasks: Sequence[Task]) -> str:
    return f"task {tasks.index(task) + 1}/{len(tasks)} {task.layout.name} with {task.teammate_kind}"


def _in_words(outcome: Outcome, folder: Path) -> str:
    if outcome.status == "failed":
        times = "once" if outcome.attempts == 1 else f"{outcome.attempts} times"
        return f"failed {times}: {outcome.error}"
    timing = last_timing(folder)
    return f"finished at {timing['steps_per_second']:,.0f} steps/s" if timing else "finished"
