"""Stop a training by a signal without losing what it computed."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
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


class StopSignals:
    """Context in which SIGTERM and SIGINT are noted instead of ending the process.

    Further SIGTERMs are ignored, since schedulers and wrappers may send several; a second SIGINT has its usual effect.
    Outside the main thread, where Python accepts no handlers, nothing is noted.

    Attributes:
        received: number of the first signal; 0 if there was none.
    """

    def __init__(self) -> None:
        self.received = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        try:
            for number in _SIGNALS:
                self._before[number] = signal.signal(number, self._note) or signal.SIG_DFL
        except ValueError:  # not the main thread
            self._before.clear()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = self.received or number
        if number == signal.SIGINT:
            signal.signal(number, self._before[number])
