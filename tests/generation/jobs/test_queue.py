"""Test the job queue: local processes, failures, retries, and jobs that other processes run."""

from __future__ import annotations

import json
import os
import pickle
import signal
from dataclasses import replace
from io import StringIO
from pathlib import Path

import jax
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


def failures(out: Path) -> list[dict]:
    path = out / "failed.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def attempts(out: Path, *names: str) -> list[int]:
    """Return the number of attempts of each job."""
    return [len(path.read_text()) if (path := out / f"{name}.tries").exists() else 0 for name in names]


def test_failed_jobs_are_retried_and_reported_and_other_jobs_finish(tmp_path):
    jobs = [FileJob(tmp_path, "later", failures=2), FileJob(tmp_path, "bad", failures=3), FileJob(tmp_path, "good")]
    with pytest.raises(FailedJobsError, match=r"1 of 3 jobs are unfinished: bad; .*failed\.jsonl lists the reasons"):
        run(jobs, tmp_path, retries=2)
    assert attempts(tmp_path, "later", "bad", "good") == [3, 3, 1]
    (line,) = failures(tmp_path)
    assert (line["task_id"], line["attempts"], line["error"]) == ("bad", 3, "ValueError: attempt 3")
    assert "Traceback" in line["traceback"]
    assert "finished" in run(jobs, tmp_path)
    assert attempts(tmp_path, "bad", "good") == [4, 1]
    assert not failures(tmp_path)


def test_fail_fast_stops_at_the_first_failure(tmp_path):
    with pytest.raises(FailedJobsError, match=r"failed\.jsonl: stopped after the first failure: ValueError: attempt 1"):
        run([FileJob(tmp_path, "bad", failures=9), FileJob(tmp_path, "good")], tmp_path, fail_fast=True)
    assert attempts(tmp_path, "bad", "good") == [1, 0]
    assert len(failures(tmp_path)) == 1


def test_interrupted_job_is_not_reported_as_failed(tmp_path, monkeypatch):
    def interrupt(*arguments) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FileJob, "run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run([FileJob(tmp_path, "one")], tmp_path, retries=3)
    assert not failures(tmp_path)


def test_jobs_that_another_process_runs_come_last(tmp_path):
    printed = run([FileJob(tmp_path, "busy", busy=True), FileJob(tmp_path, "good")], tmp_path)
    works, good, busy = (printed.index(text) for text in ("1/2 busy: another process", "2/2 good: f", "1/2 busy: f"))
    assert works < good < busy


def test_jobs_in_local_processes_are_retried_and_reported(tmp_path):
    """Two processes run four jobs, with one retry. Job `killed` kills its process, and job `bad` always fails.

    Job `busy` seems to run in another process until the queue waits for it. Job `later` succeeds in its second attempt.
    """
    jobs = [FileJob(tmp_path, "killed", killed=True), FileJob(tmp_path, "busy", busy=True)]
    jobs += [FileJob(tmp_path, "bad", failures=9), FileJob(tmp_path, "later", failures=1)]
    with pytest.raises(FailedJobsError, match=r"2 of 4 jobs are unfinished: bad, killed; .*lists the reasons"):
        run(jobs, tmp_path, workers=2, retries=1)
    assert str(os.getpid()) not in {(tmp_path / name).read_text() for name in ("busy", "later")}
    lines = {line["task_id"]: line for line in failures(tmp_path)}
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


def test_jobs_of_the_same_name_count_as_one(tmp_path):
    printed = run([FileJob(tmp_path, "same"), FileJob(tmp_path, "same")], tmp_path)
    assert printed.count("same") == 1 and "unfinished" not in printed


def test_quick_jobs_share_worker_processes(tmp_path):
    """Quick jobs share at most two worker processes, and every other job gets a new process."""
    jobs = [FileJob(tmp_path, f"{number}") for number in range(5)]
    jobs += [FileJob(tmp_path, name, is_quick=False) for name in ("long", "longer")]
    run(jobs, tmp_path, workers=2)
    pids = [(tmp_path / job.name).read_text() for job in jobs]
    assert len({*pids[:5]}) <= 2
    assert len({pids[0], *pids[5:]}) == 3


@pytest.mark.parametrize("workers", [1, 2])
def test_jobs_share_a_folder_of_compiled_programs_that_is_deleted_at_the_end(tmp_path, monkeypatch, workers):
    variable = "JAX_COMPILATION_CACHE_DIR"
    monkeypatch.delenv(variable)
    folder = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    jobs = [FileJob(tmp_path, name, variable=variable) for name in ("one", "two")]
    try:
        run(jobs, tmp_path, workers=workers)
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)
    (shared,) = {(tmp_path / job.name).read_text() for job in jobs}
    assert "icrl4aht-compiled-" in shared
    assert not Path(shared).exists()
    assert variable not in os.environ


def test_jobs_use_the_given_folder_of_compiled_programs(tmp_path):
    run([FileJob(tmp_path, "one", variable="JAX_COMPILATION_CACHE_DIR")], tmp_path)
    assert (tmp_path / "one").read_text() == jax.config.values["jax_compilation_cache_dir"]


def test_training_stopped_error_can_be_pickled():
    stopped = pickle.loads(pickle.dumps(TrainingStopped(signal.SIGTERM, "saved")))
    assert (stopped.code, str(stopped)) == (143, "saved")


def test_jobs_of_a_rebuild_have_unique_names_and_positive_numbers_of_updates(tmp_path):
    profile = load_profile("smoke")
    populations = population_runs(profile, {"demo_wide": ["fcp"]}, 0)
    jobs = [CollectionJob(work, profile, tmp_path) for work in profile.units()]
    jobs += [PopulationJob(run, tmp_path, profile.xla_threads) for run in populations]  # type: ignore[arg-type]
    assert len({job.name for job in jobs}) == len(jobs)
    assert jobs[-1].name == "demo_wide/fcp"
    assert all(job.updates > 0 and not job.is_finished() and job.progress() is None for job in jobs)
