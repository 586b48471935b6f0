"""All tasks of a rebuild: failures, retries, two collectors at once, Ray."""

from __future__ import annotations

import ipaddress
import json
import shutil
import sys
import time
from io import StringIO
from pathlib import Path

import psutil
import pytest
from icrl4aht_generation.collection import job
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task_folder import LEARNER, partial_folder
from icrl4aht_generation.jobs.job import FailedJobsError, JobBoard, run_job
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.learners.resume import BusyError, run_lock
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.check import compare_rebuilds
from rich.console import Console

from icrl4aht_data import verify_release
from icrl4aht_data.commands.cli import main
from icrl4aht_data.errors import OptionError
from tests.helpers.tiny import artefact, start


@pytest.fixture
def tasks(built):
    profile = load_profile(str(built / "pair.toml"))
    return profile.units(), profile


def failures(out: Path) -> list[dict]:
    path = out / "failed.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def collect(tasks, out: Path, console: Console | None = None, **options) -> str:
    """Collect the tasks and return the printed output."""
    console = console or Console(file=StringIO(), width=500)
    jobs = [CollectionJob(work, tasks[1], out / "artefacts") for work in tasks[0]]
    run_jobs(jobs, out, console, QueueOptions(**options))
    return console.file.getvalue()  # type: ignore[attr-defined]


def failing(monkeypatch, *errors: Exception | None) -> list[int]:
    """Replace the runner by one whose n-th call raises the n-th error; returns the seeds it was called with."""
    calls: list[int] = []

    def run_task(work, profile, folder, report, *, suite, wait):
        calls.append(work.task.seed)
        error = errors[len(calls) - 1] if len(calls) <= len(errors) else None
        if error is not None:
            raise error
        return True

    monkeypatch.setattr(job, "run_task", run_task)
    return calls


def test_a_failing_task_is_reported_and_others_finish(tasks, tmp_path, monkeypatch):
    calls = failing(monkeypatch, ZeroDivisionError("no steps"))
    with pytest.raises(FailedJobsError, match=r"1 of 2 jobs are unfinished: .*_s0_.*failed\.jsonl has the reasons"):
        collect(tasks, tmp_path)
    assert calls == [0, 1]
    (line,) = failures(tmp_path)
    assert (line["task_id"], line["attempts"]) == (tasks[0][0].name, 1)
    assert line["error"] == "ZeroDivisionError: no steps"
    assert "Traceback" in line["traceback"]
    assert "finished" in collect(tasks, tmp_path)
    assert not (tmp_path / "failed.jsonl").exists()


def test_retries(tasks, tmp_path, monkeypatch):
    calls = failing(monkeypatch, OSError("once"), OSError("twice"))
    collect(tasks, tmp_path, retries=2)
    assert calls == [0, 0, 0, 1]
    calls = failing(monkeypatch, *[OSError("always")] * 3)
    with pytest.raises(FailedJobsError):
        collect(tasks, tmp_path, retries=2)
    assert calls == [0, 0, 0, 1]
    assert [line["attempts"] for line in failures(tmp_path)] == [3]


def test_fail_fast(tasks, tmp_path, monkeypatch):
    calls = failing(monkeypatch, OSError("first"))
    with pytest.raises(FailedJobsError, match=r"failed\.jsonl: the first failure: OSError: first"):
        collect(tasks, tmp_path, fail_fast=True)
    assert calls == [0]
    assert len(failures(tmp_path)) == 1


def test_an_interrupt_is_no_failure(tasks, tmp_path, monkeypatch):
    failing(monkeypatch, KeyboardInterrupt())  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        collect(tasks, tmp_path, retries=3)
    assert not failures(tmp_path)


def test_tasks_of_another_collector_come_last(tasks, tmp_path, monkeypatch):
    calls = failing(monkeypatch, BusyError("busy"))
    assert "another process works on it" in collect(tasks, tmp_path)
    assert calls == [0, 1, 0]


def test_waiting_for_the_other_collector(tasks, built, tmp_path):
    """A task that the other collector finishes is not repeated."""
    work, profile = tasks[0][0], tasks[1]
    folder = tmp_path / "artefacts" / work.name
    folder.parent.mkdir()
    with run_lock(folder):
        assert run_job(CollectionJob(work, profile, folder.parent), wait=False) == "busy"
        shutil.copytree(artefact(built / "a"), folder)
    before = (folder / "metadata.json").stat().st_mtime_ns
    assert run_job(CollectionJob(work, profile, folder.parent), wait=True) == "done"
    assert (folder / "metadata.json").stat().st_mtime_ns == before


