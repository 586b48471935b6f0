"""Progress display: bars on a terminal, and one plain line a minute in a file or pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich import filesize
from rich.console import Console
from rich.progress import DownloadColumn, Progress, TransferSpeedColumn
from rich.text import Text

FIRST_LINE_SECONDS, LINE_SECONDS = 10.0, 60.0
"""Seconds before the first plain line and between lines."""


@contextmanager
def progress_bars(quiet: bool = False, unit: str = "", of_bytes: bool = False) -> Iterator[Callable[..., None]]:
    """Show progress on stderr; yield a function `show(name, done, total, note="")` with one bar for each name.

    Any thread may call `show`. A `total` of None means unknown.

    Args:
        quiet: show nothing.
        unit: unit of the numbers in plain lines, such as "steps".
        of_bytes: whether the numbers are bytes; shows sizes and speed.
    """
    console = Console(stderr=True)
    if quiet:
        yield lambda name, done, total, note="": None
        return
    if not console.is_terminal:
        with _printed_lines(PlainLines(console, unit, of_bytes)) as lines:
            yield lines.show
        return
    columns = (*Progress.get_default_columns(), *((DownloadColumn(), TransferSpeedColumn()) if of_bytes else ()))
    running: dict[str, Any] = {}
    with Progress(*columns, console=console, transient=True) as shown:

        def show(name: str, done: float, total: float | None, note: str = "") -> None:
            if name not in running:
                running[name] = shown.add_task(name, total=total)
            text = f"{name}: {note}" if note else name
            shown.update(running[name], completed=done, total=total, description=text)

        yield show


def counted(show: Callable[..., None], name: str, total: int) -> Callable[[int], None]:
    """Return a function that advances the bar `name` by a number; any thread may call it."""
    done, lock = 0, threading.Lock()

    def advance(number: int) -> None:
        nonlocal done
        with lock:
            done += number
            show(name, done, total)

    advance(0)
    return advance


class PlainLines:
    """Progress as plain lines: amount done, percentage, speed, and time left.

    The speed is the mean since the first update, so the work that a resumed run had finished before does not count.

    Args:
        console: console to print to.
        unit: unit of the numbers.
        of_bytes: whether the numbers are bytes, see `progress_bars`.
        clock: function that returns the time in seconds.
    """

    def __init__(
        self, console: Console, unit: str = "", of_bytes: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console, self._unit, self._of_bytes, self._clock = console, unit, of_bytes, clock
        self._bars: dict[str, tuple[float, float | None, str]] = {}
        self._starts: dict[str, float] = {}
        self._first_moves: dict[str, tuple[float, float]] = {}  # name -> time and amount done at the first update

    def show(self, name: str, done: float, total: float | None, note: str = "") -> None:
        """Update the amount, total and note of a bar."""
        now = self._clock()
        self._starts.setdefault(name, now)
        if done:
            self._first_moves.setdefault(name, (now, done))
        self._bars[name] = done, total, note

    def print_lines(self) -> None:
        """Print a line for every bar that is not finished."""
        for name, (done, total, note) in list(self._bars.items()):
            if total and done < total:
                # Rich flushes after every call, so that a log shows the line at once.
                self._console.print(Text(self._line(name, done, total, note)), soft_wrap=True)

    def _line(self, name: str, done: float, total: float, note: str) -> str:
        now = self._clock()
        unit = f" {self._unit}" if self._unit else ""
        how_far = f"{self._count(done)} of {self._count(total)}{unit} ({100 * done / total:.0f} %)"
        since, before = self._first_moves.get(name, (now, done))
        speed = (done - before) / (now - since) if now > since else 0.0
        parts = [f"{how_far} after {_duration(now - self._starts[name])}"]
        parts += [self._rate(speed), f"{_duration((total - done) / speed)} left"] if speed > 0 else []
        return f"{name}: {', '.join(parts)}" + (f"; {note}" if note else "")

    def _count(self, number: float) -> str:
        return filesize.decimal(int(number)) if self._of_bytes else f"{number:,.0f}"

    def _rate(self, speed: float) -> str:
        if self._of_bytes:
            return f"{filesize.decimal(int(speed))}/s"
        return f"{speed:,.1f} per second" if speed >= 1 else f"{60 * speed:,.1f} per minute"


@contextmanager
def _printed_lines(lines: PlainLines) -> Iterator[PlainLines]:
    """Print the lines at intervals from a separate thread, so that they also appear during a long step."""
    stopped = threading.Event()

    def print_repeatedly() -> None:
        seconds = FIRST_LINE_SECONDS
        while not stopped.wait(seconds):
            lines.print_lines()
            seconds = LINE_SECONDS

    thread = threading.Thread(target=print_repeatedly, name="progress", daemon=True)
    thread.start()
    try:
        yield lines
    finally:
        stopped.set()
        thread.join()


def _duration(seconds: float) -> str:
    """Return a duration as text, such as "40 s", "5 min" or "1 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60:,} h {minutes % 60} min"
