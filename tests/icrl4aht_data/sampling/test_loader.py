"""Test that all caches give equal batches, and test sampler options and buffers."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from icrl4aht_data import Curriculum, load_icrl4aht
from icrl4aht_data.errors import UnknownNameError
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.reading.sources import choose_cache
from icrl4aht_data.writing.convert import to_release
from tests.helpers.batches import CACHES, assert_equal_batches, example_samplers
from tests.helpers.random_releases import random_release

LAYOUTS = ("coord_simple", "demo_simple", "coord_ring")
"""Layouts with observations of one shape and state records of several sizes."""


@pytest.fixture(scope="module")
def three_layout_releases(tmp_path_factory):
    """Return a folder with a release on three layouts and a copy without states, and the arrays of all histories."""
    root = tmp_path_factory.mktemp("three")
    written = random_release(root / "states", layouts=LAYOUTS, teammates=1)
    to_release(load_icrl4aht(root / "states"), root / "observations", "observations")
    return root, written


class TestCaches:
    @pytest.mark.parametrize("obs", ["float32", "uint8", "state"])
    def test_all_caches_give_equal_batches(self, lite, full, reconverted_release, obs):
        for kinds in ((lite[0], full[0]), (reconverted_release,)[obs == "state" :]):
            all_samplers = (
                example_samplers(load_icrl4aht(root, layout="demo_wide", obs=obs, cache=cache, threads=threads), seed=4)
                for cache in CACHES
                for root in kinds
                for threads in (1, 3)
            )
            for sampler, *others in zip(*all_samplers, strict=True):
                for i in (0, 77):
                    for other in others:
                        assert_equal_batches(sampler[i], other[i])
                assert_equal_batches(pickle.loads(pickle.dumps(others[-1]))[5], sampler[5])

    def test_histories_may_be_reordered_and_repeated(self, lite):
        mixed = load_icrl4aht(lite[0], layout="demo_wide", obs="state").select([9, 6, 9, 11])
        sampler = mixed.ad(batch_size=9, length=20)
        for cache in CACHES:
            assert_equal_batches(mixed.with_options(cache=cache).ad(batch_size=9, length=20)[0], sampler[0])
        batch, (ids, starts) = sampler[0], sampler.windows(0)
        for row, (history_id, start) in enumerate(zip(ids, starts, strict=True)):
            np.testing.assert_array_equal(batch.obs[row], lite[1][history_id]["state"][start : start + 20])

    def test_auto_cache_depends_on_size_and_free_memory(self, lite, monkeypatch):
        dataset = load_icrl4aht(lite[0])
        assert dataset.cache.cache == "ram"
        assert "GB decoded" in dataset.cache.reason
        monkeypatch.setattr("icrl4aht_data.reading.sources.free_memory", lambda: 10**9)
        monkeypatch.setattr("icrl4aht_data.reading.sources.cacheable_bytes", lambda: 10**10)
        assert [choose_cache("auto", size).cache for size in (10**8, 10**9, 10**11)] == ["ram", "mmap", "stream"]
        assert choose_cache("stream", 1).cache == "stream"
        with pytest.raises(UnknownNameError, match="unknown cache 'disk'; valid: auto, ram, mmap, stream"):
            load_icrl4aht(lite[0], cache="disk")  # type: ignore[arg-type]

    def test_threads_can_share_a_sampler(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", cache="stream", threads=2).ad(batch_size=9, length=30)
        with ThreadPoolExecutor(12) as pool:
            for k, batch in enumerate(pool.map(lambda k: sampler[k % 4], range(12))):
                assert_equal_batches(batch, sampler[k % 4])


@pytest.mark.parametrize("cache", CACHES)
class TestSeveralLayouts:
    def test_windows_of_several_layouts_equal_the_histories(self, three_layout_releases, cache):
        root, written = three_layout_releases
        shown, states = (
            load_icrl4aht(root / "states", obs=obs, cache=cache).ad(batch_size=32, length=130)
            for obs in ("uint8", "state")
        )
        batch, raw, (ids, _) = shown[0], states[0], shown.windows(0)
        assert batch.layouts is None
        assert raw.layouts is not None
        assert [layout.name for layout in states.layouts] == list(LAYOUTS)
        assert len(set(raw.layouts.tolist())) == 3
        for row, history_id in enumerate(ids):
            state, layout = written[history_id]["state"], states.layouts[raw.layouts[row]]
            assert layout.name == states.dataset.index.entry(history_id).layout
            np.testing.assert_array_equal(raw.obs[row, :120, : state.shape[1]], state)
            assert not raw.obs[row, :, state.shape[1] :].any()
            np.testing.assert_array_equal(batch.obs[row, :120], observe(layout, state, 0))
            np.testing.assert_array_equal(batch.target_actions[row, :120], written[history_id]["actions"])
            assert not batch.obs[row, 120:].any()

    @pytest.mark.parametrize("obs", ["float32", "uint8"])
    def test_releases_with_and_without_states_give_equal_batches(self, three_layout_releases, cache, obs):
        one, two = (
            load_icrl4aht(three_layout_releases[0] / name, obs=obs, cache=cache) for name in ("states", "observations")
        )
        assert_equal_batches(one.ad(batch_size=16, length=130)[0], two.ad(batch_size=16, length=130)[0])
        batch = two.dpt(batch_size=16, context=30)[0]
        assert batch.layouts is None
        assert batch.query_obs.any(axis=(1, 2, 3)).all()


class TestOptions:
    @pytest.mark.parametrize(
        ("episodes", "low", "high"),
        [((0, 2), 0, 40), ((-3, None), 60, 120), ((2, 4), 40, 80), ((None, -5), 0, 20)],
    )
    def test_sampled_steps_stay_in_the_episode_range(self, lite, episodes, low, high):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="state")  # each history has 6 episodes of 20 steps
        _, starts = dataset.ad(batch_size=200, length=15, episodes=episodes).windows(0)
        assert (starts.min(), starts.max()) == (low, high - 15)
        _, step, _, steps = dataset.dpt(batch_size=50, context=15, order="random", episodes=episodes)._draw(0)
        assert low <= step.min() and step.max() < high
        assert (steps.min(), steps.max()) == (low, high - 1)

    def test_windows_longer_than_the_episode_range_are_padded(self, lite):
        root, written = lite
        for cache in CACHES:
            dataset = load_icrl4aht(root, layout="demo_wide", obs="state", cache=cache)
            sampler = dataset.ad(batch_size=4, length=50, episodes=(2, 4))
            batch, (ids, starts) = sampler[0], sampler.windows(0)
            assert (starts == 40).all()
            assert (batch.attention_mask == (np.arange(50) < 40)).all()
            for row, history_id in enumerate(ids):
                np.testing.assert_array_equal(batch.obs[row, :40], written[history_id]["state"][40:80])
                np.testing.assert_array_equal(batch.prev_actions[row, :40], written[history_id]["actions"][39:79])
            assert not batch.obs[:, 40:].any()
            assert not batch.target_actions[:, 40:].any()

    def test_curriculum_moves_through_the_history(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide")
        plan = Curriculum(batches=10, first=(0.0, 0.5), last=(0.5, 1.0))
        sampler = dataset.ad(batch_size=300, length=10, curriculum=plan)
        spans = [(s.min(), s.max()) for s in (sampler.windows(i)[1] for i in (0, 5, 10, 99))]
        assert spans == [(0, 50), (20, 90), (60, 110), (60, 110)]
        late = dataset.ad(batch_size=300, length=10, curriculum=plan, episodes=(0, 2)).windows(99)[1]
        assert (late.min(), late.max()) == (20, 30)

    def test_histories_are_sampled_in_proportion_to_weights(self, tmp_path):
        random_release(tmp_path / "a", layouts=("cramped_up",), teammates=1, streams=4)
        dataset = load_icrl4aht(tmp_path / "a", obs="state")
        counts = np.bincount(dataset.ad(batch_size=4000, length=9, weights=[0, 1, 3, 0]).windows(0)[0], minlength=4)
        assert counts[[0, 3]].sum() == 0
        assert abs(counts[2] / counts[1] - 3) < 0.4
        query, _, context, _ = dataset.dpt(batch_size=400, context=9, weights=[0, 0, 0, 2.5])._draw(0)
        assert set(query) == set(context) == {3}
        uniform = dataset.ad(batch_size=400, length=9, weights="length").windows(0)[0]
        assert np.bincount(uniform).min() > 60  # histories of equal length have equal probability

    def test_very_large_weights_are_sampled_in_proportion(self, lite):
        """Regression: sums of large weights overflowed, so all windows came from one history."""
        dataset = load_icrl4aht(lite[0], layout="demo_wide")
        weights = np.array([1.0, 2.0, 0.0, 1.0, 1.0, 0.5])
        expected = dataset.ad(batch_size=200, length=9, weights=weights).windows(3)[0]
        assert len(set(expected.tolist())) == 5
        for factor in (2.0**1021, 2.0**-1060):
            found = dataset.ad(batch_size=200, length=9, weights=weights * factor).windows(3)[0]
            np.testing.assert_array_equal(found, expected)
        query, _, context, _ = dataset.dpt(batch_size=100, context=9, weights=[1e308] * 6)._draw(0)
        assert len(set(query.tolist())) == len(set(context.tolist())) == 6

    def test_batch_shares_of_all_processes_concatenate_to_the_full_batch(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8")
        shares = (example_samplers(dataset, process_index=k, process_count=3) for k in range(3))
        for undivided, *parts in zip(example_samplers(dataset), *shares, strict=True):
            batches = [part[5] for part in parts]
            for name, array in undivided[5]._asdict().items():
                if array is not None:
                    np.testing.assert_array_equal(np.concatenate([getattr(batch, name) for batch in batches]), array)

    def test_windows_are_uniform_over_histories_and_starts(self, lite):
        """Pearson's chi-squared statistic of 60,000 draws must be within five standard deviations of its mean."""
        sampler = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=500, length=20, seed=11)
        cells = np.zeros((6, 101))
        for i in range(120):
            ids, starts = sampler.windows(i)
            np.add.at(cells, (ids - 6, starts), 1)
        for counts in (cells, cells.sum(axis=0), cells.sum(axis=1)):
            expected, freedom = 60_000 / counts.size, counts.size - 1
            statistic = ((counts - expected) ** 2 / expected).sum()
            assert abs(statistic - freedom) < 5 * np.sqrt(2 * freedom), (counts.shape, statistic)


def test_batch_is_written_into_the_given_buffers(lite, reconverted_release):
    for root in (lite[0], reconverted_release):
        for sampler in example_samplers(load_icrl4aht(root, layout="demo_wide", obs="uint8")):
            out = sampler.empty()
            for array in out:
                if array is not None:
                    array.fill(1)
            assert sampler.batch(3, out) is out
            assert_equal_batches(out, sampler[3])
