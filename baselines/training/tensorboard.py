"""A run's log for TensorBoard, by tensorboardX (extra `tensorboard`)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import OptionError

_SECONDS = 10  # between writes, so that one can look on


class Events:
    """Event files with the numbers of metrics.jsonl, in a folder for each part: a chart shows the parts together.

    They are made anew from the log whenever a run goes on, so they hold what the log holds, and no step twice.

    Args:
        folder: what it holds is replaced.
        metrics: the log so far.
    """

    def __init__(self, folder: Path, metrics: Path) -> None:
        self._folder = folder
        self._writers: dict[str, Any] = {}
        shutil.rmtree(folder, ignore_errors=True)
        if metrics.exists():
            self.add(json.loads(line) for line in metrics.read_text(encoding="utf-8").splitlines())

    def add(self, lines: Iterable[dict[str, Any]]) -> None:
        """Write lines of the log."""
        for line in lines:
            writer = self._writer(line["part"])
            for name, value in line.items():
                if name not in ("step", "part"):
                    writer.add_scalar(name, value, line["step"])

    def _writer(self, part: str) -> Any:
        from tensorboardX import SummaryWriter

        if part not in self._writers:
            self._writers[part] = SummaryWriter(str(self._folder / part), flush_secs=_SECONDS)
        return self._writers[part]

    def close(self) -> None:
        """Write what is left."""
        for writer in self._writers.values():
            writer.close()


def check_installed() -> None:
    """Whether there is tensorboardX.

    Raises:
        OptionError: if not.
    """
    try:
        import tensorboardX  # noqa: F401
    except ImportError as error:
        raise OptionError("TensorBoard's log needs tensorboardX: pip install 'icrl4aht-data[tensorboard]'") from error
