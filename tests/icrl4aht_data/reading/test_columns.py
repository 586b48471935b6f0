"""Test index columns, data frames, filters, counts, and warnings about labels of an expert with low returns."""

from __future__ import annotations

import json
import math
import warnings

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, NotStoredError, OptionError, UnknownNameError, WeakLabelsWarning
from icrl4aht_data.format.provenance import ExpertLabels, LabelView
from icrl4aht_data.format.schema import ENTRY_HINTS
from tests.helpers.random_releases import random_release


def expert_labels(greedy: float, sampled: float, view: LabelView = "ego") -> ExpertLabels:
    returns = {"return_greedy": greedy, "return_sampled": sampled}
    return ExpertLabels("0" * 64, "greedy", step=1000, episodes=200, view=view, **returns)


@pytest.fixture(scope="module")
def expert_release(tmp_path_factory):
    """Return a release of four tasks with expert returns 9.5, 0.0, -30.0 and unknown."""
    root = tmp_path_factory.mktemp("measured") / "release"
    experts = [expert_labels(9.5, 10.0), expert_labels(0.0, 16.9), expert_labels(-30.0, 1.0, "state"), None]
    random_release(root, streams=2, experts=experts, sources=["ppo", "ppo", "search", "search"], swap=4)
    return root


def test_index_columns_equal_the_fields_of_entries(expert_release):
    dataset = load_icrl4aht(expert_release).select([7, 0, 3])
    for name in ENTRY_HINTS:
        found = dataset.column(name).tolist()
        for value, entry in zip(found, dataset.entries, strict=True):
            expected = getattr(entry, name)
            if expected is None:
                assert value in (-1, "") or math.isnan(value)
            elif name == "teammate_of_episode":
                assert json.loads(value) == [list(pair) for pair in expected]
            else:
                assert value == (list(expected) if name == "obs_shape" else expected), name


@pytest.mark.parametrize(("name", "nearest"), [("layot", "layout"), ("return", "return_end")])
def test_unknown_column_raises_error_with_the_nearest_name(lite, name, nearest):
    with pytest.raises(UnknownNameError, match=rf"unknown column '{name}'; valid: history_id, .* mean '{nearest}'"):
        load_icrl4aht(lite[0]).column(name)


@pytest.mark.parametrize("name", [None, 3, ["layout"], np.array(["layout", "split"])])
def test_column_name_that_is_not_a_string_raises_package_error(lite, name):
    with pytest.raises(UnknownNameError, match=r"unknown column .*; valid: history_id, "):
        load_icrl4aht(lite[0]).column(name)


def test_to_pandas_returns_one_row_per_history(expert_release):
    dataset = load_icrl4aht(expert_release, layout=["demo_wide", "coord_simple"]).select([7, 0, 3])
    frame = dataset.to_pandas()
    assert list(frame.columns) == list(ENTRY_HINTS)
    assert (frame.layout == "demo_wide").tolist() == [True, False, False]
    assert frame.source.tolist() == ["search", "ppo", "ppo"]
    assert frame.expert_return.isna().tolist() == [True, False, False]
    assert frame.expert_step.fillna(0).tolist() == [0, 1000, 1000]
    assert frame.label_view.fillna("").tolist() == ["", "ego", "ego"]
    for name in ("history_id", "T", "return_end", "has_expert_actions"):
        assert frame[name].tolist() == [getattr(entry, name) for entry in dataset.entries]
    assert frame.obs_shape.tolist() == [entry.obs_shape for entry in dataset.entries]


def test_source_and_algorithm_filters_select_histories(expert_release):
    assert load_icrl4aht(expert_release, source="search").ids.tolist() == [4, 5, 6, 7]
    both = load_icrl4aht(expert_release).filter(source=["ppo", "search"], algorithm="utility_greedy")
    assert both.ids.tolist() == [*range(8)]
    with pytest.raises(UnknownNameError, match=r"unknown source 'sac'; valid: ppo, noise, agent, search"):
        load_icrl4aht(expert_release, source="sac")
    with pytest.raises(UnknownNameError, match=r"unknown algorithm 'utility'; .* mean 'utility_greedy'"):
        load_icrl4aht(expert_release, algorithm="utility")
    with pytest.raises(UnknownNameError, match=r"unknown filter 'algoritm'; .* mean 'algorithm'"):
        load_icrl4aht(expert_release).filter(algoritm="utility")
    with pytest.raises(EmptySelectionError, match=r"'coord_simple', source='search'\..*; source ppo, search$"):
        load_icrl4aht(expert_release, layout="coord_simple", source="search")


