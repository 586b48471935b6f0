"""XLA flags for tests and their subprocesses."""

from __future__ import annotations

import os
import subprocess
import sys


def add_xla_flag(flag: str) -> str:
    """Return the value of the environment variable `XLA_FLAGS`, extended by a flag unless the flag is already set."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(flags if flag in flags else [*flags, flag])


def is_xla_flag(flag: str) -> bool:
    """Return whether the installed XLA knows a flag; XLA aborts every process that sets an unknown flag."""
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return not subprocess.run(command, env=environment, capture_output=True, check=False).returncode
