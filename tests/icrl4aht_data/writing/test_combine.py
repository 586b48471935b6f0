"""Test that combining releases keeps all histories and refuses invalid inputs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import FormatTooNewError, OptionError
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import INFO, Kind
from icrl4aht_data.writing.combine import combine_releases
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import random_release

_FIELDS = ("state", "actions", "rewards", "dones", "teammate_actions", "expert_actions", "episode_end_state")


@pytest.fixture(scope="module", params=["lite", "full"])
def two_releases(request, tmp_path_factory) -> list[Path]:
    """Return two releases on overlapping layouts with distinct tasks."""
    folder = tmp_path_factory.mktemp(request.param)
    random_release(folder / "a", request.param, ("coord_simple",), teammates=1, streams=2, episodes=5)
    random_release(folder / "b", request.param, ("demo_wide", "coord_simple"), teammates=1, streams=3, episodes=6)
    return [folder / "a", folder / "b"]


def test_combined_histories_equal_those_of_the_inputs(two_releases, tmp_path):
    arguments = ["combine", *map(str, two_releases), "--out", str(tmp_path / "out")]
    run_cli(*arguments)
    report = verify_release(tmp_path / "out", level="deep")
    assert report.ok, report.findings
    combined = load_icrl4aht(tmp_path / "out")
    before = {(h.entry.task_id, h.entry.env_idx): h for root in two_releases for h in load_icrl4aht(root)}
    assert [e.history_id for e in combined.entries] == list(range(8))
    assert {(e.task_id, e.env_idx) for e in combined.entries} == before.keys()
    for history in combined:
        old = before[history.entry.task_id, history.entry.env_idx]
        assert (history.entry.score, history.entry.seed) == (old.entry.score, old.entry.seed)
        for name in _FIELDS:
            assert np.array_equal(history.read(name), old.read(name)), name
    assert "* 8 histories of " in (tmp_path / "out" / "README.md").read_text()


def test_combining_a_single_release_keeps_its_bytes(two_releases, tmp_path):
    combine_releases(tmp_path / "out", two_releases[:1])
    for shard in (two_releases[0] / "data").rglob("*.h5"):
        assert (tmp_path / "out" / shard.relative_to(two_releases[0])).read_bytes() == shard.read_bytes()


def test_combining_a_selection_excludes_all_other_histories(two_releases, tmp_path):
    chosen = load_icrl4aht(two_releases[1], layout="demo_wide")[1:]
    combined = load_icrl4aht(combine_releases(tmp_path / "out", [chosen, two_releases[0]]))
    assert combined.counts("layout") == {"demo_wide": 2, "coord_simple": 2}
    assert verify_release(tmp_path / "out").ok
    by_stream = {history.entry.env_idx: history for history in combined.filter(layout="demo_wide")}
    for history in chosen:
        assert np.array_equal(by_stream[history.entry.env_idx].read("actions"), history.read("actions"))


def test_combine_refuses_a_task_that_two_releases_contain(two_releases, tmp_path):
    with pytest.raises(OptionError, match=r"b: task teammate_train_demo_cook_wide_.* is also in .*b"):
        combine_releases(tmp_path / "out", [two_releases[1], two_releases[0], two_releases[1]])
    assert not (tmp_path / "out").exists()


def test_combine_refuses_different_kinds_lengths_versions_and_formats(tmp_path):
    cases: list[tuple[str, Kind, int]] = [("a", "lite", 20), ("b", "full", 20), ("c", "lite", 10), ("d", "lite", 20)]
    for name, kind, length in cases:
        layout = "coord_simple" if name == "a" else "demo_wide"
        random_release(tmp_path / name, kind, (layout,), teammates=1, streams=1, length=length)
    a, b, c, d = (tmp_path / name for name in "abcd")
    with pytest.raises(OptionError, match=r"b has kind 'full', but .*a has 'lite'; combine only releases of one"):
        combine_releases(tmp_path / "out", [a, b])
    with pytest.raises(OptionError, match=r"c has environment .*kept_steps=10.*a has .*kept_steps=20"):
        combine_releases(tmp_path / "out", [a, c])
    with pytest.raises(OptionError, match=r"a: overlaps the input folder .*a; give another folder"):
        combine_releases(a, [a, d])
    info = json.loads((d / INFO).read_text())
    (d / INFO).write_text(json.dumps(info | {"data_version": "0.0.2"}))
    write_manifest(d)
    with pytest.raises(OptionError, match=r"data versions 0\.0\.1, 0\.0\.2 differ: give"):
        combine_releases(tmp_path / "out", [a, d])
    combine_releases(tmp_path / "out", [a, d], "0.1.0")
    assert json.loads((tmp_path / "out" / INFO).read_text())["data_version"] == "0.1.0"
    (d / INFO).write_text(json.dumps(info | {"format_version": 99}))
    write_manifest(d)
    with pytest.raises(FormatTooNewError, match="format version 99"):
        combine_releases(tmp_path / "new", [a, d])
