"""Progress bars on a terminal; silent where the output is not one."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

_PERIOD = 300.0
"""Seconds over which the speed is averaged for the remaining time."""


def progress_bars(console: Console) -> Progress:
    """Bars with description, count and remaining time, and a field `note` for each."""
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


class ProgressBoard:
    """Progress of a collection: a bar for all tasks with steps/s and remaining time, and one for each running task.

    Args:
        console: where to show it.
        tasks: number of tasks.
        updates: number of updates of each task.
    """

    def __init__(self, console: Console, tasks: int, updates: int) -> None:
        self._bars = progress_bars(console)
        self._tasks, self._updates = tasks, updates
        self._done = 0
        self._running: dict[str, tuple[TaskID, int, float]] = {}
        self._all = self._bars.add_task("all", total=tasks * updates, note="")
        self._show()

    def __enter__(self) -> ProgressBoard:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def show_running(self, task_id: str, updates: int, steps_per_second: float) -> None:
        """Show that a task has done so many updates."""
        bar, _, _ = self._running.get(task_id) or (self._bars.add_task(task_id, total=self._updates, note=""), 0, 0.0)
        self._running[task_id] = bar, updates, steps_per_second
        self._bars.update(bar, completed=updates, note=f"{steps_per_second:,.0f} steps/s")
        self._show()

    def show_ended(self, task_id: str) -> None:
        """Remove the bar of a task that is finished or failed."""
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
