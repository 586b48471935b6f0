"""Test writing to a full disk: the error names the disk, and no partial files remain."""

from __future__ import annotations

import errno

import h5py
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import DiskFullError
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import to_published
from tests.robustness.limits import PAGE, can_mount, file_size_limit, small_disk

needs_disks = pytest.mark.skipif(not can_mount(), reason="this user may not mount a small disk")


def test_file_size_limit_raises_error_with_the_file_name(lite, tmp_path):
    """libhdf5 may crash when a file cannot be closed, so shards are made in memory and written without libhdf5."""
    dataset = load_icrl4aht(lite[0])
    for limit in (PAGE, 10 * PAGE):
        with file_size_limit(limit), pytest.raises(OSError, match=r"File too large.*histories\.h5") as error:
            to_published(dataset, tmp_path / "files")
        assert error.value.errno == errno.EFBIG
    with file_size_limit(PAGE), pytest.raises(OSError, match=r"File too large.*\.h5"):
        to_release(dataset, tmp_path / "full", "full")
    assert not any(tmp_path.iterdir())


@needs_disks
def test_full_disk_raises_error_that_names_the_disk(lite, tmp_path):
    dataset, disk = load_icrl4aht(lite[0]), tmp_path / "disk"
    writers = {
        "files": lambda target: to_published(dataset, target),
        "full": lambda target: to_release(dataset, target, "full"),
        "built": lambda target: build_release(lite[0], target),
    }
    for pages in (1, 3, 6):
        with small_disk(disk, pages * PAGE):
            for name, write in writers.items():
                with pytest.raises(DiskFullError, match=rf"{name}: the disk is full: .* free on the disk of {disk};"):
                    write(disk / name)
                assert not any(disk.iterdir())


def test_shards_equal_files_written_by_libhdf5(lite, tmp_path, monkeypatch):
    """Shards made in memory must have the same bytes as shards that libhdf5 writes directly to disk."""
    real = h5py.File
    to_release(load_icrl4aht(lite[0]), tmp_path / "memory", "full")
    assert verify_release(tmp_path / "memory").ok
    monkeypatch.setattr(h5py, "File", lambda path, mode, libver, **options: real(path, mode, libver=libver))
    to_release(load_icrl4aht(lite[0]), tmp_path / "disk", "full")
    for path in (tmp_path / "memory").rglob("*.h5"):
        assert path.read_bytes() == (tmp_path / "disk" / path.relative_to(tmp_path / "memory")).read_bytes()
