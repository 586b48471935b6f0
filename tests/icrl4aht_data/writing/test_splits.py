"""Test the distances between validation and training teammates that dataset cards show."""

from __future__ import annotations

import json

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.schema import RELEASE_CARD
from icrl4aht_data.writing import splits
from icrl4aht_data.writing.splits import SplitDistance, played_teammates, read_distances, teammates_hash


def test_distances_are_read_only_for_the_teammates_they_were_measured_with(tmp_path, monkeypatch, two_sources):
    dataset = load_icrl4aht(two_sources[0])
    played = played_teammates(dataset.tasks.values(), dataset.provenance)
    stored = tmp_path / "distances.json"
    monkeypatch.setattr(splits, "card_file", lambda name: stored)
    layouts = {"demo_wide": {"train": 2, "validation": 2, "least": 0.25}}
    stored.write_text(json.dumps({"teammates": teammates_hash(played), "layouts": layouts}))
    assert read_distances(played) == {"demo_wide": SplitDistance(2, 2, 0.25)}
    assert read_distances(played[1:]) == {}


def test_bundled_validation_teammates_act_unlike_all_training_teammates():
    dataset = load_icrl4aht()
    played = played_teammates(dataset.tasks.values(), dataset.provenance)
    found = read_distances(played)
    assert {*found} == {"test_wide", "demo_simple", "demo_wide", "asymm_both", "cramped_up"}
    lines = (MINI / RELEASE_CARD).read_text(encoding="utf-8").splitlines()
    for name, distance in found.items():
        own = [task.split for task in played if task.layout.name == name]
        assert (own.count("train"), own.count("validation")) == (distance.train, distance.validation)
        assert distance.validation >= 6
        assert distance.least >= 0.1
        row = next(line for line in lines if line.startswith(f"| {name} |"))
        assert row.endswith(f"| {distance.least:.2f} |")
