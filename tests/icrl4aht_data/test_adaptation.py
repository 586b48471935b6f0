"""Test the stored adaptation headroom: which entries count for published layouts, and how they are shown."""

from __future__ import annotations

import pytest

from icrl4aht_data.benchmark import adaptation
from icrl4aht_data.benchmark.adaptation import (
    adaptation_table,
    headroom_text,
    published_adaptation,
    published_adaptation_table,
    read_adaptation,
)
from icrl4aht_data.dataset import MINI
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.writing.card import card_facts, render_card


def make_entry(tasks: str, informed: float, episodic: float, interval: list[float] | None = None) -> dict:
    returns = {"informed": {"0": informed}, "episodic": {"0": episodic}}
    sizes = {"number": 20, "steps": 8_000, "width": 64}
    return {"tasks": tasks, **sizes, "returns": returns, "interval": interval}


ENTRY = make_entry("teammate-test-demo_wide", 10.0, 12.0, [-3.0, -1.0])
OTHERS = ("teammate-validation-demo_wide", "teammate-test-all", "teammate-test-demo_wide-H1", "preference-test-all")


@pytest.fixture
def measured(tmp_path, monkeypatch) -> None:
    """Replace the package's measurements by those of `ENTRY`, and of other sets of tasks."""
    few = make_entry("teammate-test-demo_simple", 1.0, 0.0) | {"number": 19}
    write_json(tmp_path / "adaptation.json", [ENTRY, few, *(make_entry(name, 1.0, 0.0) for name in OTHERS)])
    monkeypatch.setattr(adaptation, "card_file", lambda name: tmp_path / name)


@pytest.mark.usefixtures("measured")
def test_only_all_test_tasks_of_a_layout_count_as_measured():
    assert published_adaptation() == {"demo_wide": ENTRY}
    for best, texts in (({"demo_wide": 15.5}, "15.5 | 10.0 | 12.0 | +3.5"), ({}, "– | 10.0 | 12.0 | –")):
        row = f"| demo_wide | {texts} | -2.0 (-3.0 to -1.0) | 1 x 8,000 |"
        assert published_adaptation_table(best).splitlines()[2:] == [row]


@pytest.mark.usefixtures("measured")
def test_card_states_the_difference_on_each_measured_layout():
    content = card_facts(MINI)
    assert content["adaptation"] == {"demo_wide": "-2.0 (-3.0 to -1.0)"}
    assert "over training runs): demo_wide -2.0 (-3.0 to -1.0).\n" in render_card(content)
    assert "over training runs): " not in render_card(content | {"adaptation": {}})


def test_without_a_file_nothing_is_measured(tmp_path):
    assert read_adaptation(tmp_path) == []


def test_difference_has_an_interval_if_there_are_several_seeds():
    assert headroom_text(ENTRY) == "-2.0 (-3.0 to -1.0)"
    assert headroom_text(make_entry("all", 1.0, 1.04)) == "+0.0"


def test_table_shows_returns_of_scripts_beside_those_of_egos():
    """Sets without returns of scripts have empty cells, as on published layouts."""
    scripts = {"stay": 0.0, "random": -1.0, "oracle": 40.0, "search": 30.0}
    header, _, *rows = adaptation_table([make_entry("all", 3.0, 1.0) | {"scripts": scripts}, ENTRY]).splitlines()
    assert header.startswith("| set | tasks | stay | random | oracle | search | informed | episodic | difference |")
    assert rows == [
        "| all | 20 | 0.0 | -1.0 | 40.0 | 30.0 | 3.0 | 1.0 | +2.0 | 1 | 8,000 | 64 |",
        "| teammate-test-demo_wide | 20 |  |  |  |  | 10.0 | 12.0 | -2.0 (-3.0 to -1.0) | 1 | 8,000 | 64 |",
    ]
