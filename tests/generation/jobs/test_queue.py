"""The queue: local processes, failures, further attempts, jobs of other processes."""

from __future__ import annotations

import json
import os
import pickle
import signal
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from icrl4aht_baselines.training.stopping import TrainingStopped
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.jobs.job import FailedJobsError
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.populations.build import population_runs
from icrl4aht_generation.populations.train import PopulationJob
from icrl4aht_generation.profiles import load_profile
from rich.console import Console

from tests.helpers.jobs import FileJob


def run(jobs, out: Path, **options) -> str:
    console = Console(file=StringIO(), width=200)
    run_jobs(jobs, out, console, QueueOptions(**options))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_local_processes(tmp_path):
    """Two workers: one job fails once and is tried again, one always fails, one is killed."""
    jobs = [FileJob(tmp_path, "killed", killed=True), FileJob(tmp_path, "busy", busy=True)]
    jobs += [FileJob(tmp_path, "bad", failures=9), FileJob(tmp_path, "later", failures=1)]
    with pytest.raises(FailedJobsError, match=r"2 of 4 jobs are unfinished: bad, killed; .*has the reasons"):
        run(jobs, tmp_path, workers=2, retries=1)
    assert str(os.getpid()) not in {(tmp_path / name).read_text() for name in ("busy", "later")}
    lines = {line["task_id"]: line for line in map(json.loads, (tmp_path / "failed.jsonl").read_text().splitlines())}
    assert lines.keys() == {"bad", "killed"}
    assert (lines["bad"]["attempts"], lines["bad"]["error"]) == (2, "ValueError: attempt 2")
    assert "helpers/jobs.py" in lines["bad"]["traceback"]
    assert lines["killed"]["error"].startswith("BrokenProcessPool: ")
    (tmp_path / "bad.tries").write_text("x" * 9)
    jobs[0] = replace(jobs[0], killed=False)
    printed = run(jobs, tmp_path)
    assert printed.count("finished before") == 2
    assert not (tmp_path / "failed.jsonl").exists()
    assert (tmp_path / "bad").read_text() == str(os.getpid())


def test_quick_jobs_share_processes(tmp_path):
    """A job with another number of threads of XLA, or one that is not quick, has a process of its own."""
    jobs = [FileJob(tmp_path, f"{number}") for number in range(5)] + [FileJob(tmp_path, "other", xla_threads=2)]
    jobs += [FileJob(tmp_path, name, xla_threads=3, is_quick=False) for name in ("long", "longer")]
    run(jobs, tmp_path, workers=2)
    pids = [(tmp_path / job.name).read_text() for job in jobs]
    assert len({*pids[:5]}) <= 2
    assert len({pids[0], *pids[5:]}) == 4


def test_a_stopped_training_can_be_passed_between_processes():
    stopped = pickle.loads(pickle.dumps(TrainingStopped(signal.SIGTERM, "saved")))
    assert (stopped.code, str(stopped)) == (143, "saved")


def test_jobs_of_a_rebuild_have_names_and_updates(tmp_path):
    profile = load_profile("smoke")
    populations = population_runs(profile, {"demo_wide": ["fcp"]}, 0)
    jobs = [CollectionJob(work, profile, tmp_path) for work in profile.units()]
    jobs += [PopulationJob(run, tmp_path, profile.xla_threads) for run in populations]  # type: ignore[arg-type]
    assert len({job.name for job in jobs}) == len(jobs)
    assert jobs[-1].name == "demo_wide/fcp"
    assert all(job.updates > 0 and not job.is_finished() and job.progress() is None for job in jobs)
