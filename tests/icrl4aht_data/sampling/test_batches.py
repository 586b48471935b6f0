"""Test prefetched batches: order, buffers, devices, errors and resuming."""

from __future__ import annotations

import gc
import json
import os
import pickle
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError
from tests.helpers.batches import CACHES, assert_equal_batches
from tests.helpers.random_releases import SHARD


@pytest.fixture
def sampler(lite):
    return load_icrl4aht(lite[0], layout="demo_wide", obs="uint8").ad(batch_size=3, length=9, seed=3)


@pytest.mark.parametrize("prefetch", [0, 1, 3])
@pytest.mark.parametrize("reuse", [False, True])
def test_prefetched_batches_keep_their_order(sampler, prefetch, reuse):
    numbers, buffers = iter(range(4, 24)), set()
    with sampler.batches(4, 24, prefetch=prefetch, reuse=reuse) as batches:
        for batch in batches:
            assert_equal_batches(batch, sampler[next(numbers)])
            buffers.add(batch.obs.ctypes.data)
    assert not reuse or len(buffers) <= prefetch + 1
    assert (batches.served, batches.next) == (20, 24)
    assert 0 < batches.waited < 60
    assert next(numbers, None) is None
    assert next(batches, None) is None


@pytest.mark.parametrize("prefetch", [0, 2])
def test_second_loop_over_batches_continues_after_the_first(sampler, prefetch):
    batches = sampler.batches(2, 5, prefetch=prefetch)
    for numbers in ([2, 3, 4], [5, 6, 7]):
        assert [batches.next - 1 for _ in batches] == numbers
        assert next(batches, None) is None
    batches.load_state_dict({"next": 6, **sampler.options()})
    assert [batches.next - 1 for _ in batches] == [6, 7]
    batches.close()
    assert list(batches) == list(sampler.batches(3, 3)) == []
    finished = sampler.batches(0, 4)
    finished.load_state_dict({"next": 4, **sampler.options()})
    assert list(finished) == []
    again = sampler.batches(stop=2)
    assert_equal_batches([*again, *again][3], sampler[3])


def _aligned_empty(array):
    """Return an empty array like `array`, aligned so that JAX would alias its memory instead of copying it."""
    if array is None:
        return None
    memory = np.empty(array.nbytes + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)


def test_batches_on_a_device_equal_the_batches_of_the_sampler(sampler, monkeypatch):
    empty = sampler.empty
    monkeypatch.setattr(sampler, "empty", lambda: type(empty())(*map(_aligned_empty, empty())))
    batches = list(sampler.batches(stop=5, device=jax.devices()[0]))
    for i, batch in enumerate(batches):
        assert isinstance(batch.obs, jax.Array)
        assert batch.prev_teammate_actions is None
        in_32_bits = jax.tree.map(lambda array: np.asarray(jax.numpy.asarray(array)), sampler[i])
        assert_equal_batches(jax.tree.map(np.asarray, batch), in_32_bits)


def test_prefetching_stops_after_the_given_number_of_batches(sampler, monkeypatch):
    made, plain = [], sampler.batch
    monkeypatch.setattr(sampler, "batch", lambda i, out=None: made.append(i) or plain(i, out))
    with sampler.batches(prefetch=2) as batches:
        next(batches)
        time.sleep(0.3)
        assert made == [0, 1, 2]


@pytest.mark.parametrize("prefetch", [0, 2])
def test_exception_while_prefetching_is_raised_in_the_consumer(release_copy, prefetch):
    (release_copy / SHARD).write_bytes((release_copy / SHARD).read_bytes()[:3000])
    batches = load_icrl4aht(release_copy, layout="coord_simple").ad(batch_size=8, length=9).batches(prefetch=prefetch)
    with pytest.raises(Exception, match="truncated"):
        next(batches)
    assert next(batches, None) is None


def test_closing_or_deleting_batches_ends_the_prefetch_thread(sampler):
    def prefetch_threads() -> int:
        return sum(thread.name.startswith("icrl4aht-prefetch") for thread in threading.enumerate())

    with sampler.batches(prefetch=1) as batches:
        next(batches)
        assert prefetch_threads() == 1
    assert prefetch_threads() == 0
    abandoned = sampler.batches(prefetch=1)
    next(abandoned)
    del abandoned
    gc.collect()
    deadline = time.monotonic() + 20
    while prefetch_threads() and time.monotonic() < deadline:  # the thread first completes submitted batches
        time.sleep(0.01)
    assert prefetch_threads() == 0


def test_resumed_batches_continue_after_the_last_consumed_batch(sampler):
    batches = sampler.batches()
    for _ in range(4):
        next(batches)  # the saved position counts consumed batches, not prefetched ones
    state = json.loads(json.dumps(batches.state_dict()))
    batches.close()
    with sampler.batches() as resumed:
        next(resumed)
        resumed.load_state_dict(state)
        assert_equal_batches(next(resumed), sampler[4])


SIZES: dict[str, Any] = {"batch_size": 3, "length": 9}
OTHER_BATCHES = {
    "belongs to a different sampler: it has seed = 0, not 4": lambda ds: ds.ad(seed=4, **SIZES),
    "it has selection = ": lambda ds: ds[1:].ad(**SIZES),
    "it has every = None, not 2": lambda ds: ds.ad(every=2, **SIZES),
    "it has labels = None, not 'oracle'": lambda ds: ds.ad(labels="oracle", **SIZES),
    "channels = 'own', not 'canonical'": lambda ds: ds.with_options(channels="canonical").ad(**SIZES),
    "sampler = 'ADSampler', not 'DPTSampler'": lambda ds: ds.dpt(batch_size=3, context=9),
}


@pytest.mark.parametrize("message", OTHER_BATCHES)
def test_position_saved_by_a_different_sampler_is_refused(two_sources, message):
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", split="train")
    state = dataset.ad(**SIZES).batches(prefetch=0).state_dict()
    with pytest.raises(OptionError, match=message):
        OTHER_BATCHES[message](dataset).batches(prefetch=0).load_state_dict(state)


def test_position_saved_before_an_option_existed_can_be_resumed(two_sources):
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", split="train")
    for sampler in (dataset.ad(**SIZES), dataset.dpt(batch_size=3, context=9)):
        batches = sampler.batches(prefetch=0)
        state = {name: value for name, value in batches.state_dict().items() if name not in ("channels", "labels")}
        batches.load_state_dict(state | {"next": 7})
        assert_equal_batches(next(batches), sampler[7])


def test_batch_iterator_can_be_pickled_before_its_first_batch(lite):
    batches = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=2, length=10, seed=0).batches()
    assert_equal_batches(next(pickle.loads(pickle.dumps(batches))), next(batches))


@pytest.mark.slow
@pytest.mark.parametrize("cache", CACHES)
def test_memory_use_stays_constant_over_many_batches(lite, cache):
    def resident_bytes() -> int:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    sampler = load_icrl4aht(lite[0], layout="demo_wide", obs="uint8", cache=cache).ad(batch_size=16, length=100)
    with sampler.batches(stop=200) as batches:
        for _ in range(100):
            next(batches)
        early = resident_bytes()
        for _ in batches:
            pass
    assert batches.served == 200
    assert resident_bytes() - early < 16 * 2**20
