"""A job that writes a file, for tests of the job queue. Worker processes import this module, so it imports little."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import BusyError


@dataclass(frozen=True)
class FileJob:
    """A job that writes its process id to a file, after failing in its first `failures` attempts.

    The file has the value of the environment variable `variable` instead, if it is given.
    """

    out: Path
    name: str
    failures: int = 0
    busy: bool = False
    killed: bool = False
    updates: int = 1
    xla_threads: int | None = 1
    is_quick: bool = True
    variable: str = ""

    @property
    def label(self) -> str:
        return self.name

    def is_finished(self) -> bool:
        return (self.out / self.name).is_file()

    def progress(self) -> tuple[int, float] | None:
        return None

    def finished_text(self) -> str:
        return "finished"

    def run(self, on_update: OnUpdate, wait: bool) -> None:
        if self.busy and not wait:
            raise BusyError("busy")
        tries = self.out / f"{self.name}.tries"
        tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
        if len(tries.read_text()) <= self.failures:
            raise ValueError(f"attempt {len(tries.read_text())}")
        if self.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        (self.out / self.name).write_text(os.environ[self.variable] if self.variable else str(os.getpid()))
