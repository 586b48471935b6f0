"""All tasks of a rebuild, in this process or on Ray. Failures are logged, and the other tasks continue."""

from __future__ import annotations

import traceback
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_generation.collection.job import (
    FAILED,
    CollectionError,
    CollectionJob,
    FailureLog,
    TaskBoard,
    TaskOutcome,
)
from icrl4aht_generation.collection.options import CollectOptions
from icrl4aht_generation.collection.ray_executor import run_on_ray
from icrl4aht_generation.collection.task_folder import last_timing
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.work import Work


def run_in_process(
    job: CollectionJob, tasks: Sequence[Work], board: TaskBoard, options: CollectOptions
) -> Generator[TaskOutcome]:
    """Run one task after the other."""
    for work in tasks:

        def on_update(update: int, metrics: dict[str, float], name: str = work.name) -> None:
            board.show_running(name, update + 1, metrics["steps_per_second"])

        for attempt in range(1, options.retries + 2):
            try:
                outcome = TaskOutcome(work, job(work, on_update), attempt)
                break
            except Exception as error:  # any error: the other tasks continue
                text = f"{type(error).__name__}: {error}"
                outcome = TaskOutcome(work, "failed", attempt, text, traceback.format_exc())
        yield outcome  # type: ignore[possibly-undefined]


def collect_tasks(
    tasks: Sequence[Work],
    profile: Profile,
    out: Path,
    console: Console,
    options: CollectOptions,
    suite: Path | None = None,
) -> None:
    """Make every artefact under out/artefacts.

    Tasks that another collector is running are skipped, and awaited at the end.

    Args:
        tasks: the units of work.
        profile: their profile.
        out: folder of the rebuild.
        console: where results are printed.
        options: how to collect.
        suite: folder of the learned teammates, if the tasks have any.

    Raises:
        CollectionError: if an artefact is missing at the end; out/failed.jsonl has the reasons.
    """
    job = CollectionJob(profile, out / "artefacts", suite, wait=False)
    todo = []
    for work in tasks:
        if job.is_finished(work):
            console.print(f"{_label(work, tasks)}: finished before")
        else:
            todo.append(work)
    missing = {work.name for work in todo}
    updates = {work.name: profile.updates(work) for work in todo}
    failures, last_error = FailureLog(out / FAILED), ""
    with (
        progress_bars(unit="updates") as show,
        closing(_run_all(job, todo, board := TaskBoard(show, updates), options)) as outcomes,
    ):
        for outcome in outcomes:
            label = _label(outcome.work, tasks)
            if outcome.status == "busy":
                console.print(f"{label}: another collector works on it")
                continue
            board.show_ended(outcome.work.name)
            console.print(f"{label}: {_describe(outcome, job.folder(outcome.work))}")
            if outcome.status == "done":
                missing.remove(outcome.work.name)
                failures.forget([outcome.work.name])
                continue
            failures.add(outcome)
            last_error = outcome.error
            if options.fail_fast:
                raise CollectionError(f"{failures.path}: the first failure: {outcome.error}")
    failures.forget({work.name for work in tasks} - missing)
    if missing:
        reasons = f"{failures.path} has the reasons"
        if not failures.is_written:
            reasons = f"{failures.path} cannot be written, the disk is full; the last failure: {last_error}"
        raise CollectionError(
            f"{len(missing)} of {len(tasks)} tasks have no artefact: {', '.join(sorted(missing))}; {reasons}, and the "
            f"same command tries them again"
        )


def _run_all(
    job: CollectionJob, tasks: Sequence[Work], board: TaskBoard, options: CollectOptions
) -> Generator[TaskOutcome]:
    """Run every task, then wait for those that another collector was running."""
    execute = run_in_process if options.executor == "local" else run_on_ray
    for wait in (False, True):
        busy: list[Work] = []
        with closing(execute(replace(job, wait=wait), tasks, board, options)) as outcomes:
            for outcome in outcomes:
                if outcome.status == "busy":
                    busy.append(outcome.work)
                yield outcome
        tasks = busy


def _label(work: Work, tasks: Sequence[Work]) -> str:
    learner = f", learner {work.learner}" if work.learner else ""
    source = "" if work.source == "ppo" else f", {work.source}"
    task = work.task
    return f"task {tasks.index(work) + 1}/{len(tasks)} {task.layout.name} with {task.teammate_kind}{source}{learner}"


def _describe(outcome: TaskOutcome, folder: Path) -> str:
    if outcome.status == "failed":
        times = "once" if outcome.attempts == 1 else f"{outcome.attempts} times"
        return f"failed {times}: {outcome.error}"
    timing = last_timing(folder)
    return f"finished at {timing['steps_per_second']:,.0f} steps/s" if timing else "finished"
