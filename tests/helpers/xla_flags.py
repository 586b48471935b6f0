"""XLA flags for tests and their subprocesses, and compilation of single functions with optimizations."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax


def add_xla_flag(flag: str) -> str:
    """Return the value of the environment variable `XLA_FLAGS`, extended by a flag unless the flag is already set."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(flags if flag in flags else [*flags, flag])


def is_xla_flag(flag: str) -> bool:
    """Return whether the installed XLA knows a flag; XLA aborts every process that sets an unknown flag."""
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return not subprocess.run(command, env=environment, capture_output=True, check=False).returncode


def optimized(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, compiled with optimizations.

    This saves time if it runs longer than it compiles. The tests compile other functions with few optimizations.
    """

    def call_optimized(*arguments: Any) -> Any:
        before = jax.config.read("jax_disable_most_optimizations")
        jax.config.update("jax_disable_most_optimizations", False)
        try:
            return function(*arguments)
        finally:
            jax.config.update("jax_disable_most_optimizations", before)

    return call_optimized
