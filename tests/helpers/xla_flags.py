"""XLA's flags of tests and their subprocesses."""

from __future__ import annotations

import os


def add_xla_flag(flag: str) -> str:
    """Return the value of `XLA_FLAGS` with another flag: programs compiled with different flags may differ in bits."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(flags if flag in flags else [*flags, flag])
