"""Loading, selecting, lazy arrays."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import LabelsMissingError, UnknownNameError
from icrl4aht_data.overcooked.observe import observe


def test_filters_pick_what_they_say(lite):
    dataset = load_icrl4aht(lite[0])
    assert {entry.layout for entry in dataset.filter(layout="demo_wide").entries} == {"demo_wide"}
    assert len(dataset.filter(layout="demo_wide")) == 6
    assert len(dataset.filter(layout=["demo_wide", "coord_simple"], split="train")) == 12
    task = dataset.entries[4].task_id
    assert [e.task_id for e in dataset.filter(task_id=task, teammate_family="H4").entries] == [task] * 3
    assert len(load_icrl4aht(lite[0], track="teammate", teammate_kind="utility_greedy")) == 12


def test_environment_names_are_aliases(lite):
    by_alias = load_icrl4aht(lite[0], layout="demo_cook_wide")
    assert by_alias.ids.tolist() == load_icrl4aht(lite[0], layout="demo_wide").ids.tolist()


def test_filter_works_within_a_selection_and_keeps_its_order(lite):
    dataset = load_icrl4aht(lite[0]).select([11, 0, 7])
    assert dataset.ids.tolist() == [11, 0, 7]
    assert dataset.filter(layout="demo_wide").ids.tolist() == [11, 7]


def test_positions_ids_and_iteration(lite):
    dataset = load_icrl4aht(lite[0]).select([5, 2])
    assert [history.entry.history_id for history in dataset] == [5, 2]
    assert dataset[1].entry.history_id == 2
    assert dataset.history(9).entry.history_id == 9
    with pytest.raises(UnknownNameError, match=r"no history with id 99; ids: 0\.\.11"):
        dataset.history(99)


@pytest.mark.parametrize(
    "key",
    [
        slice(None),
        slice(10, 50),
        slice(5, 100, 7),
        slice(-20, None),
        slice(100, 5, -9),
        slice(None, None, -1),
        slice(30, 30),
        slice(500, 600),
        3,
        -1,
        [4, 90, 4],
        np.arange(120) % 3 == 0,
        (slice(3, 9), 2),
        (7, 3),
        ...,
        None,
        (..., 2),
    ],
    ids=str,
)
def test_lazy_arrays_index_as_arrays_do(lite, key):
    root, written = lite
    lazy = load_icrl4aht(root)[4].state
    expected = written[4]["state"]
    assert lazy.shape == expected.shape
    assert lazy.dtype == expected.dtype
    index = np.asarray(key) if isinstance(key, list) else key
    np.testing.assert_array_equal(lazy[key], expected[index])


def test_lazy_array_out_of_range(lite):
    with pytest.raises(IndexError):
        load_icrl4aht(lite[0])[0].actions[120]


@pytest.mark.parametrize("dtype", ["float32", "uint8", "state"])
def test_observations_as_asked(either, dtype):
    root, written = either
    dataset = load_icrl4aht(root, layout="demo_wide", obs=dtype)
    history = dataset[0]
    state = written[history.entry.history_id]["state"]
    expected = state if dtype == "state" else observe(_layout(history), state, 0)
    obs = history.obs
    assert obs.shape == expected.shape
    assert obs.dtype == ("uint8" if dtype == "state" else dtype)
    assert obs[3:8].dtype == obs.dtype
    np.testing.assert_array_equal(obs[:], expected)
    np.testing.assert_array_equal(np.asarray(obs), expected)


def _layout(history):
    from icrl4aht_data import get_layout

    return get_layout(history.entry.layout)


def test_recover_environment_and_teammate(lite):
    dataset = load_icrl4aht(lite[0])
    environment = dataset.recover_environment(8)
    assert environment["environment_name"] == "demo_cook_wide"
    assert environment["recipes"] == [[0, 0, 0], [1, 1, 1]]
    assert (environment["max_steps"], environment["kept_steps"]) == (400, 20)
    teammate = dataset.recover_teammate(8)
    assert (teammate["kind"], teammate["family"], teammate["theta_id"]) == ("heuristic", "utility_greedy", 0)


def test_returns_are_the_learning_curve(lite):
    root, written = lite
    np.testing.assert_allclose(
        load_icrl4aht(root)[3].returns(), written[3]["rewards"].reshape(6, 20).sum(axis=1), rtol=0, atol=1e-9
    )


def test_parts_and_selections_of_a_selection(lite):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    assert dataset[1:3].ids.tolist() == [7, 8]
    with pytest.raises(UnknownNameError, match=r"this selection has no history \[0\]"):
        dataset.select([7, 0])


def test_a_dataset_travels_by_pickle(lite):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    dataset[0].state[:]
    again = pickle.loads(pickle.dumps(dataset))
    np.testing.assert_array_equal(again[0].state[:], dataset[0].state[:])


def test_missing_labels_are_an_error(tmp_path):
    from tests.helpers.random_play import random_release

    random_release(tmp_path / "r", labels=False, layouts=("cramped_up",))
    history = load_icrl4aht(tmp_path / "r")[0]
    assert not history.entry.has_expert_actions
    with pytest.raises(LabelsMissingError, match="has_expert_actions = false"):
        history.expert_actions  # noqa: B018
    with pytest.raises(LabelsMissingError, match="6 of 6 histories"):
        load_icrl4aht(tmp_path / "r").dpt(batch_size=1, context=5)
