"""Test that cached arrays are rebuilt on any mismatch and limited in size, and that errors say what to do."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data.errors import CacheError, OptionError
from icrl4aht_data.format import cached_arrays as module
from icrl4aht_data.format.cached_arrays import cached_arrays, new_mapped_array
from tests.helpers.damages import DAMAGES, file_contents, flip_bit
from tests.robustness.limits import can_mount, enforced_permissions, small_disk

KEY = f"histories-{0:032x}"
SIZE = 8 * 150_000 + 300


@pytest.fixture
def cache_folder(tmp_path, monkeypatch) -> Path:
    """Set the cache folder to a new path and return the path."""
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_arrays(path: Path) -> None:
    new_mapped_array(path / "a.npy", (150_000,), np.dtype("i8"))[:] = np.arange(150_000)
    np.save(path / "b.values.npy", np.array([b"x", b"yy"]))


def assert_cached_values(arrays: dict[str, np.ndarray]) -> None:
    assert sorted(arrays) == ["a", "b.values"]
    assert np.array_equal(arrays["a"], np.arange(150_000))
    assert arrays["b.values"].tolist() == [b"x", b"yy"]


def test_cached_arrays_are_built_only_once(cache_folder):
    assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_build", lambda *_: pytest.fail("built again"))
        assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))
    assert [path.name for path in cache_folder.iterdir()] == [KEY]  # no lock files or partial folders remain


@pytest.mark.parametrize("damage", [name for name in DAMAGES if "bit" not in name])
def test_cached_arrays_with_wrong_sizes_or_headers_are_rebuilt(cache_folder, damage):
    cached_arrays(KEY, SIZE, write_arrays)
    right = file_contents(cache_folder / KEY)
    assert list(right) == ["a.npy", "b.values.npy", "contents.json"]
    for name in right:
        DAMAGES[damage](cache_folder / KEY / name)
        assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))
        assert file_contents(cache_folder / KEY) == right
        assert [path.name for path in cache_folder.iterdir()] == [KEY]


def test_partial_folders_of_killed_processes_are_removed_after_a_day(cache_folder):
    for age in (0, 2 * 86400):
        left = cache_folder / f".{KEY}.partial-{age}"
        left.mkdir(parents=True)
        os.utime(left, (time.time() - age, time.time() - age))
    assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))
    assert {path.name for path in cache_folder.iterdir()} == {KEY, f".{KEY}.partial-0"}


def test_least_recently_used_arrays_are_evicted(cache_folder, monkeypatch):
    def write_arrays(path: Path) -> None:
        np.save(path / "a.npy", np.zeros(1000, np.uint8))

    one, two, three, four, huge = (f"{name}-{7:032x}" for name in ("one", "two", "three", "four", "huge"))
    monkeypatch.setenv("ICRL4AHT_CACHE_BYTES", "3500")
    (cache_folder / "mine").mkdir(parents=True)  # files of other programs are neither counted nor removed
    np.save(cache_folder / "mine" / "a.npy", np.zeros(9000, np.uint8))
    for key in (one, two, three):
        cached_arrays(key, 1128, write_arrays)
    held = cached_arrays(one, 1128, write_arrays)["a"]
    cached_arrays(four, 1128, write_arrays)
    assert sorted(path.name for path in cache_folder.iterdir()) == sorted([four, "mine", one, three])
    assert held.sum() == 0
    with pytest.raises(OptionError, match="raise ICRL4AHT_CACHE_BYTES"):
        cached_arrays(huge, 4000, write_arrays)


@pytest.mark.parametrize("below", [False, True])
def test_cache_folder_that_is_a_file_raises_cache_error(tmp_path, monkeypatch, below):
    path = tmp_path / "plain"
    path.touch()
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(path / "below" if below else path))
    assert module.cacheable_bytes() == 0
    with pytest.raises(CacheError, match=r'plain.*: the cache folder (is a file|cannot).*ICRL4AHT_CACHE_DIR.*"stream"'):
        cached_arrays(KEY, SIZE, write_arrays)
    assert path.read_bytes() == b""


def test_read_only_cache_folder_returns_existing_arrays_and_refuses_new_arrays(cache_folder):
    assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))
    cache_folder.chmod(0o555)
    (cache_folder / KEY).chmod(0o555)
    try:
        with enforced_permissions():
            assert_cached_values(cached_arrays(KEY, SIZE, write_arrays))  # existing arrays can still be read
            assert module.cacheable_bytes() == 0
            with pytest.raises(CacheError, match=r"cannot be used: Permission denied \(.*check its permissions"):
                cached_arrays(f"histories-{1:032x}", SIZE, write_arrays)
    finally:
        cache_folder.chmod(0o755)
        (cache_folder / KEY).chmod(0o755)


@pytest.mark.skipif(not can_mount(), reason="needs the right to mount a disk")
def test_unused_arrays_are_evicted_on_a_full_disk(cache_folder):
    with small_disk(cache_folder, 2 * 2**20):
        for number in range(3):
            assert_cached_values(cached_arrays(f"histories-{number:032x}", SIZE, write_arrays))
        assert [path.name for path in cache_folder.iterdir()] == [f"histories-{2:032x}"]


def test_new_mapped_array_reserves_its_disk_space_at_once(tmp_path):
    array = new_mapped_array(tmp_path / "a.npy", (3000, 70), np.dtype("u1"))
    assert not array.any()
    assert (tmp_path / "a.npy").stat().st_blocks * 512 >= 3000 * 70
    array[2999] = 7
    array.flush()
    assert np.load(tmp_path / "a.npy")[2999].tolist() == [7] * 70
    flip_bit(tmp_path / "a.npy", 10**5)
    assert array.sum() == 70 * 7 + 1
