"""Test that batches contain unchanged steps of the histories, and that the draws of a seed never change."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from icrl4aht_data import get_layout, load_icrl4aht
from icrl4aht_data.benchmark.facts import all_families
from icrl4aht_data.errors import MixedSplitsWarning, OptionError
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.sampling.draws import Curriculum, HistoryDraws
from tests.helpers.random_releases import random_release

LENGTH = 32


def shift_by_one_step(array):
    return np.concatenate([[0], array[:-1]])


def test_ad_windows_are_slices_of_histories(lite_or_full):
    root, written = lite_or_full
    dataset = load_icrl4aht(root, layout="demo_wide")
    sampler = dataset.ad(batch_size=64, length=LENGTH, seed=3, teammate_actions=True)
    at_the_start = 0
    for i in range(4):
        batch = sampler[i]
        for row, (history_id, start) in enumerate(zip(*sampler.windows(i), strict=True)):
            arrays, window = written[int(history_id)], slice(start, start + LENGTH)
            at_the_start += start == 0
            expected = {
                "target_actions": arrays["actions"],
                "dones": arrays["dones"],
                "prev_actions": shift_by_one_step(arrays["actions"]),
                "prev_rewards": shift_by_one_step(arrays["rewards"]),
                "prev_teammate_actions": shift_by_one_step(arrays["teammate_actions"]),
                "obs": dataset.history(int(history_id)).obs,
            }
            for name, array in expected.items():
                np.testing.assert_array_equal(getattr(batch, name)[row], array[window], err_msg=name)
            assert batch.is_first is not None
            np.testing.assert_array_equal(batch.is_first[row], np.arange(start, start + LENGTH) == 0)
        assert batch.attention_mask.all()
    assert at_the_start, "no window started at step 0, where zeros precede it"


def test_a_share_of_the_windows_begins_at_the_start_of_a_history(lite):
    """The other windows are drawn uniformly. Histories have 120 steps, so without the share few windows begin at 0."""
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    options: Any = {"batch_size": 4000, "length": 20}
    starts = {share: dataset.ad(at_start=share, **options).windows(0)[1] for share in (0.0, 0.5, 1.0)}
    np.testing.assert_array_equal(starts[0.0], dataset.ad(**options).windows(0)[1])
    for share, found in starts.items():
        assert found.max() == (0 if share == 1 else 100)
        others = found[found > 0]
        assert np.mean(found == 0) == pytest.approx(share + (1 - share) / 101, abs=0.03)
        assert share == 1 or others.mean() == pytest.approx(50.5, rel=0.05)
    assert dataset.ad(at_start=0.5, **options).options()["at_start"] == 0.5
    assert "at_start" not in dataset.ad(**options).options()


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
    assert batch.is_first is not None
    assert np.argwhere(batch.is_first).tolist() == [[0, 0], [1, 0], [2, 0]]


def test_batches_contain_teammate_families_on_request():
    dataset = load_icrl4aht(layout=["demo_wide", "cramped_up"], obs="state", channels="canonical", split="train")
    sampler = dataset.ad(batch_size=64, length=20, families=True)
    batch, ids = sampler[0], sampler.windows(0)[0]
    assert batch.families is not None and batch.families.dtype == np.int32
    found = [all_families()[number] for number in batch.families]
    assert found == [dataset.index.entry(int(history)).teammate_family for history in ids] and len(set(found)) > 1
    plain = dataset.ad(batch_size=64, length=20)
    assert plain[0].families is None and sampler.options() == {**plain.options(), "families": True}


@pytest.mark.parametrize("order", ["contiguous", "random"])
def test_dpt_batches_are_transitions_of_the_same_task(lite_or_full, order):
    root, written = lite_or_full
    dataset = load_icrl4aht(root, layout="demo_wide", obs="state")
    ids: dict[str, list[int]] = {}
    for entry in dataset.entries:
        ids.setdefault(entry.task_id, []).append(entry.history_id)
    queries = {k: set(_rows(written[k], "state", "expert_actions")) for k in dataset.ids.tolist()}
    known = {k: set(_transitions(written[k])) for k in dataset.ids.tolist()}
    sampler = dataset.dpt(batch_size=32, context=25, order=order, seed=1, teammate_actions=True)
    names = ("obs", "next_obs", "actions", "teammate_actions", "rewards")
    ends = 0
    for i in range(3):
        batch = sampler[i]
        for row in range(32):
            (query,) = _rows({"state": batch.query_obs[row, None], "action": batch.query_target[row, None]})
            context = {name: getattr(batch, f"context_{name}")[row] for name in names}
            tasks = [
                task
                for task, members in ids.items()
                if any(query in queries[k] for k in members) and any(set(_rows(context)) <= known[k] for k in members)
            ]
            assert tasks, f"batch {i}, row {row}: query and context come from no common task"
            if order == "contiguous":
                assert any(_is_slice(context["obs"], written[k]["state"]) for k in known)
            ends += (context["next_obs"][:-1] != context["obs"][1:]).any()
    assert ends, "no context has an episode's last step"


@pytest.mark.parametrize("order", ["contiguous", "random"])
def test_several_queries_of_a_context_are_steps_of_one_history(lite_or_full, order):
    root, written = lite_or_full
    dataset = load_icrl4aht(root, layout="demo_wide", obs="state")
    steps = {k: set(_rows(written[k], "state", "expert_actions")) for k in dataset.ids.tolist()}
    one, three = (dataset.dpt(batch_size=32, context=25, order=order, seed=1, queries=n) for n in (1, 3))
    batch, alone = three[2], one[2]
    assert batch.query_target.shape == (32, 3)
    assert batch.query_obs.shape == (32, 3, *alone.query_obs.shape[1:])
    for row in range(32):
        asked = set(_rows({"state": batch.query_obs[row], "action": batch.query_target[row]}))
        assert any(asked <= known for known in steps.values()), f"row {row}"
    assert (batch.query_obs[:, 0] != batch.query_obs[:, 1]).any(), "the queries are the same"
    np.testing.assert_array_equal(batch.query_obs[:, 0], alone.query_obs)
    np.testing.assert_array_equal(batch.context_obs, alone.context_obs)
    rendered = load_icrl4aht(root, layout="demo_wide").dpt(batch_size=32, context=25, order=order, seed=1, queries=3)[2]
    plain = load_icrl4aht(root, layout="demo_wide").dpt(batch_size=32, context=25, order=order, seed=1)[2]
    np.testing.assert_array_equal(rendered.query_obs[:, 0], plain.query_obs)


def _rows(arrays, *names):
    """Return a list of hashable tuples, each with the values of one step."""
    columns = [np.asarray(arrays[name]) for name in names or arrays]
    return [tuple(x.tobytes() if x.ndim else float(x) for x in row) for row in zip(*columns, strict=True)]


def _transitions(arrays):
    """Return a list of hashable tuples, each with the values of one step and the state after the step."""
    following = np.roll(arrays["state"], -1, axis=0)
    following[arrays["dones"]] = arrays["episode_end_state"]
    return _rows(arrays | {"following": following}, "state", "following", "actions", "teammate_actions", "rewards")


def _is_slice(window, states):
    return any(np.array_equal(window, states[k : k + len(window)]) for k in range(len(states) - len(window) + 1))


@pytest.mark.parametrize("obs", ["float32", "uint8", "state"])
def test_batch_fields_have_the_specified_dtypes_and_shapes(lite, obs):
    dataset = load_icrl4aht(lite[0], layout="demo_wide", obs=obs)
    shape = (record_size(get_layout("demo_wide")),) if obs == "state" else (5, 5, 45)
    dtypes = {
        "rewards": "float32",
        "dones": "bool",
        "mask": "bool",
        "first": "bool",
        "obs": "uint8" if obs == "state" else obs,
    }
    for sampler in (dataset.ad(batch_size=4, length=30), dataset.dpt(batch_size=4, context=30)):
        batch = sampler[0]
        found = {name: (str(a.dtype), a.shape) for name, a in batch._asdict().items() if a is not None}
        expected = {}
        for name in found:
            steps = (4,) if name.startswith("query") else (4, 30)
            kind = name.split("_")[-1]
            integer = "int64" if "target" in name else "int32"
            expected[name] = dtypes.get(kind, integer), (*steps, *shape) if kind == "obs" else steps
        assert found == expected == sampler.specs
        assert batch.describe().splitlines()[0].split()[:2] == [next(iter(found)), dtypes["obs"]]


def test_windows_of_a_seed_never_change(lite):
    """Saved batch numbers must stay valid in later versions, so the windows of a seed are fixed."""
    ids, starts = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=6, length=20, seed=0).windows(0)
    assert ids.tolist() == [6, 7, 6, 9, 9, 7]
    assert starts.tolist() == [95, 99, 25, 19, 71, 13]


def test_sampler_length_is_the_number_of_iterated_batches(lite):
    sampler = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=4, length=30)
    assert len(sampler) == 720 // 120 == len(list(sampler))


def test_a_random_context_may_be_longer_than_a_history(lite):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    assert dataset.dpt(batch_size=2, context=121, order="random")[0].context_actions.shape == (2, 121)


def test_contexts_can_be_sampled_from_episodes_of_one_step(tmp_path):
    random_release(tmp_path / "r", layouts=("cramped_up",), episodes=9, length=1)
    batch = load_icrl4aht(tmp_path / "r").dpt(batch_size=4, context=9)[0]
    assert batch.context_next_obs.shape == (4, 9, 5, 5, 35)


def test_dpt_context_fits_into_every_part_of_a_curriculum(two_sources):
    """Half of 6 episodes touches 4 episodes at the first and the last batch, but 3 at batch 2."""
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", split="train")
    curriculum = Curriculum(9, (0.1, 0.6), (0.4, 0.9))
    ranges = [HistoryDraws(dataset, "uniform", None, curriculum).steps(i) for i in (0, 2, 9)]
    episodes = dataset.info.environment.kept_steps
    assert [{*((high - low) // episodes).tolist()} for low, high in ranges] == [{4}, {3}, {4}]
    with pytest.raises(OptionError, match=f"the shortest history has {3 * episodes} transitions"):
        dataset.dpt(batch_size=8, context=3 * episodes + 1, curriculum=curriculum)
    sampler = dataset.dpt(batch_size=8, context=3 * episodes, curriculum=curriculum)
    for i in range(10):
        low, high = HistoryDraws(dataset, "uniform", None, curriculum).steps(i)
        _, _, context, steps = sampler._draw(i)
        assert (steps >= low[context][:, None]).all() and (steps < high[context][:, None]).all()
    constant = Curriculum(9, (0.1, 0.6), (0.1, 0.6))
    dataset.dpt(batch_size=8, context=4 * episodes, curriculum=constant)  # no batch has fewer than 4 episodes


def test_dpt_draws_no_history_of_weight_zero(two_sources):
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", split="train")
    tasks = dataset.column_codes("task_id")
    weights = (tasks != tasks[-1]).astype(float)
    sampler = dataset.dpt(batch_size=64, context=9, weights=weights)
    drawn = np.unique(np.concatenate([part for i in range(8) for part in sampler._draw(i)[::2]]))
    assert drawn.tolist() == np.flatnonzero(weights).tolist()


def test_batch_larger_than_free_memory_is_refused(lite):
    """Regression: batches larger than free memory raised NumPy's MemoryError or killed the process."""
    dataset, size = load_icrl4aht(lite[0], layout="demo_wide"), 10**13
    message = rf"batch_size = {size}, (length|context) = 100: .*: takes [\d,]+ GB of memory, more than is free: read"
    for sampler in (dataset.ad(batch_size=size, length=100), dataset.dpt(batch_size=size, context=100)):
        for make in (lambda s=sampler: s[0], sampler.empty, lambda s=sampler: next(s.batches(prefetch=0))):
            with pytest.raises(OptionError, match=message):
                make()


def test_mixed_splits_cause_a_warning(two_sources):
    """A selection without a split filter contains training and validation histories."""
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide")
    with pytest.warns(
        MixedSplitsWarning, match=r"several splits, train \(14\), validation \(6\): .*split=\"train\""
    ) as seen:
        dataset.ad(batch_size=2, length=5)
    assert seen[0].filename == __file__
    with pytest.warns(MixedSplitsWarning) as seen:
        dataset.dpt(batch_size=2, context=5)
    assert seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error", MixedSplitsWarning)
        for split in ("train", "validation"):
            dataset.filter(split=split).ad(batch_size=2, length=5)
