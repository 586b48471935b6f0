"""Test histories in which the teammate changes: index, provenance, conversions and verification."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import teammate_id
from icrl4aht_data.dataset import teammate_ids, teammate_names
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, ReferenceEgos
from icrl4aht_data.format.schema import HISTORIES
from icrl4aht_data.writing.card import card_facts, render_card
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import from_published, to_published
from tests.helpers.random_releases import random_release
from tests.helpers.tampered import problems, read_lines, tamper


@pytest.fixture(scope="module")
def swap_release(tmp_path_factory) -> Path:
    """Return a release of two tasks on each of two layouts; the teammate changes after four of six episodes."""
    root = tmp_path_factory.mktemp("swapped") / "release"
    random_release(root, streams=1, swap=4, experts=[ExpertLabels(None, "cook", view="ego")] * 4)
    return root


def test_card_describes_changes_of_teammates(swap_release):
    content = card_facts(swap_release)
    assert (content["views"], content["swapped"]) == ({"ego": {"ppo": 4}}, 4)
    card = render_card(content)
    assert "In 4 histories the teammate changes" in card and "(`ego`) in 4 `ppo` histories" in card


def test_entries_name_the_teammate_of_each_episode(swap_release):
    dataset = load_icrl4aht(swap_release)
    first, second = (teammate_id(dataset.history_task(number).teammate) for number in (0, 1))
    assert dataset[0].entry.teammate_of_episode == ((0, first), (4, second))
    assert dataset[1].entry.teammate_of_episode == ((0, second), (4, first))
    played = [teammate_id(dataset.recover_teammate(0, episode)) for episode in range(6)]
    assert played == [first] * 4 + [second] * 2
    with pytest.raises(OptionError, match=r"episode = 6: history 0 has episodes 0\.\.5"):
        dataset.recover_teammate(0, 6)


def test_teammates_that_share_a_history_are_held_out_together(swap_release, lite):
    dataset = load_icrl4aht(swap_release)
    assert len(set(teammate_names(dataset))) == 2  # one teammate for each layout
    assert np.array_equal(teammate_names(dataset.select([0, 2])), teammate_names(dataset.select([1, 3])))
    assert teammate_ids(dataset, [0]) == teammate_ids(dataset, [1])
    assert len(set(teammate_names(load_icrl4aht(lite[0])))) == 4


@pytest.mark.parametrize("kind", ["lite", "full", "published"])
def test_conversions_keep_changes_of_teammates(swap_release, tmp_path, kind):
    """The teammate changes in the converted history; the new release has no task with the second teammate."""
    part, copy = load_icrl4aht(swap_release).select([1]), tmp_path / "copy"
    if kind == "published":
        to_published(part, tmp_path / "published")
        from_published(tmp_path / "published", copy, kept_steps=20)
    else:
        to_release(part, copy, kind)
    found = load_icrl4aht(copy)
    assert found[0].entry.teammate_of_episode == part[0].entry.teammate_of_episode
    assert found.recover_teammate(0, 5) == part.recover_teammate(1, 5)
    report = verify_release(copy, level="deep")
    assert report.findings == [] and any(note.startswith("changes of teammates") for note in report.notes)


def test_combined_releases_keep_changes_of_teammates(swap_release, lite, tmp_path):
    random_release(tmp_path / "other", layouts=("cramped_up",), streams=1)
    combine_releases(tmp_path / "both", [swap_release, tmp_path / "other"])
    entries, before = load_icrl4aht(tmp_path / "both").entries, load_icrl4aht(swap_release).entries
    spans = [entry.teammate_of_episode for entry in entries]
    assert spans == [*(entry.teammate_of_episode for entry in before), None, None]
    lines = read_lines(tmp_path / "both" / HISTORIES)
    assert ["teammate_of_episode" in line for line in lines] == [True] * 4 + [False] * 2


@pytest.mark.parametrize(
    "spans", [[[1, "a"]], [[0, "a"], [0, "b"]], [[0, "a"], [4, "b"], [2, "a"]], [[0, "a"], [6, "b"]]]
)
def test_verify_finds_invalid_episodes_of_teammate_changes(swap_release, tmp_path, spans):
    copy = tmp_path / "copy"
    to_release(load_icrl4aht(swap_release).select([0]), copy, "lite")
    tamper(copy, HISTORIES, lambda lines: lines[0].update(teammate_of_episode=spans))
    found = problems(copy)
    assert any("expected ascending episodes from 0 to 5 at most" in problem for problem in found)
    assert any("teammate_of_episode" in problem and "provenance" in problem for problem in found)


def test_malformed_teammates_in_provenance_are_refused():
    teammate = {"kind": "heuristic", "family": "cook", "theta_id": 0, "base_seed": 0, "theta": {}}
    with pytest.raises(IndexFormatError, match="unknown heuristic family 'cook'"):
        Provenance.from_json({"swaps": {"every": 2, "teammates": [teammate, teammate]}})
    with pytest.raises(IndexFormatError, match="length >= 2"):
        Provenance.from_json({"swaps": {"every": 2, "teammates": [teammate]}})


def test_is_oracle_useful_compares_the_oracle_with_the_final_return():
    references = ReferenceEgos(stay=0.0, random=0.0, oracle=20.0, episodes=100)
    assert Provenance(references=references).is_oracle_useful(20.0)
    assert not Provenance(references=references).is_oracle_useful(20.5)
    assert Provenance().is_oracle_useful(1000.0)