def test_label_view_filter_selects_histories(expert_release, lite):
    assert load_icrl4aht(expert_release, label_view="ego").ids.tolist() == [0, 1, 2, 3]
    assert load_icrl4aht(expert_release).filter(label_view=["state", "ego"]).ids.tolist() == [*range(6)]
    assert load_icrl4aht(expert_release).counts("label_view") == {"ego": 4, "state": 2}
    with pytest.raises(UnknownNameError, match=r"unknown label_view 'states'; valid: ego, state"):
        load_icrl4aht(expert_release, label_view="states")
    assert load_icrl4aht(lite[0]).counts("label_view") == {}
    with pytest.raises(EmptySelectionError, match=r"label_view='ego'.*label_view not recorded$"):
        load_icrl4aht(lite[0], label_view="ego")


def test_releases_with_old_source_names_are_read_and_filtered(tmp_path):
    """Older releases have the source `student`, a name that new releases no longer use."""
    random_release(tmp_path / "release", streams=1, sources=["student", "noise", "agent", "search"])
    assert load_icrl4aht(tmp_path / "release", source="student").ids.tolist() == [0]


def test_min_expert_return_filter_selects_histories(expert_release):
    dataset = load_icrl4aht(expert_release, source="ppo", min_expert_return=9.5)
    assert dataset.ids.tolist() == [0, 1]
    assert load_icrl4aht(expert_release).select([2, 1]).filter(min_expert_return=-1).ids.tolist() == [2, 1]
    with pytest.raises(EmptySelectionError, match=r"expert_return >= 10, the highest is 9\.5"):
        load_icrl4aht(expert_release, source="ppo", min_expert_return=10)
    with pytest.raises(
        NotStoredError, match=r"of 2 of 8 histories is unknown; leave these histories out by ds\.select"
    ):
        load_icrl4aht(expert_release, min_expert_return=0)
    known = load_icrl4aht(expert_release)
    known = known.select(known.ids[~np.isnan(known.column("expert_return"))])
    assert known.filter(min_expert_return=0).ids.tolist() == [0, 1, 2, 3]
    for wrong in ("1", True, float("nan")):
        with pytest.raises(OptionError, match="min_expert_return = "):
            load_icrl4aht(expert_release, min_expert_return=wrong)  # type: ignore[arg-type]


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


class TestWeakLabels:
    """Test the warning about labels of an expert with low returns, on histories of random play."""

    def test_weak_labels_warning_names_tasks_and_returns(self, expert_release):
        dataset = load_icrl4aht(expert_release, layout="demo_wide")
        with pytest.warns(WeakLabelsWarning) as caught:
            dataset.dpt(batch_size=2, context=5)
        (warning,) = caught
        entry = dataset.entries[0]
        assert "1 of 2 tasks come from a policy that earns" in str(warning.message)
        end = dataset.column("return_end")[:2].mean()
        assert f"{entry.task_id} (labels -30.0, histories {end:.1f})" in str(warning.message)
        assert warning.filename == __file__

    @pytest.mark.parametrize(("ends", "weak"), [([20.0, 18.2], True), ([20.0, 17.0], False), ([-4.0, -1.0], False)])
    def test_warning_appears_if_the_expert_has_less_than_half_the_return_of_the_histories(
        self, expert_release, monkeypatch, ends, weak
    ):
        dataset = load_icrl4aht(expert_release).select([0, 1])
        column = type(dataset).column
        monkeypatch.setattr(
            type(dataset), "column", lambda self, name: np.array(ends) if name == "return_end" else column(self, name)
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            dataset.dpt(batch_size=2, context=5)
        # the expert's return is 9.5 for both histories
        assert [one.category for one in caught] == [WeakLabelsWarning] * weak
