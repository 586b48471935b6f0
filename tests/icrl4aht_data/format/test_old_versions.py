"""Releases of format versions 2 and 3: read, verified, combined with others, converted to the current version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import ChunkTableError, OptionError
from icrl4aht_data.format.chunks import chunk_table_path
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.schema import FORMAT_VERSION, HISTORIES, INFO
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.dataset_card import SOURCE_CARD
from tests.helpers.batches import CACHES, assert_equal, digest
from tests.helpers.old_releases import NEW_FIELDS, as_version
from tests.helpers.random_releases import SHARD, random_release


@pytest.fixture(scope="module")
def old(lite, tmp_path_factory) -> Path:
    """`lite` in format version 2, with a source card. Read only."""
    root = shutil.copytree(lite[0], tmp_path_factory.mktemp("old") / "release")
    (root / SOURCE_CARD).write_text("# sources\n")
    return as_version(root, 2)


@pytest.fixture(scope="module")
def version_3(lite, tmp_path_factory) -> Path:
    """`lite` in format version 3. Read only."""
    return as_version(shutil.copytree(lite[0], tmp_path_factory.mktemp("old") / "version_3"), 3)


@pytest.mark.parametrize("cache", CACHES)
def test_it_is_read(lite, old, cache):
    assert read_info(old).format_version == 2
    for options in ({}, {"source": "ppo"}):
        assert len(load_icrl4aht(old).index.query(**options)) == 12
    for line in (old / HISTORIES).read_text().splitlines():
        assert not set(NEW_FIELDS[2]) & json.loads(line).keys()
    assert list(load_icrl4aht(old).entries) == list(load_icrl4aht(lite[0]).entries)
    entry = load_icrl4aht(old).entries[3]
    assert [getattr(entry, name) for name in NEW_FIELDS[2]] == ["ppo", None, None, None, 0, False]
    one, two = (load_icrl4aht(root, layout="demo_wide", cache=cache) for root in (old, lite[0]))
    assert_equal(one.ad(batch_size=4, length=30, seed=1)[2], two.ad(batch_size=4, length=30, seed=1)[2])


def test_that_it_has_no_hashes_is_said(lite, old):
    assert "lite release 0.0.1 of format 2, without chunk hashes, at" in repr(load_icrl4aht(old))
    report = verify_release(old, level="deep")
    assert report.ok, report.findings
    (note,) = report.notes
    assert note.startswith("format version 2 has no chunk hashes") and "convert --to lite" in note
    result = CliRunner().invoke(cli, ["verify", str(old)])
    assert result.exit_code == 0 and "format version 2 has no chunk hashes" in " ".join(result.output.split())
    assert json.loads(CliRunner().invoke(cli, ["show", str(old), "--json"]).output)["format_version"] == 2
    assert "without chunk hashes" not in repr(load_icrl4aht(lite[0])) and not verify_release(lite[0]).notes


def test_version_3_is_read_and_verified(lite, version_3):
    assert read_info(version_3).format_version == 3
    line = json.loads((version_3 / HISTORIES).read_text().splitlines()[0])
    assert "source" in line and not set(NEW_FIELDS[3]) & line.keys()
    assert list(load_icrl4aht(version_3).entries) == list(load_icrl4aht(lite[0]).entries)
    assert_equal(
        *(
            load_icrl4aht(root, layout="demo_wide").dpt(batch_size=4, context=30, seed=1)[2]
            for root in (version_3, lite[0])
        )
    )
    report = verify_release(version_3, level="deep")
    assert report.ok and not report.notes, report
    assert "without chunk hashes" not in repr(load_icrl4aht(version_3))


@pytest.mark.parametrize(("kind", "version"), [("lite", 2), ("lite", 3), ("full", 2)])
def test_convert_brings_it_to_the_current_version(request, tmp_path, kind, version):
    root = request.getfixturevalue(kind)[0]
    as_version(shutil.copytree(root, tmp_path / "old"), version)
    (tmp_path / "old" / SOURCE_CARD).write_text("# sources\n")
    write_manifest(tmp_path / "old")
    result = CliRunner().invoke(cli, ["convert", str(tmp_path / "old"), "--out", str(tmp_path / "new")])
    assert result.exit_code == 0, result.output
    report = verify_release(tmp_path / "new", level="deep")
    assert report.ok and not report.notes
    assert read_info(tmp_path / "new") == read_info(root)
    assert digest(tmp_path / "new") == digest(root)
    for name in (HISTORIES, SHARD, str(chunk_table_path(Path(), SHARD))):
        assert (tmp_path / "new" / name).read_bytes() == (root / name).read_bytes(), name
    assert (tmp_path / "new" / SOURCE_CARD).read_text() == "# sources\n"
    assert SOURCE_CARD in read_manifest(tmp_path / "new")


def test_a_current_release_needs_the_form(lite, tmp_path):
    result = CliRunner().invoke(cli, ["convert", str(lite[0]), "--out", str(tmp_path / "new")])
    assert result.exit_code == 2 and "give the form to convert to" in result.output


def test_it_is_combined_with_a_current_one(old, tmp_path):
    random_release(tmp_path / "other", layouts=("cramped_up",))
    combine_releases(tmp_path / "both", [old, tmp_path / "other"])
    assert verify_release(tmp_path / "both").ok
    assert read_info(tmp_path / "both").format_version == FORMAT_VERSION


def test_it_is_not_published(old, tmp_path):
    with pytest.raises(OptionError, match=r"format version 2 has no chunk hashes.* convert it first"):
        build_release(old, tmp_path / "built")


@pytest.mark.parametrize("version", [2, 4])
def test_chunk_tables_have_the_version_of_the_release(lite, old, tmp_path, version):
    """So that nobody can pass off tables without hashes as those of a release that has them."""
    root = shutil.copytree(lite[0] if version == 4 else old, tmp_path / "release")
    shutil.copyfile(chunk_table_path(old if version == 4 else lite[0], SHARD), chunk_table_path(root, SHARD))
    write_manifest(root)
    with pytest.raises(ChunkTableError, match=f"the chunk table is not of format version {version}; fetch meta/ again"):
        load_icrl4aht(root)[0].actions[:]
    assert any("not of format version" in finding.problem for finding in verify_release(root).findings)


def test_versions_of_shards_are_compared(lite, old, tmp_path):
    root = shutil.copytree(lite[0], tmp_path / "release")
    shutil.copyfile(old / SHARD, root / SHARD)
    problems = [finding.problem for finding in verify_release(root).findings]
    assert any("attributes: expected {'format_version': 4" in problem for problem in problems), problems


def test_the_info_may_not_say_another_version(old, tmp_path):
    root = shutil.copytree(old, tmp_path / "release")
    (root / INFO).write_text((root / INFO).read_text().replace('"format_version": 2', '"format_version": 4'))
    write_manifest(root)
    with pytest.raises(ChunkTableError, match="not of format version 4"):
        load_icrl4aht(root)[0].actions[:]
