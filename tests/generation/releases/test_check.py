"""Test the command `icrl4aht-data check A B`, which compares two rebuilds."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from icrl4aht_generation.learners.resume import xla_threads
from icrl4aht_generation.releases.check import compare_rebuilds

from icrl4aht_data.errors import OptionError
from tests.helpers.commands import run_cli
from tests.helpers.tiny import artefact


def test_check_reports_equal_folders_as_bit_equal(built):
    printed = run_cli("check", built / "a", built / "a")
    assert "bit-equal" in printed
    assert f"{built / 'a'}: made with {xla_threads()} XLA thread" in printed


def test_check_reports_that_numbers_of_threads_differ(tmp_path):
    for name, records in (("a", {"t0": {"xla_threads": 1}, "t1": {"xla_threads": 2}}), ("b", {"t0": {}})):
        (tmp_path / name / "meta").mkdir(parents=True)
        (tmp_path / name / "meta/provenance.json").write_text(json.dumps(records))
    assert compare_rebuilds(tmp_path / "a", tmp_path / "b").xla_threads == ([1, 2], [])
    output = run_cli("check", tmp_path / "a", tmp_path / "b", code=1)
    assert f"{tmp_path / 'a'}: made with 1 and 2 XLA threads" in output
    assert f"{tmp_path / 'b'}: made with an unknown number of XLA threads" in output


def test_check_reports_the_first_difference_of_each_file(built, tmp_path):
    ours = artefact(built / "a")
    theirs = tmp_path / "other"
    shutil.copytree(ours, theirs)
    actions = np.load(theirs / "actions.npy", mmap_mode="r+")
    actions[2, 7] += 1
    actions.flush()
    np.save(theirs / "rewards.npy", np.zeros((2, 3), np.int8))
    lines = (theirs / "metrics.jsonl").read_text().splitlines()
    (theirs / "metrics.jsonl").write_text("\n".join([*lines[:2], "{}", *lines[3:]]) + "\n")
    (theirs / "checkpoints/c2/policy.json").unlink()
    (theirs / "notes.txt").touch()
    for name in ("timing.jsonl", "labeller_returns.json"):
        (theirs / name).write_bytes(b"another clock")
    printed = run_cli("check", "--json", ours, theirs, code=1)
    compared = json.loads(printed)
    found = compared["differences"]
    assert not compared["equal"]
    assert set(found) == {"actions.npy", "rewards.npy", "metrics.jsonl", "checkpoints/c2/policy.json", "notes.txt"}
    was = int(np.load(ours / "actions.npy")[2, 7])
    assert found["actions.npy"] == f"1 of 4000 values, the first at (2, 7): {was} and {was + 1}"
    assert found["rewards.npy"] == "int8 (8, 500) and int8 (2, 3)"
    assert found["metrics.jsonl"].endswith(", line 3")
    assert found["checkpoints/c2/policy.json"] == f"only in {ours}"
    assert found["notes.txt"] == f"only in {theirs}"
    printed = run_cli("check", ours, theirs, code=1)
    assert "5 differ" in printed


def test_check_of_empty_or_missing_folders_raises_error(tmp_path):
    (tmp_path / ".hidden").touch()
    with pytest.raises(OptionError, match="no files to compare"):
        compare_rebuilds(tmp_path, tmp_path)
    with pytest.raises(OptionError, match=r"nowhere: no such folder"):
        compare_rebuilds(tmp_path, tmp_path / "nowhere")
