"""Stop training on SIGTERM or SIGINT without loss of progress."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class TrainingStopped(SystemExit):
    """Exception that ends a process after a signal stopped its training; the exit code is 128 + signal number.

    The state of the training is saved before this exception is raised.

    Args:
        number: number of the signal.
        message: message for the user.
    """

    def __init__(self, number: int, message: str) -> None:
        super().__init__(number, message)
        self.code = 128 + number

    def __str__(self) -> str:
        return self.args[1]


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Context in which SIGTERM and SIGINT do not end the process, but are added to the yielded list.

    Further SIGTERMs are ignored, since schedulers and wrappers may send several. A second SIGINT has its usual effect.
    Outside the main thread, signals keep their usual effect, because Python accepts no handlers there.
    """
    received: list[int] = []
    before: dict[int, Any] = {}

    def record_signal(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if number == signal.SIGINT:
            signal.signal(number, before[number])

    if current_thread() is main_thread():
        before = {number: signal.getsignal(number) or signal.SIG_DFL for number in _SIGNALS}
        for number in _SIGNALS:
            signal.signal(number, record_signal)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
