"""Cached sets of arrays: rebuilt on any mismatch, limited in size, helpful errors."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data.errors import CacheError, OptionError
from icrl4aht_data.format import cached_arrays as module
from icrl4aht_data.format.cached_arrays import cached_arrays, new_mapped_array
from tests.helpers.damages import DAMAGES, contents, flip_bit
from tests.robustness.limits import can_mount, permissions_count, small_disk

KEY = f"histories-{0:032x}"
SIZE = 8 * 150_000 + 300


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty cache folder."""
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def build(path: Path) -> None:
    new_mapped_array(path / "a.npy", (150_000,), np.dtype("i8"))[:] = np.arange(150_000)
    np.save(path / "b.values.npy", np.array([b"x", b"yy"]))


def check(arrays: dict[str, np.ndarray]) -> None:
    assert sorted(arrays) == ["a", "b.values"]
    assert np.array_equal(arrays["a"], np.arange(150_000))
    assert arrays["b.values"].tolist() == [b"x", b"yy"]


def test_a_set_is_built_once(folder):
    for _ in range(2):
        check(cached_arrays(KEY, SIZE, build))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_build", lambda *_: pytest.fail("built again"))
        check(cached_arrays(KEY, SIZE, build))
    assert [path.name for path in folder.iterdir()] == [KEY]  # no locks, nothing unfinished


@pytest.mark.parametrize("damage", [name for name in DAMAGES if "bit" not in name])
def test_wrong_sizes_and_headers_are_built_again(folder, damage):
    cached_arrays(KEY, SIZE, build)
    right = contents(folder / KEY)
    assert list(right) == ["a.npy", "b.values.npy", "contents.json"]
    for name in right:
        DAMAGES[damage](folder / KEY / name)
        check(cached_arrays(KEY, SIZE, build))
        assert contents(folder / KEY) == right
        assert [path.name for path in folder.iterdir()] == [KEY]


def test_leftovers_of_killed_processes_are_removed_after_a_day(folder):
    for age in (0, 2 * 86400):
        left = folder / f".{KEY}.partial-{age}"
        left.mkdir(parents=True)
        os.utime(left, (time.time() - age, time.time() - age))
    check(cached_arrays(KEY, SIZE, build))
    assert {path.name for path in folder.iterdir()} == {KEY, f".{KEY}.partial-0"}


def test_least_recently_used_arrays_are_evicted(folder, monkeypatch):
    def build(path: Path) -> None:
        np.save(path / "a.npy", np.zeros(1000, np.uint8))

    one, two, three, four, huge = (f"{name}-{7:032x}" for name in ("one", "two", "three", "four", "huge"))
    monkeypatch.setenv("ICRL4AHT_CACHE_BYTES", "3500")
    (folder / "mine").mkdir(parents=True)  # foreign files are neither counted nor removed
    np.save(folder / "mine" / "a.npy", np.zeros(9000, np.uint8))
    for key in (one, two, three):
        cached_arrays(key, 1128, build)
    held = cached_arrays(one, 1128, build)["a"]
    cached_arrays(four, 1128, build)
    assert sorted(path.name for path in folder.iterdir()) == sorted([four, "mine", one, three])
    assert held.sum() == 0
    with pytest.raises(OptionError, match="raise ICRL4AHT_CACHE_BYTES"):
        cached_arrays(huge, 4000, build)


@pytest.mark.parametrize("below", [False, True])
def test_a_cache_folder_that_is_a_file(tmp_path, monkeypatch, below):
    path = tmp_path / "plain"
    path.touch()
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(path / "below" if below else path))
    assert module.cacheable_bytes() == 0
    with pytest.raises(CacheError, match=r'plain.*: the cache folder (is a file|cannot).*ICRL4AHT_CACHE_DIR.*"stream"'):
        cached_arrays(KEY, SIZE, build)
    assert path.read_bytes() == b""


def test_a_cache_folder_that_can_only_be_read(folder):
    check(cached_arrays(KEY, SIZE, build))
    folder.chmod(0o555)
    (folder / KEY).chmod(0o555)
    try:
        with permissions_count():
            check(cached_arrays(KEY, SIZE, build))  # existing arrays can still be read
            assert module.cacheable_bytes() == 0
            with pytest.raises(CacheError, match=r"cannot be used: Permission denied \(.*check its permissions"):
                cached_arrays(f"histories-{1:032x}", SIZE, build)
    finally:
        folder.chmod(0o755)
        (folder / KEY).chmod(0o755)


@pytest.mark.skipif(not can_mount(), reason="needs the right to mount a disk")
def test_unused_arrays_are_evicted_on_a_full_disk(folder):
    with small_disk(folder, 2 * 2**20):
        for number in range(3):
            check(cached_arrays(f"histories-{number:032x}", SIZE, build))
        assert [path.name for path in folder.iterdir()] == [f"histories-{2:032x}"]


def test_new_arrays_allocate_their_space_at_once(tmp_path):
    array = new_mapped_array(tmp_path / "a.npy", (3000, 70), np.dtype("u1"))
    assert not array.any()
    assert (tmp_path / "a.npy").stat().st_blocks * 512 >= 3000 * 70
    array[2999] = 7
    array.flush()
    assert np.load(tmp_path / "a.npy")[2999].tolist() == [7] * 70
    flip_bit(tmp_path / "a.npy", 10**5)
    assert array.sum() == 70 * 7 + 1
