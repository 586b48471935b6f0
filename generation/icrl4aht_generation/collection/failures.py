"""The log failed.jsonl of failed units of work and their errors; `task_id` is the name of the artefact."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from icrl4aht_data.utils.files import NO_ROOM, atomic_write, process_lock, read_text
from icrl4aht_generation.collection.job import TaskOutcome

FAILED = "failed.jsonl"


class FailureLog:
    """One line per failed task that still has no artefact. Collectors may share the file.

    On a full disk, changes are kept in memory until a later write succeeds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: dict[str, dict[str, Any] | None] = {}  # name -> its new line, or None to remove it

    @property
    def is_written(self) -> bool:
        """Whether all changes have been written to the disk."""
        return not self._waiting

    def add(self, outcome: TaskOutcome) -> None:
        """Add a task's line, or replace the one of an earlier attempt."""
        name, details = outcome.work.name, {"attempts": outcome.attempts, "error": outcome.error}
        self._change({name: {"task_id": name, **details, "traceback": outcome.trace}})

    def forget(self, names: Iterable[str]) -> None:
        """Remove the lines of tasks that are finished."""
        self._change(dict.fromkeys(names))

    def _change(self, changes: dict[str, dict[str, Any] | None]) -> None:
        self._waiting |= changes
        try:
            self._write()
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise

    def _write(self) -> None:
        with process_lock(self.path.with_name(f".{self.path.name}.lock")):
            found = [json.loads(x) for x in read_text(self.path).splitlines()] if self.path.exists() else []
            before = {line["task_id"]: line for line in found}
            after = {name: line for name, line in (before | self._waiting).items() if line}
            if not after:
                self.path.unlink(missing_ok=True)
            elif after != before:
                with atomic_write(self.path) as partial:
                    partial.write_text("".join(json.dumps(line) + "\n" for line in after.values()), encoding="utf-8")
        self._waiting.clear()
