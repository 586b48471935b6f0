"""Run jobs in this process, in several local processes or on Ray; failures are logged, and other jobs continue."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import current_thread, main_thread
from typing import Any

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from rich.console import Console

from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_generation.jobs.job import (
    FAILED,
    FailedJobsError,
    Job,
    JobBoard,
    JobOutcome,
    run_in_worker,
    run_job,
    update_failures,
)
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.ray_executor import run_on_ray

_POLL_SECONDS = 1.0
_QUICK_JOBS = 256  # number of jobs after which a process is replaced, to release its memory
_COMPILED = "jax_compilation_cache_dir"  # JAX's option; the environment variable has the name in upper case


def run_jobs(jobs: Sequence[Job], out: Path, console: Console, options: QueueOptions) -> None:
    """Run every job that is unfinished.

    Jobs that another process is running are skipped at first, and awaited at the end.

    Args:
        jobs: jobs of the queue, all with the same number of XLA threads. Jobs of the same name count as one.
        out: folder of the log of failures.
        console: where outcomes are printed.
        options: how to run the jobs.

    Raises:
        FailedJobsError: if a job is unfinished at the end; out/failed.jsonl lists the reasons.
    """
    jobs = [*{job.name: job for job in jobs}.values()]
    labels = {job.name: f"{number}/{len(jobs)} {job.label}" for number, job in enumerate(jobs, start=1)}
    todo = []
    for job in jobs:
        if job.is_finished():
            console.print(f"{labels[job.name]}: finished before")
        else:
            todo.append(job)
    missing = {job.name for job in todo}
    updates = {job.name: job.updates for job in todo}
    path, last_error = out / FAILED, ""
    lines: dict[str, Any] = dict.fromkeys(labels.keys() - missing)
    with (
        progress_bars(unit="updates") as show,
        _shared_compiled_programs(),
        closing(_run_all(todo, JobBoard(show, updates), options)) as outcomes,
    ):
        for outcome in outcomes:
            name = outcome.job.name
            if outcome.status == "busy":
                console.print(f"{labels[name]}: another process works on it")
                continue
            if outcome.status == "done":
                console.print(f"{labels[name]}: {outcome.job.finished_text()}")
                missing.remove(name)
                lines[name] = None
            else:
                last_error, attempts = outcome.error, outcome.attempts
                times = "once" if attempts == 1 else f"{attempts} times"
                console.print(f"{labels[name]}: failed {times}: {last_error}")
                details = {"attempts": attempts, "error": last_error, "traceback": outcome.trace}
                lines[name] = {"task_id": name, **details}
            update_failures(path, lines)
            if lines[name] and options.fail_fast:
                raise FailedJobsError(f"{path}: stopped after the first failure: {last_error}")
    is_written = update_failures(path, lines)
    if missing:
        reasons = f"{path} lists the reasons"
        if not is_written:
            reasons = f"{path} cannot be written, because the disk is full; the last failure: {last_error}"
        raise FailedJobsError(
            f"{len(missing)} of {len(jobs)} jobs are unfinished: {', '.join(sorted(missing))}; {reasons}; repeat the "
            f"command to try these jobs again"
        )


@contextmanager
def _shared_compiled_programs() -> Iterator[None]:
    """Let local jobs share their compiled programs in a temporary folder, unless JAX has a folder already.

    Jobs that differ only in their seeds run the same programs, and compiling one can take a minute.
    """
    if jax.config.values[_COMPILED]:
        yield
        return
    with TemporaryDirectory(prefix="icrl4aht-compiled-", ignore_cleanup_errors=True) as folder:
        try:
            jax.config.update(_COMPILED, folder)
            os.environ[_COMPILED.upper()] = folder  # worker processes read the variable
            reset_cache()  # JAX decides at its first compilation whether it uses a folder
            yield
        finally:
            jax.config.update(_COMPILED, None)
            del os.environ[_COMPILED.upper()]
            reset_cache()


def _run_all(jobs: Sequence[Job], board: JobBoard, options: QueueOptions) -> Generator[JobOutcome]:
    """Run every job, then wait for jobs that another process was running."""
    execute = _run_serially
    if options.executor == "ray":
        execute = run_on_ray
    elif (options.workers or 1) > 1:
        execute = _run_in_processes
    for wait in (False, True):
        busy: list[Job] = []
        with closing(execute(jobs, wait, board, options)) as outcomes:
            for outcome in outcomes:
                if outcome.status == "busy":
                    busy.append(outcome.job)
                else:
                    board.show_ended(outcome.job.name, outcome.status == "failed")
                yield outcome
        jobs = busy


def _run_serially(jobs: Sequence[Job], wait: bool, board: JobBoard, options: QueueOptions) -> Generator[JobOutcome]:
    """Run the jobs one after another in this process."""
    for job in jobs:
        for attempt in range(1, options.retries + 2):
            try:
                status = run_job(job, wait, partial(board.show_running, job.name))
                outcome = JobOutcome(job, status, attempt)
                break
            except Exception as error:  # whatever the error is, the other jobs continue
                outcome = _failed_outcome(job, attempt, error)
        yield outcome  # type: ignore[possibly-undefined]


def _run_in_processes(jobs: Sequence[Job], wait: bool, board: JobBoard, options: QueueOptions) -> Generator[JobOutcome]:
    """Run jobs in several parallel processes; quick jobs share processes, see `Job.is_quick`."""
    if not jobs:
        return
    before: Any = None
    if current_thread() is main_thread():
        # By default SIGTERM would end this process and leave its workers running.
        before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    waiting, running = list(jobs), {}
    idle: list[ProcessPoolExecutor] = []
    attempts = dict.fromkeys((job.name for job in jobs), 0)
    try:
        while waiting or running:
            while waiting and len(running) < (options.workers or 1):
                job = waiting.pop(0)
                attempts[job.name] += 1
                future, pool = _start_job(job, wait, idle)
                running[future] = job, pool
            ended, _ = wait_for(running, _POLL_SECONDS, FIRST_COMPLETED)
            for future in ended:
                job, pool = running.pop(future)
                error = future.exception()
                if job.is_quick and not isinstance(error, BrokenExecutor):
                    idle.append(pool)
                else:
                    pool.shutdown(wait=False)
                if error is None:
                    yield JobOutcome(job, future.result(), attempts[job.name])
                elif not isinstance(error, Exception):  # no retry after an interrupt or exit of the worker
                    raise error
                elif attempts[job.name] <= options.retries:
                    waiting.append(job)
                else:
                    yield _failed_outcome(job, attempts[job.name], error)
            board.show_recorded(job for job, _ in running.values())
    finally:
        for pool in (*(pool for _, pool in running.values()), *idle):
            pool.shutdown(wait=False, cancel_futures=True)
        if running:
            for process in multiprocessing.active_children():
                process.terminate()
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def _start_job(job: Job, wait: bool, idle: list[ProcessPoolExecutor]) -> tuple[Future[Any], ProcessPoolExecutor]:
    """Start a quick job in an idle process if possible, and any other job in a new process."""
    if idle:
        pool = idle.pop()
        if job.is_quick:
            with suppress(BrokenExecutor):  # in case the idle process was killed
                return pool.submit(run_in_worker, job, wait), pool
        pool.shutdown()  # an idle process holds memory that the new process may need
    # A pool has a single process, since a killed worker breaks its whole pool.
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=_QUICK_JOBS)
    return pool.submit(run_in_worker, job, wait), pool


def _failed_outcome(job: Job, attempts: int, error: BaseException) -> JobOutcome:
    text = f"{type(error).__name__}: {error}"
    return JobOutcome(job, "failed", attempts, text, "".join(traceback.format_exception(error)))
