"""Progress on a terminal; silence where output is not one."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

_PERIOD = 300.0
"""Seconds over which the time left is reckoned."""


def progress(console: Console) -> Progress:
    """A bar with description, count, time left, and a `note` field per task."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        speed_estimate_period=_PERIOD,
        disable=not console.is_terminal,
    )


class Board:
    """What a collection shows: a bar for all of it (tasks, steps/s, time left), and one for each running task.

    Args:
        tasks: how many there are to do.
        updates: of each.
    """

    def __init__(self, console: Console, tasks: int, updates: int) -> None:
        self._bars = progress(console)
        self._tasks, self._updates = tasks, updates
        self._done = 0
        self._running: dict[str, tuple[TaskID, int, float]] = {}
        self._all = self._bars.add_task("all", total=tasks * updates, note="")
        self._show()

    def __enter__(self) -> Board:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def running(self, task_id: str, updates: int, steps_per_second: float) -> None:
        """So many updates of a task are done."""
        bar, _, _ = self._running.get(task_id) or (self._bars.add_task(task_id, total=self._updates, note=""), 0, 0.0)
        self._running[task_id] = bar, updates, steps_per_second
        self._bars.update(bar, completed=updates, note=f"{steps_per_second:,.0f} steps/s")
        self._show()

    def ended(self, task_id: str) -> None:
        """A task is finished, given up, or left to someone else."""
        bar = self._running.pop(task_id, None)
        if bar is not None:
            self._bars.remove_task(bar[0])
        self._done += 1
        self._show()

    def _show(self) -> None:
        speed = sum(speed for _, _, speed in self._running.values())
        completed = self._done * self._updates + sum(updates for _, updates, _ in self._running.values())
        note = f"{self._done}/{self._tasks} tasks, {speed:,.0f} steps/s"
        self._bars.update(self._all, completed=completed, note=note)
