"""Collection on a full disk: a clear error, no SIGBUS, no leftover files."""

from __future__ import annotations

import errno
import json
import os
import shutil
from typing import NamedTuple

import numpy as np
import pytest
from icrl4aht_generation.collection.job import run_task
from icrl4aht_generation.collection.record import array_shapes
from icrl4aht_generation.collection.task_folder import LEARNER, ArtefactWriter, DiskFullError, partial_folder
from icrl4aht_generation.jobs import job
from icrl4aht_generation.jobs.job import FailureLog, JobOutcome
from icrl4aht_generation.learners.resume import StateFile
from icrl4aht_generation.profiles import Profile, load_profile
from icrl4aht_generation.profiles.work import Work

from tests.robustness.limits import file_size_limit

Given = tuple[Work, Profile]


class Usage(NamedTuple):
    """Sizes of a disk in bytes."""

    total: int
    used: int
    free: int


@pytest.fixture
def task(built):
    profile = load_profile(str(built / "tiny.toml"))
    return profile.works()[0], profile


def never(update, metrics):
    raise AssertionError("the task was started")


def test_free_space_is_checked_before_the_work(task: Given, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 5_000))
    folder = tmp_path / "task"
    message = rf"^{folder}: the disk is full: this task needs [\d,]{{6,}} bytes, 5,000 are free; .* another --out$"
    with pytest.raises(DiskFullError, match=message):
        run_task(*task, folder, never)
    assert not [path for path in tmp_path.iterdir() if not path.name.endswith(".lock")]


def test_arrays_are_allocated_not_sparse(task: Given, tmp_path):
    ego = task[1].ego
    writer = ArtefactWriter(tmp_path, task[0].task, ego, 0)
    writer.close()
    for name, (shape, dtype) in array_shapes(task[0].task.layout, ego.environments, ego.episodes).items():
        path = tmp_path / f"{name}.npy"
        assert path.stat().st_blocks * 512 >= path.stat().st_size
        found = np.load(path)
        assert (found.shape, found.dtype) == (shape, dtype)
        np.save(tmp_path / "saved.npy", np.zeros(shape, dtype))
        assert path.read_bytes() == (tmp_path / "saved.npy").read_bytes()


def test_a_failed_allocation_leaves_no_files(task: Given, tmp_path):
    with file_size_limit(64 * 1024), pytest.raises(DiskFullError, match=r"task: the disk is full: this task needs "):
        run_task(*task, tmp_path / "task", never)
    assert not partial_folder(tmp_path / "task").exists()


def test_a_full_disk_keeps_the_saved_state(task: Given, tmp_path):
    def fill(update, metrics):
        if update == 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(DiskFullError, match="task: the disk is full: this task needs "):
        run_task(*task, tmp_path / "task", fill, save_seconds=0)
    assert StateFile(partial_folder(tmp_path / "task") / LEARNER).progress == 6


def test_failures_wait_for_room(task, tmp_path, monkeypatch):
    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    log, outcome = FailureLog(tmp_path / "failed.jsonl"), JobOutcome(task[0], "failed", 1, "DiskFullError: no room")
    with monkeypatch.context() as patch:
        patch.setattr(job, "atomic_write", full)
        log.add(outcome)
        assert not log.is_written
    log.forget(["another"])
    assert log.is_written
    assert json.loads((tmp_path / "failed.jsonl").read_text())["error"] == "DiskFullError: no room"
