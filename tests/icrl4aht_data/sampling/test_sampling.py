"""Batches: contents against the histories, purity, uniformity."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError, UnknownNameError
from tests.helpers.batches import digest
from tests.helpers.paths import ROOT
from tests.helpers.random_play import random_release

LENGTH = 32


def previous(array):
    return np.concatenate([[0], array[:-1]])


def test_ad_windows_are_slices_of_histories(either):
    root, written = either
    dataset = load_icrl4aht(root, layout="demo_wide")
    sampler = dataset.ad(batch_size=64, length=LENGTH, seed=3, teammate_actions=True)
    at_the_start = 0
    for i in range(4):
        batch = sampler[i]
        for row, (history_id, start) in enumerate(zip(*sampler.windows(i), strict=True)):
            arrays, window = written[int(history_id)], slice(start, start + LENGTH)
            at_the_start += start == 0
            np.testing.assert_array_equal(batch.target_actions[row], arrays["actions"][window])
            np.testing.assert_array_equal(batch.dones[row], arrays["dones"][window])
            np.testing.assert_array_equal(batch.prev_actions[row], previous(arrays["actions"])[window])
            np.testing.assert_array_equal(batch.prev_rewards[row], previous(arrays["rewards"])[window])
            assert batch.prev_teammate_actions is not None
            np.testing.assert_array_equal(
                batch.prev_teammate_actions[row], previous(arrays["teammate_actions"])[window]
            )
            np.testing.assert_array_equal(batch.obs[row], dataset.history(int(history_id)).obs[window])
        assert batch.attention_mask.all()
    assert at_the_start, "no window started at step 0: the case of zeros before it was not met"


def test_ad_fields_dtypes_and_shapes(lite):
    batch = load_icrl4aht(lite[0], layout="coord_simple").ad(batch_size=4, length=50, seed=0)[0]
    assert {name: (str(a.dtype), a.shape) for name, a in batch._asdict().items() if a is not None} == {
        "obs": ("float32", (4, 50, 5, 5, 40)),
        "prev_actions": ("int32", (4, 50)),
        "prev_rewards": ("float32", (4, 50)),
        "target_actions": ("int32", (4, 50)),
        "dones": ("bool", (4, 50)),
        "attention_mask": ("bool", (4, 50)),
    }


def test_short_histories_are_padded_at_the_end(lite):
    root, written = lite
    sampler = load_icrl4aht(root, layout="coord_simple").ad(batch_size=3, length=150)
    batch = sampler[0]
    ids, starts = sampler.windows(0)
    assert starts.tolist() == [0, 0, 0]
    np.testing.assert_array_equal(batch.attention_mask, np.broadcast_to(np.arange(150) < 120, (3, 150)))
    np.testing.assert_array_equal(batch.target_actions[1, :120], written[int(ids[1])]["actions"])
    np.testing.assert_array_equal(batch.prev_rewards[1, 1:120], written[int(ids[1])]["rewards"][:-1])
    for name in ("obs", "prev_actions", "prev_rewards", "target_actions", "dones"):
        assert not getattr(batch, name)[:, 120:].any(), name


@pytest.mark.parametrize("order", ["contiguous", "random"])
def test_dpt_batches_are_transitions_of_the_same_task(either, order):
    root, written = either
    dataset = load_icrl4aht(root, layout="demo_wide", obs="state")
    tasks = {task: [h for h in dataset if h.entry.task_id == task] for task in {e.task_id for e in dataset.entries}}
    sampler = dataset.dpt(batch_size=32, context=25, order=order, seed=1, teammate_actions=True)
    ends = 0
    for i in range(3):
        batch = sampler[i]
        assert batch.context_teammate_actions is not None
        for row in range(32):
            query = (batch.query_obs[row].tobytes(), int(batch.query_target[row]))
            context = _rows(batch, row)
            homes = [
                task
                for task, members in tasks.items()
                if any(query in _labelled(written[h.entry.history_id]) for h in members)
                and any(context <= _known(written[h.entry.history_id]) for h in members)
            ]
            assert homes, f"batch {i}, row {row}: query and context come from no common task"
            if order == "contiguous":
                assert any(_is_slice(batch.context_obs[row], written[h.entry.history_id]["state"]) for h in dataset)
            ends += _crosses(batch, row)
    assert ends, "no context held an episode's last step: that case was not met"


def _labelled(arrays):
    return {(state.tobytes(), int(a)) for state, a in zip(arrays["state"], arrays["expert_actions"], strict=True)}


def _known(arrays):
    following = np.concatenate([arrays["state"][1:], arrays["state"][:1]])
    following[arrays["dones"]] = arrays["episode_end_state"]
    rows = zip(
        arrays["state"], following, arrays["actions"], arrays["teammate_actions"], arrays["rewards"], strict=True
    )
    return {(s.tobytes(), f.tobytes(), int(a), int(t), float(r)) for s, f, a, t, r in rows}


def _rows(batch, row):
    fields = (batch.context_obs, batch.context_next_obs, batch.context_actions, batch.context_teammate_actions)
    states, following, actions, mates = (field[row] for field in fields)
    rows = zip(states, following, actions, mates, batch.context_rewards[row], strict=True)
    return {(s.tobytes(), f.tobytes(), int(a), int(t), float(r)) for s, f, a, t, r in rows}


def _is_slice(window, states):
    return any(np.array_equal(window, states[k : k + len(window)]) for k in range(len(states) - len(window) + 1))


def _crosses(batch, row):
    return bool((batch.context_next_obs[row, :-1] != batch.context_obs[row, 1:]).any())


def test_dpt_fields_dtypes_and_shapes(lite):
    batch = load_icrl4aht(lite[0], layout="demo_wide").dpt(batch_size=4, context=30)[0]
    assert {name: (str(a.dtype), a.shape) for name, a in batch._asdict().items() if a is not None} == {
        "query_obs": ("float32", (4, 5, 5, 45)),
        "query_target": ("int32", (4,)),
        "context_obs": ("float32", (4, 30, 5, 5, 45)),
        "context_actions": ("int32", (4, 30)),
        "context_next_obs": ("float32", (4, 30, 5, 5, 45)),
        "context_rewards": ("float32", (4, 30)),
    }


@pytest.mark.parametrize("order", ["contiguous", "random"])
def test_what_follows_an_episodes_last_step_is_its_own_end(lite, order):
    root, written = lite
    history = load_icrl4aht(root, obs="state").select([2])
    batch = history.dpt(batch_size=3, context=120, order=order)[0]
    states, ends = written[2]["state"], written[2]["episode_end_state"]
    following = np.concatenate([states[1:], states[:1]])
    following[19::20] = ends
    if order == "contiguous":
        np.testing.assert_array_equal(batch.context_obs, np.stack([states] * 3))
        np.testing.assert_array_equal(batch.context_next_obs, np.stack([following] * 3))
    else:
        pairs = {(before.tobytes(), after.tobytes()) for before, after in zip(states, following, strict=True)}
        rows = zip(batch.context_obs.reshape(360, -1), batch.context_next_obs.reshape(360, -1), strict=True)
        assert {(before.tobytes(), after.tobytes()) for before, after in rows} <= pairs


def test_same_batches_in_two_processes_and_from_both_kinds(lite, full):
    code = "import sys, pathlib; from tests.helpers.batches import digest; print(digest(pathlib.Path(sys.argv[1])))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", code, str(lite[0])], capture_output=True, text=True, check=True, env=environment
    )
    assert run.stdout.strip() == digest(lite[0]) == digest(full[0])


def test_batches_depend_on_seed_and_number_alone(lite):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    one, two = dataset.ad(batch_size=8, length=20, seed=1), dataset.ad(batch_size=8, length=20, seed=2)
    assert two[5].obs.shape == two[0].obs.shape
    for i in (3, 0, 3):
        np.testing.assert_array_equal(one[i].obs, dataset.ad(batch_size=8, length=20, seed=1)[i].obs)
    assert (one.windows(0)[1] != one.windows(1)[1]).any()
    assert (one.windows(0)[1] != two.windows(0)[1]).any()


def test_the_draws_are_fixed_for_good(lite):
    """A stored batch number must mean the same batch in years: the windows of one seed, written down."""
    ids, starts = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=6, length=20, seed=0).windows(0)
    assert ids.tolist() == [6, 7, 6, 9, 9, 7]
    assert starts.tolist() == [95, 99, 25, 19, 71, 13]


def test_length_and_iteration(lite):
    sampler = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=4, length=30)
    assert len(sampler) == 720 // 120 == len(list(sampler))
    for bad in (-1, 0.7, 2**64):
        with pytest.raises(OptionError, match="batch = "):
            sampler[bad]  # type: ignore[index]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0, "length": 5}, "batch_size = 0"),
        ({"batch_size": 2, "length": 0}, "length = 0"),
        ({"batch_size": 2, "length": 5, "seed": -1}, "seed = -1"),
        ({"batch_size": 2, "length": 5, "seed": 0.5}, "seed = 0.5: expected a whole number"),
        ({"batch_size": 2, "length": 5, "seed": 2**64}, "below"),
        ({"batch_size": 2.0, "length": 5}, "batch_size = 2.0"),
        ({"batch_size": 2, "length": None}, "length = None"),
    ],
)
def test_impossible_options(lite, options, message):
    with pytest.raises(OptionError, match=message):
        load_icrl4aht(lite[0], layout="demo_wide").ad(**options)


def test_impossible_contexts(lite):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    with pytest.raises(OptionError, match="context = 121: the shortest history has 120 transitions"):
        dataset.dpt(batch_size=2, context=121)
    assert dataset.dpt(batch_size=2, context=121, order="random")[0].context_actions.shape == (2, 121)
    with pytest.raises(UnknownNameError, match=r"unknown order 'sorted'; valid: contiguous, random"):
        dataset.dpt(batch_size=2, context=5, order="sorted")  # type: ignore[arg-type]


def test_several_layouts_need_a_choice(lite):
    with pytest.raises(OptionError, match=r"spans layouts coord_simple, demo_wide.*layout='coord_simple'"):
        load_icrl4aht(lite[0]).ad(batch_size=2, length=5)


def test_a_one_step_episode_release_samples(tmp_path):
    random_release(tmp_path / "r", layouts=("cramped_up",), episodes=9, length=1)
    batch = load_icrl4aht(tmp_path / "r").dpt(batch_size=4, context=9)[0]
    assert batch.context_next_obs.shape == (4, 9, 5, 5, 35)
