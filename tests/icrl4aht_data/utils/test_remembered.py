"""Hashes of files that are computed once until the file changes."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from icrl4aht_data.utils import remembered
from icrl4aht_data.utils.hashes import block_hash
from icrl4aht_data.utils.remembered import remembered_block_hashes, remembered_hash
from tests.helpers.damages import DAMAGES, contents, flip_bit, restore

CONTENT = bytes(range(256)) * 5000  # more than a file that is always hashed


@pytest.fixture
def file(tmp_path, monkeypatch) -> Path:
    """A file that was last changed some time ago; the cache folder is `cache` next to it."""
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(remembered, "_TICK_NS", 2 * 10**7)  # so that no test has to wait long
    path = tmp_path / "file"
    path.write_bytes(CONTENT)
    return path


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def note(folder: Path) -> Path:
    (path,) = (path for path in folder.rglob("*.json"))
    return path


def test_a_file_is_read_once_until_it_changes(file, monkeypatch):
    computed = []
    monkeypatch.setattr(remembered, "file_hash", lambda path: computed.append(path) or sha256(path))
    for _ in range(2):
        assert remembered_hash(file) == hashlib.sha256(CONTENT).hexdigest()
    assert len(computed) == 1
    before = file.stat()
    flip_bit(file)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert remembered_hash(file) == sha256(file)
    other = file.with_name("other")
    other.write_bytes(file.read_bytes())
    other.replace(file)
    remembered_hash(file)
    monkeypatch.setattr(remembered, "_boot_id", lambda: "another")
    for _ in range(2):
        remembered_hash(file)
    assert len(computed) == 4


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_note_is_written_again(file, damage):
    expected = remembered_hash(file)
    path = note(file.with_name("cache"))
    right = path.read_bytes()
    DAMAGES[damage](path)
    assert remembered_hash(file) == expected
    if damage not in ("a folder",):
        assert path.read_bytes() == right
    else:
        assert not [p for p in path.parent.iterdir() if p != path]  # nothing temporary is left


def test_no_bit_of_a_note_changes_what_is_believed(file):
    expected = remembered_hash(file)
    path = note(file.with_name("cache"))
    for position in range(0, path.stat().st_size, 5):
        right = path.read_bytes()
        flip_bit(path, position, position % 8)
        assert remembered_hash(file) == expected
        restore(path, right)


def test_a_note_of_another_file_is_not_believed(file):
    remembered_hash(file)
    mine = note(file.with_name("cache"))
    other = file.with_name("other")
    other.write_bytes(CONTENT[::-1])
    os.utime(other, ns=(file.stat().st_atime_ns, file.stat().st_mtime_ns))
    remembered_hash(other)
    (theirs,) = (path for path in mine.parent.iterdir() if path != mine)
    theirs.replace(mine)
    assert remembered_hash(file) == hashlib.sha256(CONTENT).hexdigest()


def test_without_a_folder_for_notes(file, tmp_path, monkeypatch):
    (tmp_path / "plain").touch()
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "plain"))
    for _ in range(2):
        assert remembered_hash(file) == hashlib.sha256(CONTENT).hexdigest()


def test_files_of_a_folder_are_remembered_together(tmp_path, monkeypatch):
    monkeypatch.setattr(remembered, "_TICK_NS", 2 * 10**7)
    (tmp_path / "a").write_bytes(CONTENT)
    (tmp_path / "b").write_bytes(b"x")
    first = remembered_block_hashes(tmp_path, ["a", "b"])
    assert first == {name: block_hash(tmp_path / name) for name in "ab"}
    assert len(contents(tmp_path)) == 3
    tmp_path.rename(tmp_path.with_name("moved"))
    monkeypatch.setattr(remembered, "block_hash", lambda path: "hashed again")
    assert remembered_block_hashes(tmp_path.with_name("moved"), ["a", "b"]) == first
    flip_bit(tmp_path.with_name("moved") / "b")
    assert remembered_block_hashes(tmp_path.with_name("moved"), ["a", "b"]) == dict.fromkeys("ab", "hashed again")


def test_hashes_of_blocks_depend_on_every_byte(tmp_path, monkeypatch):
    monkeypatch.setattr("icrl4aht_data.utils.hashes._BLOCK", 1000)
    path = tmp_path / "file"
    path.write_bytes(CONTENT[:4500])
    expected = block_hash(path)
    blocks = [hashlib.sha256(CONTENT[start : min(start + 1000, 4500)]).digest() for start in range(0, 4500, 1000)]
    assert expected == hashlib.sha256(b"".join(blocks)).hexdigest()
    for position in (0, 999, 1000, 4499):
        flip_bit(path, position)
        assert block_hash(path) != expected
        flip_bit(path, position)
    path.write_bytes(b"")
    assert block_hash(path) == hashlib.sha256(b"").hexdigest()


@pytest.mark.parametrize(
    ("age", "fraction", "unsettled"),
    [(50, 1, True), (150, 1, False), (150, 0, True), (1900, 0, True), (2100, 0, False)],
)
def test_when_a_files_times_show_every_change(monkeypatch, age, fraction, unsettled):
    """Age in milliseconds; a clock that shows no parts of a millisecond is taken to tick every two seconds."""
    changed = 1_700_000_000 * 10**9 + fraction
    monkeypatch.setattr(remembered.time, "time_ns", lambda: changed + age * 10**6)
    assert (remembered._unsettled_ns([0, changed, changed - 10**9, 0]) > 0) == unsettled
