"""Run jobs on Ray, which schedules jobs, assigns each job a GPU if the machines have GPUs, and retries failed jobs.

If this module starts Ray, Ray listens only on 127.0.0.1, and has no dashboard and no usage reports.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.text import Text

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_generation.jobs.job import Job, JobBoard, JobOutcome, run_in_worker
from icrl4aht_generation.jobs.options import QueueOptions

_POLL_SECONDS = 1.0
_CONNECT_SECONDS = 10.0
_OBJECT_STORE_BYTES = 100 * 2**20  # a small store is enough, because jobs write their results to the disk


def run_on_ray(jobs: Sequence[Job], wait: bool, board: JobBoard, options: QueueOptions) -> Generator[JobOutcome]:
    """Run jobs as soon as workers are free; all machines must have access to the jobs' folders.

    Raises:
        OptionError: if Ray is not installed, or cannot be reached.
    """
    if not jobs:
        return
    with _ray_connection(options) as ray:
        accelerated = ray.cluster_resources().get("GPU", 0) > 0
        remote = ray.remote(
            num_cpus=1,
            num_gpus=int(accelerated),
            max_calls=1,  # a new process for every job; when it ends, its memory is released
            max_retries=options.retries,
            retry_exceptions=True,
        )(run_in_worker)
        pending = {remote.remote(job, wait): job for job in jobs}
        try:
            while pending:
                ready, _ = ray.wait(list(pending), num_returns=1, timeout=_POLL_SECONDS)
                for reference in ready:
                    yield _job_outcome(ray, reference, pending.pop(reference), options)
                board.show_recorded(pending.values())  # workers write their progress to the jobs' folders
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)


def _job_outcome(ray: Any, reference: Any, job: Job, options: QueueOptions) -> JobOutcome:
    try:
        return JobOutcome(job, ray.get(reference))
    except ray.exceptions.RayError as error:  # the job raised an error, or the worker died
        cause = getattr(error, "cause", error)
        trace = Text.from_ansi(str(error)).plain
        return JobOutcome(job, "failed", options.retries + 1, f"{type(cause).__name__}: {cause}", trace)


def _check_reachable(address: str | None) -> None:
    """Raise an error if nothing listens at HOST:PORT; Ray itself would wait for minutes."""
    host, _, port = (address or "").rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise OptionError(
            f"Ray at {address} cannot be reached: {error}; check the address, and the output of `ray status`"
        ) from error


@contextmanager
def _ray_connection(options: QueueOptions) -> Iterator[Any]:
    settings: dict[str, Any] = {"address": options.address or "local", "log_to_driver": False, "logging_level": "ERROR"}
    if options.address is None:
        # Ray reads this variable when it is imported. Despite its name, it makes Ray listen only on 127.0.0.1.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        # Ray uses all cores by default, and finds GPUs itself.
        settings |= {
            "num_cpus": options.workers,
            "include_dashboard": False,
            "object_store_memory": _OBJECT_STORE_BYTES,
        }
    elif options.workers is not None:
        raise OptionError(
            f"workers = {options.workers}: the Ray cluster at {options.address} sets the number; omit the option"
        )
    try:
        import ray
    except ImportError as error:
        raise OptionError(f"the executor ray needs Ray: {install_command('cluster')}") from error
    _check_reachable(options.address)
    try:
        ray.init(**settings)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise OptionError(f"Ray at {options.address or 'localhost'} cannot be reached: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()
