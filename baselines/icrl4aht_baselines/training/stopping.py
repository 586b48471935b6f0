"""Stop a training by a signal without losing what it computed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class TrainingStopped(SystemExit):
    """A signal stopped a training, whose state is saved. A process that does not catch it exits with 128 + the signal.

    Args:
        number: of the signal.
        message: for the user.
    """

    def __init__(self, number: int, message: str) -> None:
        super().__init__(number, message)
        self.code = 128 + number

    def __str__(self) -> str:
        return self.args[1]


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Context in which SIGTERM and SIGINT are noted, in the list that it yields, instead of ending the process.

    Further SIGTERMs are ignored, since schedulers and wrappers may send several; a second SIGINT has its usual effect.
    Outside the main thread, where Python accepts no handlers, nothing is noted.
    """
    received: list[int] = []
    before: dict[int, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if number == signal.SIGINT:
            signal.signal(number, before[number])

    if current_thread() is main_thread():
        before = {number: signal.getsignal(number) or signal.SIG_DFL for number in _SIGNALS}
        for number in _SIGNALS:
            signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
