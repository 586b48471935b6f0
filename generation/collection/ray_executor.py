"""Tasks on Ray, which schedules them, gives each a GPU where there are any, and tries failed ones again.

A Ray that is started here listens on 127.0.0.1 only, without dashboard and usage reports.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.text import Text

from generation.collection.job import Job, Outcome
from generation.collection.options import Options, ask_for_determinism
from generation.collection.task_folder import last_timing
from generation.progress import Board
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError

_POLL_SECONDS = 1.0
_REACHED = 10  # seconds
_OBJECT_STORE_BYTES = 100 * 2**20  # tasks go to the workers, artefacts to the disk; nothing large passes through Ray


def on_ray(job: Job, tasks: Sequence[Task], board: Board, options: Options) -> Generator[Outcome]:
    """Tasks as workers are free. The artefacts' folder must be the same on every machine.

    Raises:
        OptionError: if Ray is not installed, or cannot be reached.
    """
    if not tasks:
        return
    with _connected(options) as ray:
        accelerated = ray.cluster_resources().get("GPU", 0) > 0
        remote = ray.remote(
            num_cpus=1,
            num_gpus=int(accelerated),
            max_calls=1,  # a process of its own for each task, so that its memory goes with it
            max_retries=options.retries,
            retry_exceptions=True,
        )(_work)
        pending = {remote.remote(job, task): task for task in tasks}
        try:
            while pending:
                ready, _ = ray.wait(list(pending), num_returns=1, timeout=_POLL_SECONDS)
                for reference in ready:
                    yield _outcome(ray, reference, pending.pop(reference), options)
                _show(job, pending.values(), board)
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)


def _show(job: Job, tasks: Iterable[Task], board: Board) -> None:
    for task in tasks:
        timing = last_timing(job.folder(task))
        if timing:
            board.running(task.task_id, int(timing["update"]) + 1, timing["steps_per_second"])


def _work(job: Job, task: Task) -> str:
    ask_for_determinism()
    return job(task)


def _outcome(ray: Any, reference: Any, task: Task, options: Options) -> Outcome:
    try:
        return Outcome(task, ray.get(reference))
    except ray.exceptions.RayError as error:  # what the task raised, or the worker itself is gone
        cause = getattr(error, "cause", error)
        trace = Text.from_ansi(str(error)).plain
        return Outcome(task, "failed", options.retries + 1, f"{type(cause).__name__}: {cause}", trace)


def _check_reachable(address: str | None) -> None:
    """Whether something listens at HOST:PORT, for which Ray would wait for minutes."""
    host, _, port = (address or "").rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=_REACHED).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise OptionError(
            f"Ray at {address} cannot be reached: {error}; check the address, and `ray status`"
        ) from error


@contextmanager
def _connected(options: Options) -> Iterator[Any]:
    if options.address is None:
        # Read when Ray is first imported. It is named after its main use; what it does is to take the loopback address
        # for this machine's, which is where Ray's servers listen.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    elif options.workers is not None:
        raise OptionError(f"workers = {options.workers}: the Ray at {options.address} has its own")
    try:
        import ray
    except ImportError as error:
        raise OptionError("the executor ray needs Ray: pip install 'icrl4aht-data[cluster]'") from error
    _check_reachable(options.address)
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if options.address is None:
            ray.init(
                address="local",
                num_cpus=options.workers,  # all cores by default; GPUs are found by Ray
                include_dashboard=False,
                object_store_memory=_OBJECT_STORE_BYTES,
                **quiet,
            )
        else:
            ray.init(address=options.address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise OptionError(f"Ray at {options.address or 'this machine'} cannot be reached: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()
