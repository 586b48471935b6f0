"""Test `verify_release` and commands on releases that store observations without state records."""

from __future__ import annotations

import pytest

from icrl4aht_data import verify_release
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import HISTORIES
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.commands import run_cli
from tests.helpers.published_files import KEPT
from tests.helpers.random_releases import make_tasks
from tests.helpers.tampered import problems, tampered_copy


class TestVerifyObservations:
    @pytest.mark.parametrize("level", ["full", "deep"])
    def test_verify_accepts_valid_observations(self, converted_release, reconverted_release, level):
        for root, transitions in ((converted_release, 360), (reconverted_release, 1440)):
            report = verify_release(root, level=level)
            assert report.ok, report.findings
            assert report.transitions == transitions
            assert [note[:20] for note in report.notes] == ["nothing was replayed"] * (level == "deep")

    def test_deep_verification_finds_an_impossible_observation(self, published_folder, tmp_path):
        arrays = {name: array.copy() for name, array in published_folder[1][0].items()}
        arrays["obs"][33, :, :, 2 * (7 + get_layout("demo_wide").ingredient_types)] = 1  # a wall in every cell
        (task,) = make_tasks(["demo_wide"])
        new = NewTask(task, Provenance(), 1, lambda: [NewHistory(0, arrays)])
        root = write_release(tmp_path / "r", "observations", [new], data_version="0.0.1", card="", kept_steps=KEPT)
        assert problems(root) == []
        (found,) = problems(root, level="deep")
        assert found.endswith("obs: 1 steps do not show demo_wide from any cell of the ego's, first step 33")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"score": 1e6}, "history 1: score: the index says"),
            ({"episodes": 5}, "line 2: expected episodes of 20 steps"),
        ],
    )
    def test_verify_finds_wrong_scores_and_episode_counts_in_the_index(
        self, converted_release, tmp_path, change, message
    ):
        found = problems(
            tampered_copy(converted_release, tmp_path / "r", HISTORIES, lambda lines: lines[1].update(change))
        )
        assert any(message in line for line in found), found


def test_observations_cannot_be_converted_to_forms_that_need_states(published_folder, tmp_path):
    out = tmp_path / "out"
    said = run_cli("convert", published_folder[0], "--out", out, "--kept-steps", KEPT)
    assert said == f"{out}: observations, no state records: nothing can be replayed or drawn\n"
    run_cli("convert", out, "--out", tmp_path / "part", "--to", "observations", "--layout", "demo_wide")
    run_cli("convert", out, "--out", tmp_path / "files", "--to", "published")
    assert verify_release(tmp_path / "part").ok
    with pytest.raises(Icrl4ahtError, match="needs state records"):
        run_cli("convert", out, "--out", tmp_path / "full", "--to", "full")
    assert "give the format to convert to" in run_cli("convert", out, "--out", tmp_path / "x", code=2)
