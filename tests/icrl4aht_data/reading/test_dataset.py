"""Test loading and selecting histories, changing options, and reading fields."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from icrl4aht_data import get_layout, load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, Icrl4ahtError, OptionError, UnknownNameError
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.batches import assert_equal_batches


@pytest.mark.parametrize(
    ("wanted", "ids"),
    [
        ({"layout": "demo_cook_wide"}, range(6, 12)),
        ({"layout": ["demo_wide", "coord_simple"], "split": "train"}, range(12)),
        ({"track": "teammate", "teammate_kind": "utility_greedy"}, range(12)),
    ],
    ids=str,
)
def test_filter_and_load_select_the_same_histories(lite, wanted, ids):
    dataset = load_icrl4aht(lite[0])
    assert dataset.filter(**wanted).ids.tolist() == load_icrl4aht(lite[0], **wanted).ids.tolist() == list(ids)


def test_selections_can_be_filtered_and_selected_again(lite):
    dataset = load_icrl4aht(lite[0])
    task = dataset.entries[4].task_id
    assert [e.task_id for e in dataset.filter(task_id=task, teammate_family="H4").entries] == [task] * 3
    mixed = dataset.select([11, 0, 7])
    assert mixed.ids.tolist() == [11, 0, 7]
    assert mixed.filter(layout="demo_wide").ids.tolist() == [11, 7]
    wide = dataset.filter(layout="demo_wide")
    assert wide[1:3].ids.tolist() == [7, 8]
    with pytest.raises(UnknownNameError, match=r"this selection has no history \[0\]"):
        wide.select([7, 0])


def test_boolean_mask_selects_histories(lite):
    dataset = load_icrl4aht(lite[0])
    mask = dataset.column("layout") == "demo_wide"
    assert dataset.select(mask).ids.tolist() == dataset.ids[mask].tolist()
    with pytest.raises(EmptySelectionError):
        dataset.select(np.zeros(len(dataset), bool))
    with pytest.raises(OptionError, match=r"a bool for each of 12 histories, found bool of shape \(3,\)"):
        dataset.select(mask[:3])
    for wrong in ([1.5], [[0]], ["0"]):
        with pytest.raises(OptionError, match="expected a list of history ids"):
            dataset.select(np.array(wrong))


@pytest.mark.parametrize("wanted", [{"algorithm": 3}, {"layout": 3}, {"split": [None]}])
def test_filter_values_that_are_not_names_raise_errors(wanted):
    with pytest.raises(UnknownNameError, match=r"unknown (algorithm|layout|split)"):
        load_icrl4aht(**wanted)


def test_histories_are_found_by_position_id_and_iteration(lite):
    dataset = load_icrl4aht(lite[0]).select([5, 2])
    assert [history.entry.history_id for history in dataset] == [5, 2]
    assert dataset[1].entry.history_id == 2
    assert dataset.history(9).entry.history_id == 9
    with pytest.raises(UnknownNameError, match=r"no history with id 99; ids: 0\.\.11"):
        dataset.history(99)


def test_with_options_shares_index_and_shards(lite, converted_release):
    dataset = load_icrl4aht(lite[0], layout="demo_wide", threads=1)
    dataset[0].actions[:]
    states = dataset.with_options(obs="state", cache="stream")
    assert (states.obs, states.threads, states.cache.cache, dataset.obs) == ("state", 1, "stream", "float32")
    assert states.index is dataset.index
    assert states[0]._shard is dataset[0]._shard
    expected = load_icrl4aht(lite[0], layout="demo_wide", obs="state").ad(batch_size=3, length=9)
    assert_equal_batches(states.ad(batch_size=3, length=9)[0], expected[0])
    with pytest.raises(UnknownNameError, match="unknown obs 'float16'; valid: float32, uint8, state"):
        dataset.with_options(obs="float16")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="threads = 0"):
        dataset.with_options(threads=0)
    with pytest.raises(OptionError, match=r'obs = "state": .* has observations only'):
        load_icrl4aht(converted_release).with_options(obs="state")


@pytest.mark.parametrize("rows", [(0, None), (10, 50), (-20, None), (30, 30), (500, 600), (119, 120)], ids=str)
def test_reading_a_range_of_a_field_returns_its_rows(lite, rows):
    root, written = lite
    history, expected = load_icrl4aht(root)[4], written[4]["state"]
    np.testing.assert_array_equal(history.read("state", *rows), expected[slice(*rows)], strict=True)


@pytest.mark.parametrize(
    "use",
    [
        lambda ds: ds.select([[1], [1, 2]]),
        lambda ds: ds[True],
        lambda ds: ds["a"],
        lambda ds: ds["a":],
        lambda ds: ds[0].episodes["a":],
        lambda ds: ds[0].episodes[True],
        lambda ds: ds[0].read("actions", "a"),
        lambda ds: ds[0].read("actions", 0, 1.5),
    ],
)
def test_invalid_positions_raise_package_errors(lite, use):
    with pytest.raises(Icrl4ahtError):
        use(load_icrl4aht(lite[0]))


def test_history_fields_are_cached_read_only_arrays(lite):
    history = load_icrl4aht(lite[0])[4]
    assert history.actions is history["actions"] and isinstance(history.actions, np.ndarray)
    assert history.episodes[1].obs.base is None, "an episode reads its own steps only"
    with pytest.raises(ValueError, match="read-only"):
        history.actions[0] = 3
    copy = pickle.loads(pickle.dumps(history))
    np.testing.assert_array_equal(copy.obs, history.obs)


@pytest.mark.parametrize("obs", ["float32", "uint8", "state"])
def test_obs_option_sets_the_type_of_observations(lite_or_full, obs):
    root, written = lite_or_full
    history = load_icrl4aht(root, layout="demo_wide", obs=obs)[0]
    state = written[history.entry.history_id]["state"]
    expected = state if obs == "state" else observe(get_layout("demo_wide"), state, 0)
    assert history.obs.dtype == ("uint8" if obs == "state" else obs)
    np.testing.assert_array_equal(history.obs, expected)


def test_environment_parameters_and_teammate_of_a_history_are_returned(lite):
    dataset = load_icrl4aht(lite[0])
    environment = dataset.environment_parameters(8)
    assert environment["environment_name"] == "demo_cook_wide"
    assert environment["recipes"] == [[0, 0, 0], [1, 1, 1]]
    assert (environment["max_steps"], environment["kept_steps"]) == (400, 20)
    teammate = dataset.recover_teammate(8)
    assert (teammate["kind"], teammate["family"], teammate["theta_id"]) == ("heuristic", "utility_greedy", 0)


def test_invalid_history_ids_raise_errors(lite):
    dataset = load_icrl4aht(lite[0])
    wrong_ids: list[Any] = ["x", 1.5, None]
    for call in (dataset.history, dataset.recover_environment, dataset.environment_parameters, dataset.reset_options):
        for wrong in wrong_ids:
            with pytest.raises(OptionError, match=f"history_id = {wrong!r}: expected an integer"):
                call(wrong)
        for absent in (-1, 12):
            with pytest.raises(UnknownNameError, match=f"no history with id {absent}; ids: 0..11"):
                call(absent)
