"""Test that a file lock has only one holder at a time, even though the lock file is removed after use."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from filelock import Timeout

from icrl4aht_data.utils.files import lock_file_path, process_lock


def increment_slowly(folder: Path, times: int) -> None:
    """Increment the number in a file slowly, so that a broken lock would lose increments."""
    path = folder / "number.txt"
    for _ in range(times):
        with process_lock(folder / "locks" / "below" / ".number.lock"):
            number = int(path.read_text())
            time.sleep(0.001)
            path.write_text(str(number + 1))


def test_lock_excludes_other_threads_although_its_file_is_removed(tmp_path):
    (tmp_path / "number.txt").write_text("0")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: increment_slowly(tmp_path, 25), range(4)))
    assert (tmp_path / "number.txt").read_text() == "100"
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["below", "locks", "number.txt"]


def test_held_lock_raises_timeout_without_waiting(tmp_path):
    path = tmp_path / ".run.lock"
    with process_lock(path):
        assert path.exists()
        with pytest.raises(Timeout), process_lock(path, wait=False):
            pass
        assert path.exists(), "who did not get the lock leaves its file"
    assert not path.exists()


def test_lock_file_of_a_folder_is_next_to_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert lock_file_path(Path()) == lock_file_path(tmp_path) == tmp_path.with_name(f".{tmp_path.name}.lock")
