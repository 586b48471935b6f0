"""Test the record of layouts and teammates in a model's training data."""

from __future__ import annotations

import pytest
from icrl4aht_baselines.training.histories import training_record
from icrl4aht_baselines.training.seen import SeenInTraining, parse_training_record
from icrl4aht_generation.teammates.instances import published_task

from icrl4aht_data import Dataset, load_icrl4aht
from icrl4aht_data.benchmark.tasks import teammate_id
from icrl4aht_data.dataset import teammate_ids
from icrl4aht_data.errors import NotStoredError, OptionError


@pytest.fixture
def dataset(two_sources) -> Dataset:
    """Return the histories of source `noise` on demo_wide in split `train`, with two teammates."""
    return load_icrl4aht(two_sources[0], split="train", layout="demo_wide", source="noise")


def test_training_record_lists_all_teammates_of_each_family(dataset):
    found = {}
    for cell in training_record(dataset):
        of_cell = dataset.filter(teammate_kind=cell["algorithm"])
        assert cell["teammates"] == teammate_ids(dataset, of_cell.ids.tolist())
        assert len(cell["teammates"]) == cell["tasks"]
        found[cell["algorithm"]] = tuple(cell["teammates"])
    assert parse_training_record(training_record(dataset), "run.json") == SeenInTraining(("demo_wide",), found)


def test_teammate_id_depends_only_on_the_policy():
    h1 = published_task("demo_wide", "H1/t0").teammate
    exact = {name: round(value, 6) for name, value in h1["theta"].items()}  # manifests store single precision
    assert exact != h1["theta"]
    assert teammate_id(h1 | {"theta": exact, "theta_id": 9, "base_seed": 3}) == teammate_id(h1)
    assert teammate_id(published_task("demo_wide", "H1/t1").teammate) != teammate_id(h1)
    policy = {"kind": "rl", "family": "fcp", "theta": {"checkpoint": "a/b", "sha256": "ab" * 32}}
    assert teammate_id(policy) == "ab" * 8


def test_teammate_ids_are_none_for_releases_without_tasks(dataset, monkeypatch):
    def raise_not_stored(history_id):
        raise NotStoredError("no tasks")

    monkeypatch.setattr(dataset, "recover_teammate", raise_not_stored)
    assert teammate_ids(dataset, dataset.ids.tolist()) is None


def test_training_records_of_the_same_algorithm_are_merged():
    greedy = {"layout": "demo_wide", "family": "H4", "algorithm": "utility_greedy", "teammates": ["b"]}
    learned = {"layout": "demo_wide", "split": "train", "family": "rl", "algorithm": "fcp", "teammates": ["a", "c"]}
    found = parse_training_record([greedy, greedy | {"layout": "demo_simple", "teammates": ["a"]}, learned], "run.json")
    expected = {"utility_greedy": ("a", "b"), "fcp": ("a", "c")}
    assert found == SeenInTraining(("demo_wide", "demo_simple"), expected)
    unknown = parse_training_record([learned, learned | {"teammates": None}], "run.json")
    assert unknown.teammates == {"fcp": None}
    any_algorithm = parse_training_record([{"layout": "demo_wide", "family": "rl"}], "run.json")
    assert any_algorithm.teammates == dict.fromkeys(("fcp", "brdiv", "lbrdiv", "comedi"))
    assert parse_training_record([], "run.json") == SeenInTraining()
    (alias,) = parse_training_record([{"layout": "demo_cook_wide", "family": "H4"}], "run.json").layouts
    assert alias == "demo_wide"
    with pytest.raises(OptionError, match=r"trained_on: unknown layout 'demo_wid'.*mean 'demo_wide'"):
        parse_training_record([{"layout": "demo_wid", "family": "H4"}], "run.json")


@pytest.mark.parametrize(
    "entries",
    [
        None,
        "demo_wide",
        [{"layout": "demo_wide"}],
        [{"layout": "demo_wide", "family": "H5"}],
        [{"layout": "demo_wide", "family": "H4", "algorithm": "fcp"}],
        [{"layout": "demo_wide", "family": "H4", "teammates": [3]}],
    ],
)
def test_invalid_training_record_raises_error(entries):
    with pytest.raises(OptionError, match=r"run\.json: trained_on: expected "):
        parse_training_record(entries, "run.json")
