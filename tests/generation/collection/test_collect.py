"""Test collecting one task: killed and resumed runs write the same artefact; full disks give clear errors."""

from __future__ import annotations

import errno
import os
import shutil
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from icrl4aht_generation.collection import task as collect
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task_folder import (
    LEARNER,
    METADATA,
    METRICS,
    ArtefactWriter,
    DiskFullError,
    array_shapes,
    partial_folder,
)
from icrl4aht_generation.learners.resume import StateFile
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.check import compare_rebuilds

from tests.helpers.tiny import TINY, artefact, start_python
from tests.robustness.limits import file_size_limit

COLLECT = """
import sys, time
from pathlib import Path
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.profiles import load_profile

def report(updates, speed):
    print(updates, flush=True)
    time.sleep(0.1)

profile = load_profile(sys.argv[1])
CollectionJob(*profile.units(), profile, Path(sys.argv[2])).run(report, save_seconds=float(sys.argv[3]))
"""


@pytest.fixture
def job(built, tmp_path) -> CollectionJob:
    profile = load_profile(str(built / "tiny.toml"))
    return CollectionJob(profile.units()[0], profile, tmp_path)


def stop_after(updates: int):
    def report(done, speed):
        if done == updates:
            raise KeyboardInterrupt

    return report


def fail_on_update(updates, speed):
    raise AssertionError("expected no further update of the task")


@pytest.mark.slow
def test_collection_killed_at_random_times_writes_the_same_artefact(built, tmp_path):
    folder = tmp_path / artefact(built / "a").name
    command = ["-c", COLLECT, str(built / "tiny.toml"), str(tmp_path), "0.1"]
    seed = int(os.environ.get("KILL_SEED", "7"))
    print(f"KILL_SEED={seed}")
    random, firsts, killed = np.random.default_rng(seed), [], []
    for _ in range(2):
        updates, then = int(random.integers(2, 5)), float(random.uniform(0, 0.1))
        killed.append(f"after {updates} updates and {then:.3f} s")
        process = start_python(*command)
        assert process.stdout is not None
        printed = [process.stdout.readline() for _ in range(updates)]
        time.sleep(then)
        process.kill()
        _, errors = process.communicate()
        assert process.returncode == -9, errors
        assert not folder.exists(), killed
        firsts.append(int(printed[0]))
    output, errors = start_python(*command).communicate()
    assert folder.exists(), errors
    firsts.append(int(output.split()[0]))
    assert firsts[0] == 1
    assert firsts == sorted(set(firsts)), f"killed {killed}, began at {firsts}"
    assert not compare_rebuilds(folder, artefact(built / "a")).differences, killed
    assert not partial_folder(folder).exists()


def test_resumed_collection_repeats_updates_after_the_last_save(built, job):
    with pytest.raises(KeyboardInterrupt):
        job.run(stop_after(7), save_seconds=0)
    partial = partial_folder(job.folder)
    assert StateFile(partial / LEARNER).progress == 6
    with (partial / METRICS).open("a") as stream:
        stream.write('{"update": 6, "half a li')
    rewards = np.load(partial / "rewards.npy", mmap_mode="r+")
    rewards[:, 180:] = 77  # the saved state covers 180 recorded steps; the resumed run overwrites the rest
    rewards.flush()
    job.run()
    assert not compare_rebuilds(job.folder, artefact(built / "a")).differences


def test_collection_killed_after_the_last_update_resumes(built, job, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(collect, "finish_artefact", interrupt)
        with pytest.raises(KeyboardInterrupt):
            job.run()
    job.run(interrupt)
    assert not compare_rebuilds(job.folder, artefact(built / "a")).differences


def test_collection_killed_before_renaming_its_folder_resumes(built, job):
    shutil.copytree(artefact(built / "a"), partial_folder(job.folder))
    (partial_folder(job.folder) / LEARNER).write_bytes(b"no longer needed")
    job.run(fail_on_update)
    assert not compare_rebuilds(job.folder, artefact(built / "a")).differences


def test_partial_collection_with_other_settings_starts_again(job, tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        job.run(stop_after(4), save_seconds=0)
    (tmp_path / "other.toml").write_text(TINY.replace("rollout = 80", "rollout = 80\nclip = 0.1"))
    firsts = []

    def record_first_update(partial, task, config, first):
        firsts.append(first)
        raise KeyboardInterrupt

    monkeypatch.setattr(collect, "ArtefactWriter", record_first_update)
    for profile in (job.profile, load_profile(str(tmp_path / "other.toml"))):
        with pytest.raises(KeyboardInterrupt):
            replace(job, profile=profile).run()
    assert firsts == [3, 0]


def test_collecting_a_finished_task_again_changes_nothing(built, job):
    shutil.copytree(artefact(built / "a"), job.folder)
    before = (job.folder / METADATA).stat().st_mtime_ns
    job.run(fail_on_update)
    assert (job.folder / METADATA).stat().st_mtime_ns == before


# A full disk must raise DiskFullError instead of crashing the process with SIGBUS.


def test_too_little_free_space_raises_error_before_collection(job, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=5_000))
    message = rf"^{job.folder}: the disk is full: this task needs [\d,]{{6,}} bytes, but only 5,000 are free; .* --out$"
    with pytest.raises(DiskFullError, match=message):
        job.run(fail_on_update)
    assert not [path for path in tmp_path.iterdir() if not path.name.endswith(".lock")]


def test_disk_space_of_arrays_is_allocated_in_advance(job, tmp_path):
    task, ego = job.work.task, job.profile.ego
    ArtefactWriter(tmp_path, task, ego, 0).close()
    for name, (shape, dtype) in array_shapes(task.layout, ego.environments, ego.episodes).items():
        path = tmp_path / f"{name}.npy"
        assert path.stat().st_blocks * 512 >= path.stat().st_size
        found = np.load(path)
        assert (found.shape, found.dtype) == (shape, dtype)
        np.save(tmp_path / "saved.npy", np.zeros(shape, dtype))
        assert path.read_bytes() == (tmp_path / "saved.npy").read_bytes()


def test_failed_allocation_of_arrays_leaves_no_files(job):
    with file_size_limit(64 * 1024), pytest.raises(DiskFullError, match=r": the disk is full: this task needs "):
        job.run(fail_on_update)
    assert not partial_folder(job.folder).exists()


def test_full_disk_during_collection_keeps_the_saved_state(job):
    def raise_disk_full(updates, speed):
        if updates == 7:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(DiskFullError, match=": the disk is full: this task needs "):
        job.run(raise_disk_full, save_seconds=0)
    assert StateFile(partial_folder(job.folder) / LEARNER).progress == 6
