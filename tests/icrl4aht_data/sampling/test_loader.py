"""Holding data, sampler options, prefetch: the same batches however they are made."""

from __future__ import annotations

import gc
import json
import os
import pickle
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from icrl4aht_data import Curriculum, load_icrl4aht
from icrl4aht_data.errors import OptionError, ShardCorruptError, UnknownNameError
from icrl4aht_data.format.chunks import chunk_table_path
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.reading.sources import choose_cache
from icrl4aht_data.utils.threads import in_slices
from tests.helpers.batches import CACHES, assert_equal, samplers
from tests.helpers.random_play import SHARD, random_release


class TestHolding:
    @pytest.mark.parametrize("obs", ["float32", "uint8", "state"])
    def test_the_same_batches_from_each(self, lite, full, obs):
        expected, *others = (
            samplers(load_icrl4aht(root, layout="demo_wide", obs=obs, cache=cache, threads=threads), seed=4)
            for cache in CACHES
            for root, threads in ((lite[0], 1), (lite[0], 3), (full[0], 2))
        )
        for sampler, *same in zip(expected, *others, strict=True):
            for i in (0, 1, 77):
                for other in same:
                    assert_equal(sampler[i], other[i])

    def test_shown_states_are_the_observations(self, lite):
        states = samplers(load_icrl4aht(lite[0], layout="demo_wide", obs="state"))
        shown = samplers(load_icrl4aht(lite[0], layout="demo_wide", obs="uint8"))
        layout = states[0].layouts[0]
        for one, two in zip(states, shown, strict=True):
            for name in ("obs", "query_obs", "context_obs", "context_next_obs"):
                if name in one[0]._fields:
                    rendered = observe(layout, getattr(one[0], name), 0)
                    if name == "obs":
                        rendered[~one[0].attention_mask] = 0
                    np.testing.assert_array_equal(getattr(two[0], name), rendered)

    def test_parts_in_any_order(self, lite):
        whole = load_icrl4aht(lite[0], layout="demo_wide", obs="state")
        mixed = whole.select([9, 6, 9, 11])
        sampler = mixed.ad(batch_size=9, length=20)
        for cache in CACHES:
            part = load_icrl4aht(lite[0], obs="state", cache=cache).select([9, 6, 9, 11])
            assert_equal(part.ad(batch_size=9, length=20)[0], sampler[0])
        batch, (ids, starts) = sampler[0], sampler.windows(0)
        for row, (history_id, start) in enumerate(zip(ids, starts, strict=True)):
            np.testing.assert_array_equal(batch.obs[row], lite[1][history_id]["state"][start : start + 20])

    def test_automatic_choice_by_size_and_room(self, lite, monkeypatch):
        dataset = load_icrl4aht(lite[0])
        assert dataset.cache.cache == "ram"
        assert "GB decoded" in dataset.cache.reason
        monkeypatch.setattr("icrl4aht_data.reading.sources.free_memory", lambda: 10**9)
        monkeypatch.setattr("icrl4aht_data.reading.sources.cache_room", lambda: 10**10)
        assert [choose_cache("auto", size).cache for size in (10**8, 10**9, 10**11)] == ["ram", "mmap", "stream"]
        assert choose_cache("stream", 1).cache == "stream"
        with pytest.raises(UnknownNameError, match="unknown cache 'disk'; valid: auto, ram, mmap, stream"):
            load_icrl4aht(lite[0], cache="disk")  # type: ignore[arg-type]

    def test_mapped_arrays_are_shared_and_made_once(self, lite, tmp_path, monkeypatch):
        monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path))
        first = load_icrl4aht(lite[0], layout="demo_wide", cache="mmap").ad(batch_size=2, length=9)[0]
        (made,) = (path for path in tmp_path.iterdir() if path.name.startswith("histories-"))
        stamps = {path.name: path.stat().st_mtime_ns for path in made.iterdir()}
        assert set(stamps) == {f"{name}.npy" for name in lite[1][0]}
        assert_equal(load_icrl4aht(lite[0], layout="demo_wide", cache="mmap").ad(batch_size=2, length=9)[0], first)
        assert {path.name: path.stat().st_mtime_ns for path in made.iterdir()} == stamps

    @pytest.mark.parametrize("cache", CACHES)
    def test_damage_is_named_not_sampled(self, damaged, cache, tmp_path, monkeypatch):
        monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))  # without what the whole release left
        data = bytearray((damaged / SHARD).read_bytes())
        data[int(np.load(chunk_table_path(damaged, SHARD))["offset"][0])] ^= 1
        (damaged / SHARD).write_bytes(data)
        sampler = load_icrl4aht(damaged, layout="coord_simple", cache=cache).ad(batch_size=64, length=9)
        with pytest.raises(ShardCorruptError, match="chunk 0 of state in history 0"):
            sampler[0]

    def test_a_dataset_with_arrays_travels_by_pickle(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", cache="ram")
        sampler = dataset.ad(batch_size=3, length=9)
        first, sent = sampler[0], pickle.dumps(sampler)
        assert len(sent) < 100_000
        assert_equal(pickle.loads(sent)[0], first)

    def test_threads_share_a_sampler(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", cache="stream", threads=2).ad(batch_size=9, length=30)
        found = {}
        workers = [threading.Thread(target=lambda k=k: found.update({k: sampler[k % 4]})) for k in range(12)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        for k, batch in found.items():
            assert_equal(batch, sampler[k % 4])

    def test_an_error_in_a_slice_reaches_the_caller(self):
        def work(start: int, stop: int) -> None:
            if stop == 10:
                raise OptionError("the last slice")

        with pytest.raises(OptionError, match="the last slice"):
            in_slices(work, 10, 4)


class TestOptions:
    def test_windows_stay_inside_an_episode_range(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="state")  # 6 episodes of 20 steps
        for episodes, low, high in (((0, 2), 0, 40), ((-3, None), 60, 120), ((2, 4), 40, 80), ((None, -5), 0, 20)):
            sampler = dataset.ad(batch_size=200, length=15, episodes=episodes)
            _, starts = sampler.windows(0)
            assert (starts.min(), starts.max()) == (low, high - 15)
            contexts = dataset.dpt(batch_size=50, context=15, order="random", episodes=episodes)
            _, step, _, steps = contexts._draw(0)
            assert step.min() >= low
            assert step.max() < high
            assert (steps.min(), steps.max()) == (low, high - 1)
        with pytest.raises(OptionError, match=r"episodes = \(6, 9\): a history of 6 episodes has none"):
            dataset.ad(batch_size=1, length=5, episodes=(6, 9))
        with pytest.raises(OptionError, match="the shortest history has 20 transitions"):
            dataset.dpt(batch_size=1, context=21, episodes=(0, 1))

    def test_a_range_shorter_than_the_window_is_padded(self, lite):
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
        with pytest.raises(OptionError, match="expected fractions"):
            Curriculum(batches=10, first=(0.5, 0.5))

    def test_weights(self, tmp_path):
        random_release(tmp_path / "a", layouts=("cramped_up",), teammates=1, streams=4)
        dataset = load_icrl4aht(tmp_path / "a", obs="state")
        counts = np.bincount(dataset.ad(batch_size=4000, length=9, weights=[0, 1, 3, 0]).windows(0)[0], minlength=4)
        assert counts[[0, 3]].sum() == 0
        assert abs(counts[2] / counts[1] - 3) < 0.4
        asking = dataset.dpt(batch_size=400, context=9, weights=[0, 0, 0, 2.5])._draw(0)[0]
        assert set(asking) == {3}
        uniform = dataset.ad(batch_size=400, length=9, weights="length").windows(0)[0]
        assert np.bincount(uniform).min() > 60  # equal lengths: as likely each
        for wrong in ([1, 2], [0, 0, 0, 0], [1, -1, 1, 1], ["a"] * 4, [1, 1, 1, np.nan]):
            with pytest.raises(OptionError, match="weights: expected"):
                dataset.ad(batch_size=4, length=9, weights=wrong)  # type: ignore[arg-type]
        with pytest.raises(UnknownNameError, match="unknown weights 'score'; valid: uniform, length"):
            dataset.ad(batch_size=4, length=9, weights="score")  # type: ignore[arg-type]

    def test_processes_share_a_batch(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8")
        for whole, *parts in zip(
            samplers(dataset), *(samplers(dataset, process_index=k, process_count=3) for k in range(3)), strict=True
        ):
            shares = [part[5] for part in parts]
            for name, array in whole[5]._asdict().items():
                if array is not None:
                    np.testing.assert_array_equal(np.concatenate([getattr(share, name) for share in shares]), array)
        for index, count in ((0, 4), (3, 3), (-1, 1)):
            with pytest.raises(OptionError, match="process_index"):
                dataset.ad(batch_size=6, length=5, process_index=index, process_count=count)

    @pytest.mark.parametrize("cache", CACHES)
    def test_several_layouts_of_one_shape(self, tmp_path, cache):
        names = ("coord_simple", "demo_simple", "coord_ring")
        written = random_release(tmp_path / "r", layouts=names, teammates=1)
        shown, states = (load_icrl4aht(tmp_path / "r", obs=obs, cache=cache) for obs in ("uint8", "state"))
        batch, raw = shown.ad(batch_size=32, length=130)[0], states.ad(batch_size=32, length=130)[0]
        ids, _ = shown.ad(batch_size=32, length=130).windows(0)
        assert batch.layouts is None
        assert raw.layouts is not None
        sampler = states.ad(batch_size=32, length=130)
        assert [layout.name for layout in sampler.layouts] == list(names)
        for row, history_id in enumerate(ids):
            state, layout = written[history_id]["state"], sampler.layouts[raw.layouts[row]]
            assert layout.name == states.index.entry(history_id).layout
            np.testing.assert_array_equal(raw.obs[row, :120, : state.shape[1]], state)
            assert not raw.obs[row, :, state.shape[1] :].any()
            np.testing.assert_array_equal(batch.obs[row, :120], observe(layout, state, 0))
            np.testing.assert_array_equal(batch.target_actions[row, :120], written[history_id]["actions"])
            assert not batch.obs[row, 120:].any()
        assert len(set(raw.layouts.tolist())) == 3
        for order in ("contiguous", "random"):
            query = shown.dpt(batch_size=16, context=30, order=order)[0]
            coded = states.dpt(batch_size=16, context=30, order=order)[0]
            assert coded.layouts is not None
            for row in range(16):
                layout = sampler.layouts[coded.layouts[row]]
                size = written[3 * sampler.layouts.index(layout)]["state"].shape[1]
                for name in ("query_obs", "context_obs", "context_next_obs"):
                    record = getattr(coded, name)[row][..., :size]
                    np.testing.assert_array_equal(getattr(query, name)[row], observe(layout, record, 0))

    def test_windows_are_uniform_over_histories_and_starts(self, lite):
        """Pearson's statistic of 60,000 draws into 6 x 101 cells, and of histories and of starts alone: its mean is one
        less than the cells, its variance twice that."""
        sampler = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=500, length=20, seed=11)
        table = np.zeros((6, 101))
        for i in range(120):
            ids, starts = sampler.windows(i)
            np.add.at(table, (ids - 6, starts), 1)
        for counts in (table, table.sum(axis=0), table.sum(axis=1)):
            expected, freedom = 60_000 / counts.size, counts.size - 1
            statistic = ((counts - expected) ** 2 / expected).sum()
            assert abs(statistic - freedom) < 5 * np.sqrt(2 * freedom), (counts.shape, statistic)


class TestBuffers:
    def test_a_batch_is_written_where_asked(self, lite):
        for sampler in samplers(load_icrl4aht(lite[0], layout="demo_wide", obs="uint8")):
            out = sampler.empty()
            for array in out:
                if array is not None:
                    array.fill(1)
            assert sampler.batch(3, out) is out
            assert_equal(out, sampler[3])

    def test_another_buffer_is_refused(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8")
        one, two = dataset.ad(batch_size=2, length=5), dataset.ad(batch_size=2, length=6)
        with pytest.raises(OptionError, match=r"out: expected and found .*obs.*\(2, 5, 5, 5, 45\).*\(2, 6, 5, 5, 45\)"):
            one.batch(0, two.empty())
        sliced = one.empty()._replace(dones=np.empty((5, 2), bool).T)
        with pytest.raises(OptionError, match="C-contiguous"):
            one.batch(0, sliced)

    @pytest.mark.parametrize("cache", CACHES)
    def test_memory_stays_flat(self, lite, cache):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8", cache=cache).ad(batch_size=16, length=100)
        with sampler.batches(stop=600) as batches:
            for _ in range(200):
                next(batches)
            early = resident()
            for _ in batches:
                pass
        assert batches.served == 600
        assert resident() - early < 16 * 2**20


def resident() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def aligned(array):
    """The like at an address that JAX would take over instead of copying from it."""
    if array is None:
        return None
    memory = np.empty(array.nbytes + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)


class TestPrefetch:
    @pytest.mark.parametrize("prefetch", [0, 1, 3])
    @pytest.mark.parametrize("reuse", [False, True])
    def test_batches_in_order(self, lite, prefetch, reuse):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8").ad(batch_size=3, length=9)
        numbers = iter(range(4, 12))
        with sampler.batches(4, 12, prefetch=prefetch, reuse=reuse) as batches:
            for batch in batches:
                assert_equal(batch, sampler[next(numbers)])
        assert (batches.served, batches.next) == (8, 12)
        assert 0 < batches.waited < 60
        assert next(numbers, None) is None
        assert next(batches, None) is None

    def test_batches_are_kept_unless_reuse_is_asked(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8").ad(batch_size=3, length=9)
        for i, batch in enumerate(list(sampler.batches(stop=6))):
            assert_equal(batch, sampler[i])

    def test_reused_buffers_are_few(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8").ad(batch_size=3, length=9)
        assert len({id(batch.obs) for batch in sampler.batches(stop=20, prefetch=2, reuse=True)}) <= 4

    def test_on_a_device(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="state").ad(batch_size=3, length=9)
        empty = sampler.empty
        sampler.empty = lambda: type(empty())(*(aligned(array) for array in empty()))  # type: ignore[method-assign]
        batches = list(sampler.batches(stop=5, device=jax.devices()[0]))
        for i, batch in enumerate(batches):
            assert isinstance(batch.obs, jax.Array)
            assert batch.prev_teammate_actions is None
            assert_equal(jax.tree.map(np.asarray, batch), sampler[i])

    def test_at_most_that_many_wait(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="state").ad(batch_size=3, length=9)
        made = []
        plain = sampler.batch
        sampler.batch = lambda i, out=None: made.append(i) or plain(i, out)  # type: ignore[method-assign]
        with sampler.batches(prefetch=2) as batches:
            next(batches)
            time.sleep(0.3)
            assert len(made) <= 4  # one taken, two waiting, one in hand

    def test_an_exception_reaches_the_consumer(self, damaged):
        (damaged / SHARD).write_bytes((damaged / SHARD).read_bytes()[:3000])
        sampler = load_icrl4aht(damaged, layout="coord_simple").ad(batch_size=8, length=9)
        for prefetch in (0, 2):
            batches = sampler.batches(prefetch=prefetch)
            with pytest.raises(Exception, match="truncated"):
                next(batches)
            assert next(batches, None) is None

    def test_closing_ends_the_thread(self, lite):
        sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="state").ad(batch_size=3, length=9)

        def workers() -> int:
            return sum(thread.name.startswith("icrl4aht-prefetch") for thread in threading.enumerate())

        with sampler.batches(prefetch=1) as batches:
            next(batches)
            assert workers() == 1
        assert workers() == 0
        abandoned = sampler.batches(prefetch=1)
        next(abandoned)
        del abandoned
        gc.collect()
        assert workers() == 0

    def test_resuming_goes_on_exactly(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8")
        sampler = dataset.ad(batch_size=3, length=9, seed=3)
        batches = sampler.batches()
        for _ in range(4):
            next(batches)  # more are made ahead: what was not consumed is made again
        state = json.loads(json.dumps(batches.state_dict()))
        batches.close()
        again = dataset.ad(batch_size=3, length=9, seed=3).batches()
        next(again)
        again.load_state_dict(state)
        assert_equal(next(again), sampler[4])
        again.close()
        other = dataset.ad(batch_size=3, length=9, seed=4).batches()
        with pytest.raises(OptionError, match="of other batches: it has seed = 3, not 4"):
            other.load_state_dict(state)
        with pytest.raises(OptionError, match="selection"):
            dataset[1:].ad(batch_size=3, length=9, seed=3).batches().load_state_dict(state)
