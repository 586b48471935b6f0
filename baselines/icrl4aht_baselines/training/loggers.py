"""Loggers of a training run, which write the numbers of metrics.jsonl for TensorBoard, Weights & Biases and Trackio.

Nothing is uploaded, unless one of the environment variables `WANDB_MODE=online`, `TRACKIO_SPACE_ID` and
`TRACKIO_SERVER_URL` is set. When a run resumes, each logger is restarted with the complete log, so no step is repeated.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.utils.install_hints import PACKAGE, install_command

_FLUSH_SECONDS = 10


LogLine = Callable[[Mapping[str, Any]], None]
"""Function that logs a line of metrics.jsonl, which has `step`, `part`, such as "train", and numbers."""


@contextmanager
def _tensorboard(folder: Path, config: Mapping[str, Any]) -> Iterator[LogLine]:
    """Log to TensorBoard event files, in one folder for each part of the data; charts then show all parts together."""
    from tensorboardX import SummaryWriter

    writers: dict[str, Any] = {}

    def log(line: Mapping[str, Any]) -> None:
        part = line["part"]
        if part not in writers:
            writers[part] = SummaryWriter(str(folder / part), flush_secs=_FLUSH_SECONDS)
        for name, value in _numbers(line).items():
            writers[part].add_scalar(name, value, line["step"])

    try:
        yield log
    finally:
        for writer in writers.values():
            writer.close()


@contextmanager
def _wandb(folder: Path, config: Mapping[str, Any]) -> Iterator[LogLine]:
    """Log to a run of Weights & Biases. The run is offline unless `WANDB_MODE` says otherwise."""
    import wandb

    mode, project = os.environ.get("WANDB_MODE", "offline"), os.environ.get("WANDB_PROJECT", PACKAGE)
    # By default, wandb would also record terminal output, machine load, and the state of a git repository.
    settings = wandb.Settings(console="off", silent=True, disable_git=True, x_disable_stats=True)
    run = folder.parent  # wandb itself creates `folder` in this folder
    try:
        with _temporary_entry(os.environ, "WANDB_MODE", mode):
            started = wandb.init(project, name=run.name, dir=run, config=dict(config), settings=settings)
    except wandb.Error as error:
        reason = str(error).rstrip(".")
        raise OptionError(f"wandb with WANDB_MODE={mode}: {reason}; WANDB_MODE=offline needs no account") from error
    try:
        yield lambda line: started.log(_numbers_with_part(line), step=line["step"])
    finally:
        started.finish()


@contextmanager
def _trackio(folder: Path, config: Mapping[str, Any]) -> Iterator[LogLine]:
    """Log to a Trackio database in the run's folder, or in the folder `TRACKIO_DIR` if this variable is set."""
    from huggingface_hub import constants

    wanted = os.environ.get("TRACKIO_DIR") or str(folder.absolute())
    with _temporary_entry(os.environ, "TRACKIO_DIR", wanted):
        import trackio  # trackio reads TRACKIO_DIR only at its first import
        from trackio.utils import TRACKIO_DIR as used
    if used != Path(wanted):
        raise OptionError(
            f"trackio reads TRACKIO_DIR only once and still writes into {used}, expected {wanted}: train in another "
            "process, or set TRACKIO_DIR to one folder for all runs"
        )
    offline = constants.HF_HUB_OFFLINE or not {"TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL"} & os.environ.keys()
    options: Any = {"config": dict(config), "embed": False, "auto_log_gpu": False, "auto_log_cpu": False}
    # Without these contexts, Trackio would request the user's name from Hugging Face, and print a command that does not
    # work here.
    with _temporary_entry(constants.__dict__, "HF_HUB_OFFLINE", offline), redirect_stdout(io.StringIO()):
        started = trackio.init(PACKAGE, folder.parent.name, **options)
    try:
        yield lambda line: started.log(_numbers_with_part(line), step=line["step"])
    finally:
        with redirect_stdout(io.StringIO()):
            trackio.finish()


_LOGGERS: dict[str, tuple[str, Callable[[Path, Mapping[str, Any]], AbstractContextManager[LogLine]]]] = {
    "tensorboard": ("tensorboardX", _tensorboard),
    "wandb": ("wandb", _wandb),
    "trackio": ("trackio", _trackio),
}
LOGGER_NAMES = ("json", *_LOGGERS)
"""Values of `train --log`. "json" is metrics.jsonl, which is always written; others write into folders."""


def check_loggers(names: Iterable[str]) -> None:
    """Check that loggers are known and installed.

    Raises:
        UnknownNameError: if a name is not in `LOGGER_NAMES`.
        OptionError: if the library of a logger is not installed; the message states the command that installs it.
    """
    for name in names:
        check_choice("logger", name, LOGGER_NAMES)
        if name in _LOGGERS and find_spec(module := _LOGGERS[name][0]) is None:
            raise OptionError(f"the logger {name} needs {module}: {install_command(name)}")


@contextmanager
def open_loggers(names: Iterable[str], metrics: Path, config: Mapping[str, Any]) -> Iterator[list[LogLine]]:
    """Context manager of open loggers, which first receive the log lines written so far.

    Args:
        names: names of loggers, from `LOGGER_NAMES`.
        metrics: path of metrics.jsonl in the run folder; the loggers' folders next to this file are replaced.
        config: all settings of the run, as JSON.
    """
    with ExitStack() as stack:
        opened = []
        for name in dict.fromkeys(name for name in names if name in _LOGGERS):
            folder = metrics.parent / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            opened.append(stack.enter_context(_LOGGERS[name][1](folder, config)))
        if opened:
            write_lines(opened, map(json.loads, metrics.read_text(encoding="utf-8").splitlines()))
        yield opened


def write_lines(loggers: Sequence[LogLine], lines: Iterable[Mapping[str, Any]]) -> None:
    """Write lines of metrics.jsonl to every logger."""
    for line in lines:
        for log in loggers:
            log(line)


def _numbers(line: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name not in ("step", "part")}


def _numbers_with_part(line: Mapping[str, Any]) -> dict[str, float]:
    return {f"{line['part']}/{name}": value for name, value in _numbers(line).items()}


@contextmanager
def _temporary_entry(mapping: MutableMapping[str, Any], name: str, value: Any) -> Iterator[None]:
    """Context manager that temporarily changes an entry of a mapping."""
    before = mapping.get(name)
    mapping[name] = value
    try:
        yield
    finally:
        del mapping[name]
        if before is not None:
            mapping[name] = before