def test_exit_code_1_and_nothing_packed_if_a_task_is_missing(tasks, built, tmp_path, monkeypatch, capsys):
    shutil.copytree(built / "a" / "artefacts", tmp_path / "artefacts")
    partial = partial_folder(tmp_path / "artefacts" / tasks[0][1].name)
    partial.mkdir()
    (partial / LEARNER).write_bytes(b"junk")
    monkeypatch.setattr(
        sys, "argv", ["icrl4aht_generation", "generate", "--profile", str(built / "pair.toml"), "--out", str(tmp_path)]
    )
    with pytest.raises(SystemExit, match="1"):
        main()
    captured = capsys.readouterr()
    assert "1 of 2 jobs are unfinished" in captured.err
    assert "finished before" in captured.out
    assert not (tmp_path / "lite").exists()


@pytest.mark.slow
def test_two_collectors_at_once_do_each_task_once(built, pair, tmp_path):
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(built / "pair.toml"), "--out", str(tmp_path)]
    processes = [start(*command) for _ in range(2)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    for folder in (artefact(tmp_path, 0), artefact(tmp_path, 1)):
        updates = [json.loads(line)["update"] for line in (folder / "timing.jsonl").read_text().splitlines()]
        assert updates == list(range(25))
    assert not compare_rebuilds(tmp_path, pair).differences


def listening(process: psutil.Process) -> set[str]:
    """Return the addresses that a process and its children listen on."""
    found = set()
    for child in [process, *process.children(recursive=True)]:
        try:
            found |= {c.laddr.ip for c in child.net_connections("inet") if c.status == psutil.CONN_LISTEN}
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found


@pytest.mark.slow
def test_ray_with_two_workers(built, pair, tmp_path):
    """A damaged task fails and the other is finished; then both, bit-equal to the collection in one process; all that
    time, nothing listens beyond the loopback."""
    broken = partial_folder(tmp_path / "artefacts" / artefact(pair, 1).name)
    broken.mkdir(parents=True)
    (broken / LEARNER).write_bytes(b"junk")
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(built / "pair.toml"), "--out", str(tmp_path)]
    command += ["--executor", "ray", "--workers", "2", "--retries", "1"]
    addresses: set[str] = set()
    process = start(*command)
    while process.poll() is None:
        addresses |= listening(psutil.Process(process.pid))
        time.sleep(0.5)  # reading all connections takes CPU time
    output, errors = process.communicate()
    assert process.returncode == 1, output + errors
    assert "1 of 2 jobs are unfinished" in errors
    (line,) = failures(tmp_path)
    assert line["attempts"] == 2
    assert line["error"].startswith("OptionError: ")
    assert "in progress" in line["traceback"]
    assert "\x1b" not in line["traceback"]
    assert artefact(tmp_path).name == artefact(pair).name
    shutil.rmtree(broken)
    output, errors = (process := start(*command)).communicate()
    assert process.returncode == 0, output + errors
    assert not compare_rebuilds(tmp_path, pair).differences
    assert verify_release(tmp_path / "lite").ok
    assert addresses
    assert all(ipaddress.ip_address(address.removeprefix("::ffff:")).is_loopback for address in addresses), addresses


def test_workers_of_a_cluster_are_its_own(tasks, tmp_path):
    with pytest.raises(OptionError, match="workers = 2: the Ray at there:6379 has its own"):
        collect(tasks, tmp_path, executor="ray", address="there:6379", workers=2)


def test_the_board_counts_tasks_updates_and_speed():
    shown = []
    board = JobBoard(lambda *bar: shown.append(bar), {"one": 10, "two": 10})
    board.show_running("one", 5, 1_000.0)
    board.show_running("two", 2, 500.0)
    board.show_ended("one")
    assert shown == [
        ("all jobs", 0, 20, "0/2 jobs"),
        ("all jobs", 5, 20, "0/2 jobs, 1,000 steps/s"),
        ("all jobs", 7, 20, "0/2 jobs, 1,500 steps/s"),
        ("all jobs", 12, 20, "1/2 jobs, 500 steps/s"),
    ]
