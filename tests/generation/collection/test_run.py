"""Test collecting all tasks of a rebuild: unfinished tasks, two processes at once, and workers on Ray."""

from __future__ import annotations

import ipaddress
import json
import shutil
import time
from pathlib import Path

import psutil
import pytest
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task_folder import LEARNER, METADATA, partial_folder
from icrl4aht_generation.jobs.job import FailedJobsError, JobBoard, run_job
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.learners.resume import run_lock
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.check import compare_rebuilds
from rich.console import Console

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import OptionError
from tests.helpers.commands import run_cli
from tests.helpers.jobs import FileJob
from tests.helpers.tiny import PAIR, artefact, start_python


@pytest.fixture(scope="module")
def profile(tmp_path_factory) -> Path:
    """Return the path of a profile with two tasks; its first task and its file name equal those of `built`."""
    path = tmp_path_factory.mktemp("pair") / "tiny.toml"
    path.write_text(PAIR)
    return path


@pytest.fixture
def damaged_partial(profile, built, tmp_path) -> Path:
    """Write a damaged partial artefact for the second task, and return its folder."""
    (name,) = {work.name for work in load_profile(str(profile)).units()} - {artefact(built / "a").name}
    partial = partial_folder(tmp_path / "artefacts" / name)
    partial.mkdir(parents=True)
    (partial / LEARNER).write_bytes(b"junk")
    return partial


def test_job_does_not_repeat_a_task_that_another_process_collected(built, tmp_path):
    """The job does not collect the task again if the other process has finished it."""
    profile = load_profile(str(built / "tiny.toml"))
    (work,) = profile.units()
    job = CollectionJob(work, profile, tmp_path)
    with run_lock(job.folder):
        assert run_job(job, wait=False) == "busy"
        shutil.copytree(artefact(built / "a"), job.folder)
    before = (job.folder / METADATA).stat().st_mtime_ns
    assert run_job(job, wait=True) == "done"
    assert (job.folder / METADATA).stat().st_mtime_ns == before


def test_rebuild_with_an_unfinished_task_writes_no_release(profile, damaged_partial, built, tmp_path):
    shutil.copytree(artefact(built / "a"), damaged_partial.parent / artefact(built / "a").name)
    with pytest.raises(FailedJobsError, match="1 of 2 jobs are unfinished"):
        run_cli("generate", "--profile", profile, "--out", tmp_path)
    assert not (tmp_path / "lite").exists()


@pytest.mark.slow
def test_two_generate_commands_at_once_collect_a_task_once(built, tmp_path):
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(built / "tiny.toml"), "--out", str(tmp_path)]
    processes = [start_python(*command) for _ in range(2)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    timing = (artefact(tmp_path) / "timing.jsonl").read_text().splitlines()
    assert [json.loads(line)["update"] for line in timing] == list(range(25))
    for part in ("artefacts", "lite"):
        assert not compare_rebuilds(tmp_path / part, built / "a" / part).differences


def listening_addresses(process: psutil.Process) -> set[str]:
    """Return the IP addresses on which a process and its children listen."""
    found = set()
    for child in [process, *process.children(recursive=True)]:
        try:
            found |= {c.laddr.ip for c in child.net_connections("tcp") if c.status == psutil.CONN_LISTEN}
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found


@pytest.mark.slow
def test_ray_workers_collect_bit_equal_tasks(profile, damaged_partial, built, tmp_path):
    """Ray workers collect a task with the same results as one process, and fail on a task with damaged files.

    Without the damaged files, the second task is collected too. All processes listen only on loopback addresses.
    """
    command = ["-m", "icrl4aht_data", "generate", "--profile", str(profile), "--out", str(tmp_path)]
    addresses: set[str] = set()
    process = start_python(*command, "--executor", "ray", "--workers", "2", "--retries", "1")
    while process.poll() is None:
        addresses |= listening_addresses(psutil.Process(process.pid))
        time.sleep(2)  # listing all connections takes much CPU time, and servers listen until the end
    output, errors = process.communicate()
    assert process.returncode == 1, output + errors
    assert "1 of 2 jobs are unfinished" in errors
    (line,) = map(json.loads, (tmp_path / "failed.jsonl").read_text().splitlines())
    assert line["attempts"] == 2
    assert line["error"].startswith("OptionError: ")
    assert "in progress" in line["traceback"]
    assert "\x1b" not in line["traceback"]
    own = artefact(built / "a")
    assert not compare_rebuilds(damaged_partial.parent / own.name, own).differences
    assert addresses
    assert all(ipaddress.ip_address(address.removeprefix("::ffff:")).is_loopback for address in addresses), addresses
    shutil.rmtree(damaged_partial)
    run_cli("generate", "--profile", profile, "--out", tmp_path)
    assert len(load_icrl4aht(tmp_path / "lite").tasks) == 2
    assert verify_release(tmp_path / "lite").ok


def test_number_of_workers_for_an_existing_ray_cluster_raises_error(tmp_path):
    jobs = [FileJob(tmp_path, "one")]
    with pytest.raises(OptionError, match="workers = 2: the Ray cluster at there:6379 sets the number"):
        run_jobs(jobs, tmp_path, Console(), QueueOptions(executor="ray", address="there:6379", workers=2))


def test_job_board_shows_jobs_updates_and_speed():
    shown = []
    board = JobBoard(lambda *bar: shown.append(bar), {"one": 10, "two": 10})
    board.show_running("one", 5, 1_000.0)
    board.show_running("two", 2, 500.0)
    board.show_ended("one", failed=False)
    board.show_ended("two", failed=True)
    assert shown == [
        ("all jobs", 0, 20, "0/2 jobs"),
        ("all jobs", 5, 20, "0/2 jobs, 1,000 steps/s"),
        ("all jobs", 7, 20, "0/2 jobs, 1,500 steps/s"),
        ("all jobs", 12, 20, "1/2 jobs, 500 steps/s"),
        ("all jobs", 10, 10, "1/2 jobs, 1 failed"),
    ]
