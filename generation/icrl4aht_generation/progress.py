"""Progress bars on a terminal, a plain line a minute elsewhere; a board for the tasks of a collection."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn

from icrl4aht_data.utils.progress import LineProgress

_PERIOD = 300.0
"""Seconds over which the speed is averaged for the remaining time."""


def progress_bars(console: Console, **options: Any) -> LineProgress:
    """Bars with description, count and remaining time, and a field `note` for each.

    Where the console is not a terminal, plain lines are printed: one at the start, one a minute, one at the end.

    Args:
        console: where to print.
        options: of `LineProgress`.
    """
    return LineProgress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        edges=True,
        speed_estimate_period=_PERIOD,
        **options,
    )


class ProgressBoard:
    """Progress of a collection: a bar for all tasks with steps/s and remaining time, and one for each running task.

    Where the console is not a terminal, plain lines show all tasks together.

    Args:
        console: where to show it.
        updates: name of each task's artefact -> number of its updates.
        options: of `LineProgress`.
    """

    def __init__(self, console: Console, updates: Mapping[str, int], **options: Any) -> None:
        self._bars = progress_bars(console, **options)
        self._updates = dict(updates)
        self._done, self._done_updates = 0, 0
        self._running: dict[str, tuple[TaskID, int, float]] = {}
        self._all = self._bars.add_task("all tasks", total=sum(self._updates.values()), note="", unit="updates")
        self._shows_single = console.is_terminal
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
        if task_id in self._running:
            bar = self._running[task_id][0]
        else:
            bar = self._bars.add_task(task_id, total=self._updates[task_id], note="", visible=self._shows_single)
        self._running[task_id] = bar, updates, steps_per_second
        self._bars.update(bar, completed=updates, note=f"{steps_per_second:,.0f} steps/s")
        self._show()

    def show_ended(self, task_id: str) -> None:
        """Remove the bar of a task that is finished or failed."""
        bar = self._running.pop(task_id, None)
        if bar is not None:
            self._bars.remove_task(bar[0])
        self._done += 1
        self._done_updates += self._updates[task_id]
        self._show()

    def print_lines(self) -> None:
        """Print the line of all tasks, see `LineProgress`."""
        self._bars.print_lines()

    def _show(self) -> None:
        speed = sum(speed for _, _, speed in self._running.values())
        completed = self._done_updates + sum(updates for _, updates, _ in self._running.values())
        note = f"{self._done}/{len(self._updates)} tasks" + (f", {speed:,.0f} steps/s" if speed else "")
        self._bars.update(self._all, completed=completed, note=note)
