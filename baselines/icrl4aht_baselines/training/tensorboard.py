"""A run's log for TensorBoard, written by tensorboardX (extra `tensorboard`)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import install_command

_FLUSH_SECONDS = 10


class TensorBoardLog:
    """Event files with the numbers of metrics.jsonl, one folder per part: a chart then shows the parts together.

    They are rewritten from the log whenever a run resumes, so they hold the log's lines, and no step twice.

    Args:
        folder: its content is replaced.
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
        from tensorboardX import SummaryWriter

        for line in lines:
            part = line["part"]
            if part not in self._writers:
                self._writers[part] = SummaryWriter(str(self._folder / part), flush_secs=_FLUSH_SECONDS)
            for name, value in line.items():
                if name not in ("step", "part"):
                    self._writers[part].add_scalar(name, value, line["step"])

    def close(self) -> None:
        """Write everything to the disk."""
        for writer in self._writers.values():
            writer.close()


def check_installed() -> None:
    """Check that tensorboardX is installed.

    Raises:
        OptionError: if it is not.
    """
    try:
        import tensorboardX  # noqa: F401
    except ImportError as error:
        raise OptionError(f"TensorBoard's log needs tensorboardX: {install_command('tensorboard')}") from error
