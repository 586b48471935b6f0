"""The progress of a collection: one bar for the updates of all tasks, with the speed of the running ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping


class TaskBoard:
    """Progress display that sums the reports of single tasks.

    Args:
        show: function of `progress_bars`.
        updates: name of each task's artefact -> number of its updates.
    """

    def __init__(self, show: Callable[..., None], updates: Mapping[str, int]) -> None:
        self._show_bar, self._updates = show, dict(updates)
        self._ended: set[str] = set()
        self._running: dict[str, tuple[int, float]] = {}
        self._show()

    def show_running(self, name: str, updates: int, steps_per_second: float) -> None:
        """Show the number of updates that a running task has done."""
        self._running[name] = updates, steps_per_second
        self._show()

    def show_ended(self, name: str) -> None:
        """Show that a task is finished or has failed."""
        self._running.pop(name, None)
        self._ended.add(name)
        self._show()

    def _show(self) -> None:
        updates = sum(self._updates[name] for name in self._ended) + sum(done for done, _ in self._running.values())
        speed = sum(speed for _, speed in self._running.values())
        note = f"{len(self._ended)}/{len(self._updates)} tasks" + (f", {speed:,.0f} steps/s" if speed else "")
        self._show_bar("all tasks", updates, sum(self._updates.values()), note)
