"""Collection of one task: killed and resumed runs write the artefact of an uninterrupted run."""

from __future__ import annotations

import os
import shutil
import time

import numpy as np
import pytest
from icrl4aht_generation.collection import job
from icrl4aht_generation.collection import task as collect
from icrl4aht_generation.collection.task_folder import LEARNER, METADATA, METRICS, partial_folder
from icrl4aht_generation.learners.resume import StateFile
from icrl4aht_generation.profiles import Profile, load_profile
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.releases.check import compare_rebuilds

from tests.helpers.tiny import TINY, artefact, start

COLLECT = """
import sys, time
from pathlib import Path
from icrl4aht_generation.collection.job import run_task
from icrl4aht_generation.profiles import Profile, load_profile

def report(update, metrics):
    print(update, flush=True)
    time.sleep(0.1)

profile = load_profile(sys.argv[1])
run_task(*profile.works(), profile, Path(sys.argv[2]), report, save_seconds=float(sys.argv[3]))
"""


@pytest.fixture
def task(built):
    profile = load_profile(str(built / "tiny.toml"))
    return profile.works()[0], profile


def run_task(task: tuple[Work, Profile], *arguments, **options) -> bool:
    return job.run_task(task[0], task[1], *arguments, **options)


def stop_after(update: int):
    def report(number, metrics):
        if number == update:
            raise KeyboardInterrupt

    return report


@pytest.mark.slow
def test_runs_killed_at_random_write_the_same_artefact(built, tmp_path):
    folder = tmp_path / artefact(built / "a").name
    command = ["-c", COLLECT, str(built / "tiny.toml"), str(folder), "0.1"]
    seed = int(os.environ.get("KILL_SEED", "7"))
    print(f"KILL_SEED={seed}")
    random, firsts, killed = np.random.default_rng(seed), [], []
    for _ in range(3):
        updates, then = int(random.integers(2, 5)), float(random.uniform(0, 0.1))
        killed.append(f"after {updates} updates and {then:.3f} s")
        process = start(*command)
        assert process.stdout is not None
        printed = [process.stdout.readline() for _ in range(updates)]
        time.sleep(then)
        process.kill()
        _, errors = process.communicate()
        assert process.returncode == -9, errors
        assert not folder.exists(), killed
        firsts.append(int(printed[0]))
    output, errors = start(*command).communicate()
    assert folder.exists(), errors
    firsts.append(int(output.split()[0]))
    assert firsts[0] == 0
    assert firsts == sorted(set(firsts)), f"killed {killed}, began at {firsts}"
    assert not compare_rebuilds(folder, artefact(built / "a")).differences, killed
    assert not partial_folder(folder).exists()


def test_updates_after_the_last_save_are_repeated(built, task, tmp_path):
    folder = tmp_path / "task"
    with pytest.raises(KeyboardInterrupt):
        run_task(task, folder, stop_after(6), save_seconds=0)
    partial = partial_folder(folder)
    assert StateFile(partial / LEARNER).progress == 6
    with (partial / METRICS).open("a") as stream:
        stream.write('{"update": 6, "half a li')
    rewards = np.load(partial / "rewards.npy", mmap_mode="r+")
    rewards[:, 180:] = 77  # six updates of 80 steps led to the first 180 that are kept
    rewards.flush()
    run_task(task, folder)
    assert not compare_rebuilds(folder, artefact(built / "a")).differences


def test_killed_after_the_last_update(built, task, tmp_path, monkeypatch):
    folder = tmp_path / "task"

    def kill(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(collect, "finish_artefact", kill)
        with pytest.raises(KeyboardInterrupt):
            run_task(task, folder)
    assert run_task(task, folder, kill)
    assert not compare_rebuilds(folder, artefact(built / "a")).differences


def test_killed_before_renaming(built, task, tmp_path):
    folder = tmp_path / "task"
    shutil.copytree(artefact(built / "a"), partial_folder(folder))
    (partial_folder(folder) / LEARNER).write_bytes(b"no longer needed")
    assert run_task(task, folder)
    assert not compare_rebuilds(folder, artefact(built / "a")).differences


def test_a_partial_of_other_settings_is_started_again(built, task, tmp_path, monkeypatch):
    folder = tmp_path / "task"
    with pytest.raises(KeyboardInterrupt):
        run_task(task, folder, stop_after(3), save_seconds=0)
    (tmp_path / "other.toml").write_text(TINY.replace("rollout = 80", "rollout = 80\nclip = 0.1"))
    firsts = []

    def writer(partial, task, config, first):
        firsts.append(first)
        raise KeyboardInterrupt

    monkeypatch.setattr(collect, "ArtefactWriter", writer)
    for profile in (task[1], load_profile(str(tmp_path / "other.toml"))):
        with pytest.raises(KeyboardInterrupt):
            run_task((task[0], profile), folder)
    assert firsts == [3, 0]


def test_a_finished_task_is_unchanged(built, task, tmp_path):
    folder = tmp_path / "task"
    shutil.copytree(artefact(built / "a"), folder)
    before = (folder / METADATA).stat().st_mtime_ns
    assert not run_task(task, folder, stop_after(0))
    assert (folder / METADATA).stat().st_mtime_ns == before
