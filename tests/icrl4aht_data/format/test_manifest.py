"""Test that files of a release are checked against its manifest before use."""

from __future__ import annotations

import shutil

import pytest
from icrl4aht_generation.teammates.registry import recover_teammate

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import ChunkTableError, IndexFormatError, ReleaseError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.manifest import check_against_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS, TEAMMATES
from icrl4aht_data.writing.convert import to_release
from tests.helpers.damages import DAMAGES, flip_bit, restore_file
from tests.helpers.random_releases import SHARD
from tests.robustness.limits import enforced_permissions

UNNOTICED = "a bit flipped, times as before"


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        (INFO, UNNOTICED),
        (PROVENANCE, UNNOTICED),
        *((MANIFEST, damage) for damage in DAMAGES if damage != UNNOTICED),
        *((name, damage) for name in (HISTORIES, TASKS, chunk_table_name(SHARD)) for damage in DAMAGES),
    ],
)
def test_damaged_file_raises_error_with_its_path(release_copy, name, damage):
    path = release_copy / name
    right = path.read_bytes()
    DAMAGES[damage](path)
    expected = rf": expected sha256 \w{{64}} from {MANIFEST}, found \w{{64}}" if damage == UNNOTICED else ""
    with pytest.raises(ReleaseError, match=f"{path}{expected}"):
        load_icrl4aht(release_copy)[0].read("actions")
    restore_file(path, right)
    load_icrl4aht(release_copy)[0].read("actions")


def test_an_empty_manifest_is_refused(release_copy):
    (release_copy / MANIFEST).write_text("")
    with pytest.raises(IndexFormatError, match=rf"{MANIFEST} is empty: expected a line for each file"):
        load_icrl4aht(release_copy)
    for level in ("quick", "full"):
        report = verify_release(release_copy, level=level)
        assert any(finding.file == MANIFEST and "empty: expected" in finding.problem for finding in report.findings)


def test_meta_file_missing_from_the_manifest_is_refused(release_copy):
    lines = (release_copy / MANIFEST).read_text().splitlines(keepends=True)
    (release_copy / MANIFEST).write_text("".join(line for line in lines if PROVENANCE not in line))
    with pytest.raises(IndexFormatError, match=rf"{PROVENANCE}: .*{MANIFEST} does not list this file; fetch"):
        load_icrl4aht(release_copy)
    (release_copy / PROVENANCE).unlink()  # a release may have no provenance.json
    load_icrl4aht(release_copy)
    check_against_manifest(release_copy, [INFO, chunk_table_name(SHARD)])


def test_files_changed_after_opening_raise_errors_when_read(release_copy):
    dataset = load_icrl4aht(release_copy)
    for name in (TASKS, PROVENANCE):
        flip_bit(release_copy / name)
        with pytest.raises(IndexFormatError, match=rf"{name}: expected sha256"):
            dataset.recover_teammate(0)
        flip_bit(release_copy / name)
    flip_bit(release_copy / chunk_table_name(SHARD))
    with pytest.raises(ChunkTableError, match="expected sha256"):
        dataset[0].read("actions")


def test_damaged_checkpoints_are_neither_loaded_nor_copied(tmp_path):
    shutil.copytree(MINI, tmp_path / "release")
    dataset = load_icrl4aht(tmp_path / "release", teammate_family="rl")[:1]
    digest = dataset.recover_teammate(int(dataset.ids[0]))["theta"]["sha256"]
    for name in ("policy.json", "policy.safetensors"):
        path = tmp_path / "release" / TEAMMATES / digest / name
        flip_bit(path, path.stat().st_size // 2)
        with pytest.raises(IndexFormatError, match=rf"{name}: expected sha256"):
            recover_teammate(dataset, int(dataset.ids[0]))
        with pytest.raises(IndexFormatError, match=rf"{name}: expected sha256"):
            to_release(dataset, tmp_path / "copy", "lite")
        flip_bit(path, path.stat().st_size // 2)


@pytest.mark.parametrize("name", [MANIFEST, INFO, HISTORIES, chunk_table_name(SHARD), SHARD])
@pytest.mark.parametrize("cache", ["ram", "mmap", "stream"])
def test_unreadable_file_raises_error_with_its_path(release_copy, tmp_path, monkeypatch, name, cache):
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    (release_copy / name).chmod(0)
    refused = pytest.raises(ReleaseError, match=f"{release_copy / name}: cannot be read: Permission denied")
    with enforced_permissions(), refused:
        load_icrl4aht(release_copy, layout="coord_simple", cache=cache, threads=1).ad(batch_size=2, length=5)[0]
