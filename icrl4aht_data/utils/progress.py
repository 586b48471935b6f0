"""Progress of long work: bars on a terminal, and a plain line a minute where the output is a file or a pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from rich import filesize
from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task, TaskID
from rich.text import Text

LINE_SECONDS = 60.0
"""Interval of plain lines."""


class LineProgress(Progress):
    """Rich's progress bars, which print plain lines instead of bars if the console is not a terminal.

    A line says what is done, how far it is, how fast, and the time left; further fields of a bar in it are `unit` (what
    is counted) and `note`. The speed is the mean since the first move of a bar: it falls while nothing moves, and what
    a resumed run had finished before does not count. Invisible bars have no lines. Lines are written and flushed at
    once, by a thread of their own, so that they also appear while a single step takes long.

    Args:
        columns: columns of a bar.
        console: where to print.
        quiet: print nothing.
        edges: also print a line when a bar first moves, and one when the progress is stopped.
        of_bytes: the numbers are bytes.
        clock: returns the time in seconds.
        interval: seconds between two lines; None for no thread, the caller then calls `print_lines`.
        options: of Rich's `Progress`.
    """

    def __init__(
        self,
        *columns: str | ProgressColumn,
        console: Console,
        quiet: bool = False,
        edges: bool = False,
        of_bytes: bool = False,
        clock: Callable[[], float] = time.monotonic,
        interval: float | None = LINE_SECONDS,
        **options: Any,
    ) -> None:
        self._has_lines = not quiet and not console.is_terminal
        self._edges, self._of_bytes, self._interval = edges, of_bytes, interval
        self._first_moves: dict[TaskID, tuple[float, float]] = {}  # time, and what was completed then
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        super().__init__(*columns, console=console, disable=quiet or not console.is_terminal, get_time=clock, **options)

    def start(self) -> None:
        """Show the bars, or start the thread that prints lines."""
        super().start()
        if self._has_lines and self._interval is not None:
            self._thread = threading.Thread(target=self._print_repeatedly, name="progress", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Remove the bars, or print the last lines."""
        super().stop()
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._edges:
            for task in self._with_lines():
                if task.id in self._first_moves:
                    self._print(self._last_line(task))

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change a bar, see Rich's `Progress.update`."""
        super().update(task_id, **changes)
        self._after_move(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Move a bar forward."""
        super().advance(task_id, advance)
        self._after_move(task_id)

    def print_lines(self) -> None:
        """Print a line for every bar that is not finished, unless the console is a terminal."""
        for task in self._with_lines():
            if not task.finished:
                self._print(self._line(task))

    def _after_move(self, task_id: TaskID) -> None:
        task = self._tasks[task_id]
        if task.completed and task_id not in self._first_moves:
            self._first_moves[task_id] = self.get_time(), task.completed
            if self._edges and self._has_lines and task.visible:
                self._print(f"{task.description}: started, {self._count(task.total)}{_unit(task)}")

    def _with_lines(self) -> list[Task]:
        """The bars that have lines."""
        with self._lock:
            return [task for task in self._tasks.values() if task.visible and task.total and self._has_lines]

    def _print_repeatedly(self) -> None:
        while not self._stopped.wait(self._interval):
            self.print_lines()

    def _print(self, line: str) -> None:
        self.console.print(Text(line), soft_wrap=True)  # Rich flushes after every call

    def _line(self, task: Task) -> str:
        share = f"{100 * task.completed / (task.total or 1):.0f} %"
        how_far = f"{self._count(task.completed)} of {self._count(task.total)}{_unit(task)} ({share})"
        speed = self._speed(task)
        left = f"{_duration((task.remaining or 0.0) / speed)} left" if speed else "time left unknown"
        parts = [f"{how_far} after {_duration(task.elapsed or 0.0)}", *([self._rate(speed)] if speed else []), left]
        return f"{task.description}: {', '.join(parts)}{_note(task)}"

    def _speed(self, task: Task) -> float:
        """Mean speed since the first move; unlike Rich's, which is that of past moves, it falls while nothing moves."""
        now = self.get_time()
        since, before = self._first_moves.get(task.id, (now, task.completed))
        return max(0.0, task.completed - before) / (now - since) if now > since else 0.0

    def _last_line(self, task: Task) -> str:
        stopped = "" if task.finished else "stopped at "
        how_far = f"{stopped}{self._count(task.completed)} of {self._count(task.total)}{_unit(task)}"
        return f"{task.description}: {how_far} after {_duration(task.elapsed or 0.0)}{_note(task)}"

    def _count(self, number: float | None) -> str:
        return filesize.decimal(int(number or 0)) if self._of_bytes else f"{number or 0:,.0f}"

    def _rate(self, speed: float) -> str:
        if self._of_bytes:
            return f"{filesize.decimal(int(speed))} a second"
        units = {"second": speed, "minute": 60 * speed, "hour": 3600 * speed}
        unit = next((name for name, rate in units.items() if rate >= 1), "hour")
        return f"{units[unit]:,.{0 if units[unit] >= 10 else 1}f} {'an' if unit == 'hour' else 'a'} {unit}"


def _unit(task: Task) -> str:
    unit = task.fields.get("unit") or ""
    return f" {unit.removesuffix('s') if task.total == 1 else unit}" if unit else ""


def _note(task: Task) -> str:
    return f"; {task.fields['note']}" if task.fields.get("note") else ""


def _duration(seconds: float) -> str:
    """A duration in words: "40 s", "5 min", "1 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60:,} h {minutes % 60} min"
