"""Options of commands that run a queue of jobs."""

from __future__ import annotations

from typing import Any

import click

from icrl4aht_data.commands.dataclass_options import dataclass_options
from icrl4aht_data.utils.options import replace_options
from icrl4aht_generation.jobs.options import QueueOptions, allocate_gpu_memory_on_demand, request_determinism

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
    if options.executor == "ray":
        allocate_gpu_memory_on_demand()
    return options
