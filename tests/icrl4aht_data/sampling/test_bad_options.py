"""Test that invalid options of loading and sampling raise package errors that name the value."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrl4aht_data import Curriculum, get_layout, load_icrl4aht, verify_release
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.interop import hf_windows, render_observations, torch_loader

SIZES: dict[str, Any] = {"batch_size": 2, "length": 5}

WRONG_OPTIONS: dict[str, dict[str, Any]] = {
    "batch_size = 0: expected at least 1": {"batch_size": 0},
    "batch_size = True: expected an integer": {"batch_size": True},
    r"batch_size = 2\.0: expected an integer": {"batch_size": 2.0},
    "length = 0: expected": {"length": 0},
    r"seed = 0\.5: expected": {"seed": 0.5},
    "seed = 18446744073709551616: expected at least 0 and below": {"seed": 2**64},
    "every = 0: expected": {"every": 0},
    "at_start = 1.5: expected": {"at_start": 1.5},
    "process_index = 0, process_count = 4, batch_size = 6": {"batch_size": 6, "process_count": 4},
    "process_index = 3, process_count = 3": {"batch_size": 6, "process_index": 3, "process_count": 3},
    r"episodes = \(6, 9\): a history with 6 episodes has no episode in this range": {"episodes": (6, 9)},
    r"episodes = \(0, 1, 2\): expected a pair": {"episodes": (0, 1, 2)},
    r"episodes = \(0, 1\.5\): expected a pair": {"episodes": (0, 1.5)},
    r"episodes = \(True, 3\): expected a pair": {"episodes": (True, 3)},
    r"curriculum = \(10,\): expected a Curriculum": {"curriculum": (10,)},
    r"weights: expected 6 numbers.*found shape \(2,\) with 1 to 2": {"weights": [1, 2]},
    r"found shape \(3,\) with -3 to -1": {"weights": [-1, -2, -3]},
    r"found shape \(0,\) with no values": {"weights": []},
    "weights: expected 6 numbers.*not all zero": {"weights": [0] * 6},
    "weights: expected 6 numbers": {"weights": [1, 1, 1, 1, 1, np.nan]},
    "unknown weights 'score'; valid: uniform, length": {"weights": "score"},
}

WRONG_CONTEXTS: dict[str, dict[str, Any]] = {
    "context = 121: the shortest history has 120 transitions": {"context": 121},
    "the shortest history has 20 transitions": {"context": 21, "episodes": (0, 1)},
    "unknown order 'sorted'; valid: contiguous, random": {"context": 5, "order": "sorted"},
    "queries = 0: expected": {"context": 5, "queries": 0},
    "unknown labels 'other'; valid: expert, oracle": {"context": 5, "labels": "other"},
}

WRONG_CALLS: dict[str, Any] = {
    "root = 5: expected a release folder or an address": lambda ds: load_icrl4aht(5),  # type: ignore[arg-type]
    r"root = 'a\\x00b': expected a release folder": lambda ds: load_icrl4aht("a\0b"),
    "root = 7: expected a release folder": lambda ds: verify_release(7),  # type: ignore[arg-type]
    r"unknown layout \['a'\]": lambda ds: get_layout(["a"]),  # type: ignore[arg-type]
    r"actions\[True:None\]: expected integers or None": lambda ds: ds[0].read("actions", True),
    "state = 5: expected": lambda ds: ds.ad(**SIZES).batches().load_state_dict(5),  # type: ignore[arg-type]
    "unknown context 'x'; valid: spawn": lambda ds: torch_loader(ds.ad(**SIZES), workers=1, context="x"),
    "state: expected bytes": lambda ds: render_observations({"layout": ["demo_wide"], "state": [[[300]]]}),
    "layout = 5: expected": lambda ds: render_observations({"layout": 5, "state": []}),
    "split = {'train': 1}: expected a name": lambda ds: ds.filter(split={"train": 1}),
    "position True of the selection's histories: expected an integer": lambda ds: ds[True],
    'the selection has layouts coord_simple, demo_wide.*channels="canonical"': lambda ds: load_icrl4aht(ds.root).ad(
        **SIZES
    ),
    "batch = -1: expected": lambda ds: ds.ad(**SIZES)[-1],
    r"batch = 0\.7: expected": lambda ds: ds.ad(**SIZES)[0.7],
    "batch = True": lambda ds: ds.ad(**SIZES)[True],
    "out = 3: expected a batch": lambda ds: ds.ad(**SIZES).batch(0, 3),
    "device = 'gpu0': expected a device": lambda ds: ds.ad(**SIZES).batches(device="gpu0"),
    "curriculum batches = 0": lambda ds: Curriculum(0),
    r"curriculum first = \(0\.5, 0\.5\): expected fractions": lambda ds: Curriculum(10, (0.5, 0.5)),
    "curriculum last = 5: expected fractions": lambda ds: Curriculum(10, last=5),  # type: ignore[arg-type]
    "sampler = Dataset.*: expected a sampler": lambda ds: torch_loader(ds),
    "sampler = 7: expected a sampler": lambda ds: hf_windows(7),  # type: ignore[arg-type]
    "rows = 'abc': expected rows of episodes": lambda ds: render_observations("abc"),  # type: ignore[arg-type]
    "expected fps from 1 to 50, found 'fast'": lambda ds: ds[0].animate(fps="fast"),
    "expected cell from 16 to 128 pixels, found 1000000": lambda ds: ds[0].animate(cell=10**6),
}


@pytest.fixture
def dataset(lite):
    return load_icrl4aht(lite[0], layout="demo_wide")


@pytest.mark.parametrize("message", WRONG_OPTIONS)
def test_invalid_sampler_options_raise_errors(dataset, message):
    with pytest.raises(Icrl4ahtError, match=message):
        dataset.ad(**SIZES | WRONG_OPTIONS[message])


@pytest.mark.parametrize("message", WRONG_CONTEXTS)
def test_invalid_context_options_raise_errors(dataset, message):
    with pytest.raises(Icrl4ahtError, match=message):
        dataset.dpt(batch_size=2, **WRONG_CONTEXTS[message])


@pytest.mark.parametrize("message", WRONG_CALLS)
def test_invalid_arguments_raise_errors(dataset, message):
    with pytest.raises(Icrl4ahtError, match=message):
        WRONG_CALLS[message](dataset)


def test_buffers_of_wrong_shape_or_memory_order_are_refused(dataset):
    one, two = (dataset.ad(batch_size=2, length=length) for length in (5, 6))
    with pytest.raises(OptionError, match=r"out: expected .*obs.*\(2, 5, 5, 5, 45\).*found .*\(2, 6, 5, 5, 45\)"):
        one.batch(0, two.empty())
    sliced = one.empty()._replace(dones=np.empty((5, 2), bool).T)
    with pytest.raises(OptionError, match="C-contiguous"):
        one.batch(0, sliced)
