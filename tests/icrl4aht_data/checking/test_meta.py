"""Test that `verify_release` finds wrong values in meta/ even if the manifest matches the files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import HISTORIES, INFO, PROVENANCE
from icrl4aht_data.writing.convert import to_release
from tests.helpers.random_releases import SHARD
from tests.helpers.tampered import first_value, problems, tampered_copy
from tests.robustness.limits import time_limit


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release with the bundled PPO histories of one task that has a learned teammate (read-only)."""
    dataset = load_icrl4aht(source="ppo", teammate_kind="fcp")
    return to_release(dataset.filter(task_id=dataset.entries[0].task_id), tmp_path_factory.mktemp("meta") / "r", "lite")


def test_verify_accepts_the_undamaged_release(release):
    assert problems(release, "quick") == problems(release, "deep") == []


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            PROVENANCE,
            lambda c: first_value(c)["teammate"].update(kind="heuristic"),
            "Object contains unknown field `kind`",
        ),
        (PROVENANCE, lambda c: c.update(more=first_value(c)), "task 'more': has no history"),
        (PROVENANCE, lambda c: c.pop(next(iter(c))), "': missing"),
        (PROVENANCE, lambda c: first_value(c).update(seed=77), "seed: expected the task's"),
        (PROVENANCE, lambda c: first_value(c)["ego"].update(clip=0.3), "ego_hash: expected"),
        (
            PROVENANCE,
            lambda c: first_value(c).update(streams_recorded=17),
            "streams_recorded: expected {total}, {environments} of each of 2 learners, found 17",
        ),
        (
            PROVENANCE,
            lambda c: first_value(c).update(streams_kept=9999),
            "streams_kept: expected at most the {recorded} recorded",
        ),
        (
            PROVENANCE,
            lambda c: first_value(c)["filter"]["after"].update(return_end=9.0),
            "filter.after.return_end: exp",
        ),
        (
            PROVENANCE,
            lambda c: [names.__setitem__(0, "brdiv") for names in first_value(c)["suite"]["algorithms"].values()],
            "but the teammate is of fcp",
        ),
        (HISTORIES, lambda c: c[-1].update(env_idx=-1), "Expected `int` >= 0"),
        (HISTORIES, lambda c: c[-1].update(env_idx=9999), "less than the {recorded} recorded streams, found 9999"),
        (HISTORIES, lambda c: c[-1].update(source="human"), "source: expected 'human' as in the index, found 'ppo'"),
        (HISTORIES, lambda c: [line.update(teammate_kind="territory") for line in c], "'territory' is of another fam"),
        (INFO, lambda c: c.update(data_version="../.."), "data version '../..': expected a SemVer version"),
        (INFO, lambda c: first_value(c["statistics"]).update(disk_bytes=1), "statistics: expected"),
    ],
)
def test_verify_finds_false_values_in_meta_files(release, tmp_path, name, change, message):
    (note,) = read_provenance(release / PROVENANCE).values()
    assert note.ego is not None
    environments = note.ego["environments"]
    message = message.format(recorded=note.streams_recorded, environments=environments, total=2 * environments)
    found = problems(tampered_copy(release, tmp_path / "release", name, change), "quick")
    assert any(message in problem for problem in found), found


def test_teammate_field_in_provenance_is_refused(release, tmp_path):
    """Regression: a teammate in provenance.json once replaced the teammate stored with the task."""
    root = tampered_copy(
        release, tmp_path / "r", PROVENANCE, lambda c: first_value(c)["teammate"].update(family="brdiv")
    )
    with pytest.raises(IndexFormatError, match="unknown field `family`"):
        load_icrl4aht(root).recover_teammate(0)


def test_verify_finds_false_values_in_a_release_without_tasks(converted_release, tmp_path):
    def set_wrong_values(lines: list) -> None:
        lines[1].update(seed=3)
        lines[0].update(task_id=lines[-1]["task_id"])

    found = "\n".join(problems(tampered_copy(converted_release, tmp_path / "r", HISTORIES, set_wrong_values), "quick"))
    assert "history 1: seed: expected -1 without tasks, found 3" in found
    assert "of one task differ in" in found


def test_verify_finds_unreferenced_shards_and_policies(release, tmp_path):
    root = shutil.copytree(release, tmp_path / "release")
    policy = next(root.glob("teammates/*"))
    shutil.copytree(policy, policy.with_name("0" * 64))
    shard = next(root.rglob("*.h5"))
    shutil.copy(shard, shard.with_name("train-00001-of-00002.h5"))
    write_manifest(root)
    found = "\n".join(problems(root, "quick"))
    assert "train-00001-of-00002.h5: no history of the index is in this shard" in found
    assert f"teammates/{'0' * 64}/policy.json: no task has this teammate" in found


@pytest.mark.parametrize("with_info", [True, False])
def test_verify_reports_a_terabyte_shard_within_20_seconds(release_copy, with_info):
    os.truncate(release_copy / SHARD, 10**12)
    if not with_info:
        (release_copy / INFO).unlink()
    for level in ("quick", "full", "deep"):
        with time_limit(20):
            found = problems(release_copy, level)
            assert any("bytes, found 1,000,000,000,000" in problem for problem in found)
            assert sum("bytes, found" in problem for problem in found) == 1, found


def test_verify_reports_a_terabyte_readme(release_copy):
    os.truncate(release_copy / "README.md", 10**12)
    found = problems(release_copy, "quick")
    assert any("README.md: expected at most 1,073,741,824 bytes, found 1,000,000,000,000" in line for line in found)
