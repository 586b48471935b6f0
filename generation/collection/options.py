"""How to collect: what the command line asks for."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

Executor = Literal["local", "ray"]
EXECUTORS: tuple[Executor, ...] = ("local", "ray")


@dataclass(frozen=True)
class Options:
    """How to collect.

    Args:
        executor: "local" for one task after the other in this process; "ray".
        address: of a running Ray cluster; a local Ray is started for the occasion by default.
        workers: of the Ray that is started, and so tasks at a time; one per GPU, or else per core, by default.
        retries: of a task that failed.
        fail_fast: whether to begin no task after one has failed.
    """

    executor: Executor = "local"
    address: str | None = None
    workers: int | None = None
    retries: int = 0
    fail_fast: bool = False


def ask_for_determinism() -> None:
    """Have XLA choose only operations that give the same bits in every run; before JAX is first used.

    On a CPU they are; on a GPU they are chosen by measured speed, and some add up in any order.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_deterministic_ops" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


def leave_memory_to_workers() -> None:
    """Have JAX take GPU memory as it needs it, not most of it at once; before JAX is first used."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
