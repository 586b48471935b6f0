"""failed.jsonl: the units of work of a rebuild that failed, and why; `task_id` is the name of the artefact."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from icrl4aht_data.utils.files import NO_ROOM, atomic_write, process_lock, read_text
from icrl4aht_generation.collection.job import TaskOutcome

FAILED = "failed.jsonl"


class FailureLog:
    """One line per failed task that still has no artefact. Collectors may share the file.

    On a full disk, changes wait until one of the next can be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: list[Callable[[list[dict]], list[dict]]] = []

    @property
    def is_written(self) -> bool:
        """Whether no change waits for room on the disk."""
        return not self._waiting

    def add(self, outcome: TaskOutcome) -> None:
        """Add a task's line, or replace the one of an earlier attempt."""
        line = {
            "task_id": outcome.work.name,
            "attempts": outcome.attempts,
            "error": outcome.error,
            "traceback": outcome.trace,
        }
        self._change(lambda lines: [*(old for old in lines if old["task_id"] != line["task_id"]), line])

    def forget(self, names: Iterable[str]) -> None:
        """Remove the lines of tasks that are finished."""
        finished = set(names)
        self._change(lambda lines: [line for line in lines if line["task_id"] not in finished])

    def _change(self, change: Callable[[list[dict]], list[dict]]) -> None:
        self._waiting.append(change)
        try:
            self._write()
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise

    def _write(self) -> None:
        with process_lock(self.path.with_name(f".{self.path.name}.lock")):
            before = [json.loads(x) for x in read_text(self.path).splitlines()] if self.path.exists() else []
            after = before
            for change in self._waiting:
                after = change(after)
            if not after:
                self.path.unlink(missing_ok=True)
            elif after != before:
                with atomic_write(self.path) as partial:
                    partial.write_text("".join(json.dumps(line) + "\n" for line in after), encoding="utf-8")
        self._waiting.clear()
