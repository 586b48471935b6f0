"""Options of a collection, and environment variables that JAX reads when it is first used."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

from icrl4aht_data.utils.options import check_fields, option_field


@dataclass(frozen=True)
class CollectOptions:
    """Options of collecting tasks; the help text of each field describes it."""

    executor: Literal["local", "ray"] = option_field("local", "Run one task at a time here, or use Ray.")
    address: str | None = option_field(
        None, "HOST:PORT of a running Ray cluster.", default_text="start a local Ray for this command"
    )
    workers: int | None = option_field(
        None, "Tasks at a time on the local Ray.", at_least=1, default_text="one per GPU, or per core"
    )
    retries: int = option_field(0, "Further attempts for a task that failed.", at_least=0)
    fail_fast: bool = option_field(False, "Start no task after one has failed.")

    def __post_init__(self) -> None:
        check_fields(self)


def request_determinism() -> None:
    """Make XLA choose only GPU operations that give the same bits in every run; call before JAX is first used.

    On a CPU all of them do; on a GPU they are chosen by measured speed, and some sum in varying order.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_deterministic_ops" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


def allocate_gpu_memory_on_demand() -> None:
    """Make JAX allocate GPU memory as needed instead of most of it at once; call before JAX is first used."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
