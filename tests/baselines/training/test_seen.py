"""Record of the layouts and teammates that a model was trained on."""

from __future__ import annotations

import json

import pytest

from baselines.training.histories import hold_out
from baselines.training.seen import SeenInTraining, parse_seen, seen_in, teammate_id
from generation.teammates.instances import published_task
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import NotStoredError, OptionError


def test_the_record_names_the_layouts_and_teammates_of_a_selection():
    tasks = [task for task in read_tasks(MINI / "meta" / "tasks.jsonl") if task.split == "train"]
    dataset = load_icrl4aht(split="train", layout=["demo_simple", "demo_wide"])
    seen = seen_in(dataset)
    assert seen.layouts == ("demo_simple", "demo_wide")
    expected: dict[str, set[str]] = {}
    for task in tasks:
        if task.layout.name in seen.layouts:
            expected.setdefault(task.teammate_kind, set()).add(teammate_id(task.teammate))
    assert {kind: set(ids or ()) for kind, ids in seen.teammates.items()} == expected
    assert parse_seen(json.loads(json.dumps(seen.to_json())), "run.json") == seen


def test_held_out_teammates_are_not_in_the_record():
    dataset = load_icrl4aht(split="train", layout="demo_simple")
    split = hold_out(dataset, 0.1)
    assert split.teammates is not None
    held = {teammate_id(dataset.recover_teammate(int(history_id))) for history_id in split.teammates.ids}
    trained = {name for ids in seen_in(split.train).teammates.values() for name in ids or ()}
    assert held
    assert not held & trained


def test_teammates_of_one_policy_have_one_id():
    h1 = published_task("demo_wide", "H1/t0").teammate
    exact = {name: round(value, 6) for name, value in h1["theta"].items()}  # manifests round to single precision
    assert exact != h1["theta"]
    assert teammate_id(h1 | {"theta": exact, "theta_id": 9, "base_seed": 3}) == teammate_id(h1)
    assert teammate_id(published_task("demo_wide", "H1/t1").teammate) != teammate_id(h1)
    policy = {"kind": "rl", "family": "fcp", "theta": {"checkpoint": "a/b", "sha256": "ab" * 32}}
    assert teammate_id(policy) == "ab" * 8


def test_releases_without_tasks_say_that_teammates_are_unknown(monkeypatch):
    dataset = load_icrl4aht(split="train", layout="demo_simple")

    def recover(history_id):
        raise NotStoredError("no tasks")

    monkeypatch.setattr(dataset, "recover_teammate", recover)
    kinds = {entry.teammate_kind for entry in dataset.entries}
    assert seen_in(dataset) == SeenInTraining(("demo_simple",), dict.fromkeys(sorted(kinds)))


@pytest.mark.parametrize(
    "content", [None, [], {}, {"layouts": "demo_wide", "teammates": {}}, {"layouts": [], "teammates": {"fcp": [3]}}]
)
def test_records_of_another_form_are_refused(content):
    with pytest.raises(OptionError, match=r"run\.json: seen_in_training: .*expected"):
        parse_seen(content, "run.json")
