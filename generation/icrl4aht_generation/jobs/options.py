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
    """Options for running jobs; the help text of each field describes the option."""

    executor: Annotated[Literal["local", "ray"], Option("Run jobs in processes of this machine, or use Ray.")] = "local"
    address: Annotated[
        str | None, Option("HOST:PORT of a running Ray cluster.", default="start a local Ray for this command")
    ] = None
    workers: Annotated[Count | None, Option("Parallel jobs.", default="one; with Ray one per GPU, or per core")] = None
    retries: Annotated[Natural, Option("Further attempts for a job that failed.")] = 0
    fail_fast: Annotated[bool, Option("Start no more jobs after one has failed.")] = False

    def __post_init__(self) -> None:
        check_options(self)


def request_determinism() -> None:
    """Make XLA choose only deterministic GPU operations; call this function before JAX is first used.

    Operations on a CPU are deterministic. By default XLA chooses GPU operations by measured speed, and some of these
    operations sum in varying order.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_deterministic_ops" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


queue_options = dataclass_options(QueueOptions, "queue")
"""Decorator that adds the options of a queue to a command, which receives the dict `queue`."""


def read_queue_options(queue: dict[str, Any]) -> QueueOptions:
    """Return the queue options of a command, and set the environment variables that JAX reads at its first use.

    Raises:
        click.UsageError: if an option is only valid for another executor.
    """
    options = replace_options(QueueOptions(), queue)
    if options.executor == "local" and options.address:
        raise click.UsageError("--address needs --executor ray")
    request_determinism()
    if options.executor == "ray":  # else JAX would reserve most of a GPU's memory, which other workers need
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    return options
