"""Progress display: bars on a terminal, or one line of text per minute in a file or pipe."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich import filesize
from rich.console import Console
from rich.progress import DownloadColumn, Progress, Task, TaskID, TextColumn, TransferSpeedColumn
from rich.text import Text

FIRST_LINE_SECONDS, LINE_SECONDS = 10.0, 60.0
"""Seconds before the first line of text, and between two lines."""


@contextmanager
def progress_bars(quiet: bool = False, unit: str = "", of_bytes: bool = False) -> Iterator[Callable[..., None]]:
    """Show progress on stderr; yield a function `show(name, done, total, note="")` with one bar for each name.

    Any thread may call `show`. A `total` of None means that the total is unknown.

    Args:
        quiet: show nothing.
        unit: unit of the numbers in lines of text, such as "steps".
        of_bytes: whether the numbers are bytes, which are shown as sizes with a speed.
    """
    console = Console(stderr=True)
    bars = Progress(
        TextColumn("[progress.description]{task.description}{task.fields[note]}"),
        *Progress.get_default_columns()[1:],
        *((DownloadColumn(), TransferSpeedColumn()) if of_bytes else ()),
        console=console,
        transient=True,
        # Lines of text show the mean speed since the first update, because updates may be minutes apart.
        speed_estimate_period=30 if console.is_terminal else math.inf,
    )
    numbers: dict[str, TaskID] = {}

    def show(name: str, done: float, total: float | None, note: str = "") -> None:
        if name not in numbers:
            numbers[name] = bars.add_task(name, total=total, note="")
        bars.update(numbers[name], completed=done, total=total, note=note and f": {note}")

    shown = bars if console.is_terminal else _printed_lines(bars, unit, of_bytes)
    with nullcontext() if quiet else shown:
        yield show


def bar_updater(show: Callable[..., None], name: str, total: int) -> Callable[[int], None]:
    """Return a function that advances the bar `name` by a number; any thread may call the function."""
    done, lock = 0, threading.Lock()

    def advance(number: int) -> None:
        nonlocal done
        with lock:
            done += number
            show(name, done, total)

    advance(0)
    return advance


@contextmanager
def _printed_lines(bars: Progress, unit: str, of_bytes: bool) -> Iterator[None]:
    """Print lines at intervals from a separate thread, so that lines also appear during a long step."""
    stopped = threading.Event()

    def print_repeatedly() -> None:
        seconds = FIRST_LINE_SECONDS
        while not stopped.wait(seconds):
            for task in bars.tasks:
                if task.total and not task.finished:
                    # Rich flushes after every call, so a log file contains the line at once.
                    bars.console.print(Text(progress_line(task, unit, of_bytes)), soft_wrap=True)
            seconds = LINE_SECONDS

    thread = threading.Thread(target=print_repeatedly, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def progress_line(task: Task, unit: str, of_bytes: bool) -> str:
    """Return the progress of an unfinished task as a line: amount done, percentage, speed, time left, note."""
    count: Callable[[float], str] = (lambda number: filesize.decimal(int(number))) if of_bytes else "{:,.0f}".format
    done = f"{count(task.completed)} of {count(task.total or 0)}{unit and f' {unit}'} ({task.percentage:.0f} %)"
    parts = [f"{task.description}: {done} after {_duration(task.elapsed or 0)}"]
    if speed := task.speed:
        rate = f"{speed:,.1f} per second" if speed >= 1 else f"{60 * speed:,.1f} per minute"
        parts += [f"{count(speed)}/s" if of_bytes else rate, f"{_duration(task.time_remaining or 0)} left"]
    return ", ".join(parts) + task.fields["note"].replace(":", ";", 1)


def _duration(seconds: float) -> str:
    """Return a duration as text, such as "40 s", "5 min" or "1 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60:,} h {minutes % 60} min"
