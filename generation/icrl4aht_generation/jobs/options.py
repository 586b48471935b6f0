"""Options of a queue of jobs, and environment variables that JAX reads when it is first used."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import click

from icrl4aht_data.commands.dataclass_options import dataclass_options
from icrl4aht_data.utils.options import Count, Natural, Option, check_options, replace_options


@dataclass(frozen=True)
class QueueOptions:
    """Options of running jobs; the help text of each field describes it."""

    executor: Annotated[Literal["local", "ray"], Option("Run jobs in processes of this machine, or use Ray.")] = "local"
    address: Annotated[
        str | None, Option("HOST:PORT of a running Ray cluster.", default="start a local Ray for this command")
    ] = None
    workers: Annotated[Count | None, Option("Jobs at a time.", default="one; with Ray one per GPU, or per core")] = None
    retries: Annotated[Natural, Option("Further attempts for a job that failed.")] = 0
    fail_fast: Annotated[bool, Option("Start no job after one has failed.")] = False

    def __post_init__(self) -> None:
        check_options(self)


def request_determinism() -> None:
    """Make XLA choose only GPU operations that give the same bits in every run; call before JAX is first used.

    On a CPU all of them do; on a GPU they are chosen by measured speed, and some sum in varying order.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_deterministic_ops" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


queue_options = dataclass_options(QueueOptions, "queue")
"""Decorator with the options of a queue; the command gets them as `queue`, a dict."""


def read_queue_options(queue: dict[str, Any]) -> QueueOptions:
    """Return the options of a queue that a command was given, and set what JAX reads when it is first used.

    Raises:
        click.UsageError: for options that only another executor has.
    """
    options = replace_options(QueueOptions(), queue)
    if options.executor == "local" and options.address:
        raise click.UsageError("--address needs --executor ray")
    request_determinism()
    if options.executor == "ray":  # by default JAX takes most of a GPU's memory at once, which other processes need
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    return options
