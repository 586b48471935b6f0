"""Loggers of a training: the numbers of metrics.jsonl for TensorBoard, Weights & Biases and Trackio.

Nothing leaves the machine, unless variables of the environment say so: `WANDB_MODE=online`, `TRACKIO_SPACE_ID` or
`TRACKIO_SERVER_URL`. Whenever a run resumes, a logger gets the complete log again, so it has no step twice.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.utils.install_hints import PACKAGE, install_command

_FLUSH_SECONDS = 10


class MetricLogger(Protocol):
    """What a logger does. It is made with (folder, config): a folder of its own, and the settings of the run."""

    def write(self, line: Mapping[str, Any]) -> None:
        """Log a line of metrics.jsonl: `step`, `part`, such as "train", and numbers."""
        ...

    def close(self) -> None:
        """Write everything to the disk."""
        ...


class TensorBoardLogger:
    """Event files, one folder per part: a chart then shows the parts together."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        self._folder = folder
        self._writers: dict[str, Any] = {}

    def write(self, line: Mapping[str, Any]) -> None:
        from tensorboardX import SummaryWriter

        part = line["part"]
        if part not in self._writers:
            self._writers[part] = SummaryWriter(str(self._folder / part), flush_secs=_FLUSH_SECONDS)
        for name, value in _numbers(line).items():
            self._writers[part].add_scalar(name, value, line["step"])

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()


class WandbLogger:
    """A run of Weights & Biases, offline unless `WANDB_MODE` says otherwise."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        import wandb

        mode, project = os.environ.get("WANDB_MODE", "offline"), os.environ.get("WANDB_PROJECT", PACKAGE)
        # The defaults would also record the terminal, the load of the machine, and the state of a git repository.
        settings = wandb.Settings(console="off", silent=True, disable_git=True, x_disable_stats=True)
        run = folder.parent  # wandb adds its own folder, which has the name of `folder`
        try:
            with _replaced(os.environ, "WANDB_MODE", mode):
                self._run = wandb.init(project, name=run.name, dir=run, config=dict(config), settings=settings)
        except wandb.Error as error:
            raise OptionError(f"wandb with WANDB_MODE={mode}: {error} WANDB_MODE=offline needs no account") from error

    def write(self, line: Mapping[str, Any]) -> None:
        self._run.log(_prefixed(line), step=line["step"])

    def close(self) -> None:
        self._run.finish()


class TrackioLogger:
    """A run in a database of Trackio, which is in the folder unless `TRACKIO_DIR` or another variable names a place."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        from huggingface_hub import constants

        wanted = os.environ.get("TRACKIO_DIR") or str(folder.absolute())
        with _replaced(os.environ, "TRACKIO_DIR", wanted):
            import trackio  # reads the variable once
            from trackio.utils import TRACKIO_DIR as used
        if used != Path(wanted):
            raise OptionError(
                f"trackio writes into {used} as long as this process runs, expected {wanted}: train in another "
                "process, or set TRACKIO_DIR to one folder for all runs"
            )
        offline = constants.HF_HUB_OFFLINE or not {"TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL"} & os.environ.keys()
        # Trackio would ask Hugging Face for the user's name, and print a command that does not find the folder.
        with _replaced(constants.__dict__, "HF_HUB_OFFLINE", offline), redirect_stdout(io.StringIO()):
            self._run = trackio.init(
                PACKAGE, folder.parent.name, config=dict(config), embed=False, auto_log_gpu=False, auto_log_cpu=False
            )

    def write(self, line: Mapping[str, Any]) -> None:
        self._run.log(_prefixed(line), step=line["step"])

    def close(self) -> None:
        import trackio

        with redirect_stdout(io.StringIO()):
            trackio.finish()


_LOGGERS: dict[str, tuple[str, Callable[[Path, Mapping[str, Any]], MetricLogger]]] = {
    "tensorboard": ("tensorboardX", TensorBoardLogger),
    "wandb": ("wandb", WandbLogger),
    "trackio": ("trackio", TrackioLogger),
}
LOGGER_NAMES = ("json", *_LOGGERS)
"""Values of `train --log`. "json" is metrics.jsonl, which is always written; others have a folder of their name."""


def check_loggers(names: Iterable[str]) -> None:
    """Check that loggers are known and installed.

    Raises:
        UnknownNameError: for a name that is not among `LOGGER_NAMES`.
        OptionError: if the library of a logger is not installed; the message has the command that installs it.
    """
    for name in names:
        check_choice("logger", name, LOGGER_NAMES)
        if name in _LOGGERS and find_spec(module := _LOGGERS[name][0]) is None:
            raise OptionError(f"the log for {name} needs {module}: {install_command(name)}")


@contextmanager
def open_loggers(names: Iterable[str], metrics: Path, config: Mapping[str, Any]) -> Iterator[list[MetricLogger]]:
    """Open loggers, write the log so far, and close them at the end.

    Args:
        names: some of `LOGGER_NAMES`.
        metrics: metrics.jsonl in the run's folder; folders of loggers next to it are replaced.
        config: all settings of the run; JSON values.
    """
    opened: list[MetricLogger] = []
    try:
        for name in dict.fromkeys(names):
            if name in _LOGGERS:
                folder = metrics.parent / name
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                opened.append(_LOGGERS[name][1](folder, config))
        if opened:
            write_lines(opened, map(json.loads, metrics.read_text(encoding="utf-8").splitlines()))
        yield opened
    finally:
        for logger in opened:
            logger.close()


def write_lines(loggers: Sequence[MetricLogger], lines: Iterable[Mapping[str, Any]]) -> None:
    """Write lines of metrics.jsonl to every logger."""
    for line in lines:
        for logger in loggers:
            logger.write(line)


def _numbers(line: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name not in ("step", "part")}


def _prefixed(line: Mapping[str, Any]) -> dict[str, float]:
    return {f"{line['part']}/{name}": value for name, value in _numbers(line).items()}


@contextmanager
def _replaced(mapping: MutableMapping[str, Any], name: str, value: Any) -> Iterator[None]:
    """Set an entry of a mapping for a while."""
    before = mapping.get(name)
    mapping[name] = value
    try:
        yield
    finally:
        del mapping[name]
        if before is not None:
            mapping[name] = before
