"""Test filters by source, split and learner, and counts of histories."""

from __future__ import annotations

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, UnknownNameError


def test_learner_filter_selects_histories(two_sources):
    dataset = load_icrl4aht(two_sources[0], source="ppo", learner=1)
    assert (len(dataset), set(dataset.column("learner"))) == (8, {1})
    assert len(load_icrl4aht(two_sources[0], learner=[0, 1])) == 40
    assert dataset.filter(layout="demo_wide", learner=1).ids.tolist() == dataset.ids[:4].tolist()
    with pytest.raises(EmptySelectionError, match=r"has learner = 7, only 0, 1: Dataset"):
        load_icrl4aht(two_sources[0], learner=7)
    with pytest.raises(EmptySelectionError, match=r"has learner = 'first', only 0, 1"):
        load_icrl4aht(two_sources[0], learner="first")  # type: ignore[arg-type]


def test_counts_and_describe_summarize_a_selection(two_sources):
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide")
    assert dataset.counts("source") == {"ppo": 8, "noise": 12}
    assert dataset.counts("labels") == {"expert": 20, "oracle": 20}
    assert dataset.counts("algorithm")["utility_greedy"] > 0
    assert dataset.filter(source="noise").counts("source") == {"noise": 12}
    text = dataset.describe()
    assert text.splitlines()[:3] == [repr(dataset), "split: train (14), validation (6)", "source: ppo (8), noise (12)"]
    assert "labels: expert (20), oracle (20)" in text
    with pytest.raises(UnknownNameError, match="unknown field of names 'score'; valid: labels, task_id"):
        dataset.counts("score")
