"""Collection of all tasks of a rebuild: missing tasks, two processes at once, and workers on Ray."""

from __future__ import annotations

import ipaddress
import json
import shutil
import sys
import time

import psutil
import pytest
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task_folder import LEARNER, partial_folder
from icrl4aht_generation.jobs.job import JobBoard, run_job
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.learners.resume import run_lock
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.check import compare_rebuilds
from rich.console import Console

from icrl4aht_data import verify_release
from icrl4aht_data.commands.cli import main
from icrl4aht_data.errors import OptionError
from tests.helpers.jobs import FileJob
from tests.helpers.tiny import artefact, start


@pytest.fixture
def tasks(built):
    profile = load_profile(str(built / "pair.toml"))
    return profile.units(), profile


def test_task_collected_by_another_process_is_waited_for(tasks, built, tmp_path):
    """A task that another process finishes in the meantime is not collected again."""
    work, profile = tasks[0][0], tasks[1]
    folder = tmp_path / "artefacts" / work.name
    folder.parent.mkdir()
    with run_lock(folder):
        assert run_job(CollectionJob(work, profile, folder.parent), wait=False) == "busy"
        shutil.copytree(artefact(built / "a"), folder)
    before = (folder / "metadata.json").stat().st_mtime_ns
    assert run_job(CollectionJob(work, profile, folder.parent), wait=True) == "done"
    assert (folder / "metadata.json").stat().st_mtime_ns == before


def test_unfinished_task_gives_exit_code_1_and_no_release(tasks, built, tmp_path, monkeypatch, capsys):
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
def test_two_generate_commands_at_once_collect_each_task_once(built, pair, tmp_path):
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(built / "pair.toml"), "--out", str(tmp_path)]
    processes = [start(*command) for _ in range(2)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    for folder in (artefact(tmp_path, 0), artefact(tmp_path, 1)):
        updates = [json.loads(line)["update"] for line in (folder / "timing.jsonl").read_text().splitlines()]
        assert updates == list(range(25))
    assert not compare_rebuilds(tmp_path, pair).differences


def listening_addresses(process: psutil.Process) -> set[str]:
    """Return the IP addresses on which a process and its children listen."""
    found = set()
    for child in [process, *process.children(recursive=True)]:
        try:
            found |= {c.laddr.ip for c in child.net_connections("inet") if c.status == psutil.CONN_LISTEN}
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found


@pytest.mark.slow
def test_two_ray_workers_collect_bit_equal_tasks(built, pair, tmp_path):
    """A damaged task fails and the other task finishes; after a repair both tasks equal those collected in one process.
    Meanwhile, no process listens on addresses other than the loopback."""
    broken = partial_folder(tmp_path / "artefacts" / artefact(pair, 1).name)
    broken.mkdir(parents=True)
    (broken / LEARNER).write_bytes(b"junk")
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(built / "pair.toml"), "--out", str(tmp_path)]
    command += ["--executor", "ray", "--workers", "2", "--retries", "1"]
    addresses: set[str] = set()
    process = start(*command)
    while process.poll() is None:
        addresses |= listening_addresses(psutil.Process(process.pid))
        time.sleep(0.5)  # listing all connections takes much CPU time
    output, errors = process.communicate()
    assert process.returncode == 1, output + errors
    assert "1 of 2 jobs are unfinished" in errors
    (line,) = map(json.loads, (tmp_path / "failed.jsonl").read_text().splitlines())
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


def test_number_of_workers_for_an_existing_ray_cluster_raises_error(tmp_path):
    jobs = [FileJob(tmp_path, "one")]
    with pytest.raises(OptionError, match="workers = 2: the Ray cluster at there:6379 sets the number"):
        run_jobs(jobs, tmp_path, Console(), QueueOptions(executor="ray", address="there:6379", workers=2))


def test_job_board_shows_jobs_updates_and_speed():
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
