"""Test loggers of training runs with the real logging libraries in their offline modes."""

from __future__ import annotations

import json
import socket
import sqlite3
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.training.loggers import check_loggers, open_loggers, write_lines

from icrl4aht_data.errors import OptionError, UnknownNameError

Value = tuple[int, str, float]
LINES = [
    {"step": 2, "part": "train", "loss": 1.5, "gradient_norm": 0.25},
    {"step": 3, "part": "held out", "loss": 2.5},
    {"step": 4, "part": "train", "loss": 1.25, "gradient_norm": 0.125},
]


def expected_values(lines: list[dict[str, Any]]) -> list[Value]:
    return sorted(
        (line["step"], f"{line['part']}/{name}", float(np.float32(value)))
        for line in lines
        for name, value in line.items()
        if name not in ("part", "step")
    )


def tensorboard_values(run: Path) -> list[Value]:
    """Return (step, part/name, value) of each record in a run's TensorBoard files."""
    from tensorboardX.proto.event_pb2 import Event  # type: ignore[attr-defined]

    found = []
    for path in run.glob("tensorboard/*/*"):
        content, at = path.read_bytes(), 0
        while at < len(content):
            (length,) = struct.unpack_from("<Q", content, at)
            event = Event.FromString(content[at + 12 : at + 12 + length])
            found += [(event.step, f"{path.parent.name}/{one.tag}", one.simple_value) for one in event.summary.value]
            at += length + 16
    return sorted(found)


def wandb_values(run: Path) -> list[Value]:
    """Return (step, part/name, value) of each record, waiting until wandb's process has written them."""
    for _ in range(100):
        if found := wandb_records(run):
            return found
        time.sleep(0.1)
    return []


def wandb_records(run: Path) -> list[Value]:
    """Return (step, part/name, value) of each record in wandb's offline file, a LevelDB log of one block."""
    from wandb.proto import wandb_internal_pb2

    (path,) = run.glob("wandb/offline-run-*/*.wandb")
    content, at, found = path.read_bytes(), 7, []
    assert len(content) < 32768
    while at < len(content):
        _, length, kind = struct.unpack_from("<IHB", content, at)
        assert kind == 1, "expected a complete record"
        record = wandb_internal_pb2.Record.FromString(content[at + 7 : at + 7 + length])  # type: ignore[attr-defined]
        items = {item.key or "/".join(item.nested_key): item.value_json for item in record.history.item}
        step = record.history.step.num
        found += [(step, name, json.loads(value)) for name, value in items.items() if not name.startswith("_")]
        at += 7 + length
    return sorted(found)


def trackio_values(run: Path) -> list[Value]:
    """Return (step, part/name, value) of each record in a run's trackio database."""
    with sqlite3.connect(f"file:{run}/trackio/icrl4aht-data.db?mode=ro", uri=True) as database:
        rows = database.execute("select step, metrics from metrics where run_name = ?", [run.name]).fetchall()
    database.close()
    return sorted((step, name, value) for step, text in rows for name, value in json.loads(text).items())


READERS: dict[str, Callable[[Path], list[Value]]] = {
    "tensorboard": tensorboard_values,
    "wandb": wandb_values,
    "trackio": trackio_values,
}


@pytest.fixture
def offline(monkeypatch):
    """Remove environment variables of the loggers, set a token, and allow connections only to this machine."""
    for name in ("WANDB_MODE", "WANDB_PROJECT", "TRACKIO_DIR", "TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HF_TOKEN", "hf_of_a_test")
    connect, hosts = socket.socket.connect, []

    def connect_locally(self: socket.socket, address: Any) -> None:
        if self.family != socket.AF_UNIX and address[0] not in ("127.0.0.1", "::1"):
            hosts.append(address[0])
            raise OSError(f"{address}: no network in tests")
        connect(self, address)

    resolve = socket.getaddrinfo
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda host, *more, **named: hosts.append(host) or resolve("127.0.0.1", *more, **named)
    )
    monkeypatch.setattr(socket.socket, "connect", connect_locally)
    yield
    assert not hosts


def unload_library(library: str) -> None:
    """Remove a library from the imported modules, since trackio chooses its folder when it is imported."""
    for name in [name for name in sys.modules if name.partition(".")[0] == library]:
        del sys.modules[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_loggers_of_a_resumed_run_store_each_line_exactly_once(tmp_path, name, offline, capfd):
    pytest.importorskip("tensorboardX" if name == "tensorboard" else name)
    unload_library("trackio")
    run = tmp_path / "ad-run"
    run.mkdir()
    metrics = run / "metrics.jsonl"
    metrics.touch()
    with pytest.raises(KeyboardInterrupt), open_loggers([name, "json"], metrics, {"train": {"seed": 0}}) as loggers:
        write_lines(loggers, LINES)
        raise KeyboardInterrupt
    assert READERS[name](run) == expected_values(LINES)
    # Resuming from a checkpoint of step 2 keeps only the first line.
    metrics.write_text("".join(json.dumps(line) + "\n" for line in LINES[:1]))
    more = [*LINES[1:], {"step": 6, "part": "train", "loss": 1.0}]
    with open_loggers([name, name], metrics, {"train": {"seed": 0}}) as loggers:
        write_lines(loggers, more)
    assert READERS[name](run) == expected_values([LINES[0], *more])
    assert {path.name for path in run.iterdir()} == {"metrics.jsonl", name}
    assert capfd.readouterr().out == ""


def log_two_runs(folder: Path) -> None:
    """Log two runs with trackio in this process."""
    pytest.importorskip("trackio")
    unload_library("trackio")
    for run in ("one", "two"):
        (folder / run).mkdir()
        (folder / run / "metrics.jsonl").touch()
        with open_loggers(["trackio"], folder / run / "metrics.jsonl", {}) as loggers:
            write_lines(loggers, LINES)


def test_second_trackio_folder_in_a_process_raises_error(tmp_path, offline):
    with pytest.raises(
        OptionError, match=r"only once and still writes into .* expected .*two.*: train in another process"
    ):
        log_two_runs(tmp_path)
    assert trackio_values(tmp_path / "one") == expected_values(LINES)


def test_variable_trackio_dir_sets_the_folder_of_all_runs(tmp_path, offline, monkeypatch):
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    log_two_runs(tmp_path)
    with sqlite3.connect(tmp_path / "trackio" / "icrl4aht-data.db") as database:
        assert {name for (name,) in database.execute("select run_name from metrics")} == {"one", "two"}
    database.close()


def test_unknown_logger_raises_error():
    check_loggers(["json"])
    with pytest.raises(UnknownNameError, match=r"unknown logger 'wandbb'.*wandb"):
        check_loggers(["wandbb"])
