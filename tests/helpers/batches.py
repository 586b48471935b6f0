"""Helpers for sampling tests: samplers of each kind, a comparison of batches, and a hash of batches."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.reading.sources import CacheMode

CACHES: tuple[CacheMode, ...] = ("ram", "mmap", "stream")


def example_samplers(dataset, **options):
    """Return AD and DPT samplers with different window lengths and orders of transitions."""
    return [
        dataset.ad(batch_size=6, length=50, teammate_actions=True, **options),
        dataset.ad(batch_size=6, length=130, **options),  # windows longer than the histories
        dataset.ad(batch_size=6, length=50, every=2, **options),
        dataset.dpt(batch_size=6, context=17, **options),
        dataset.dpt(batch_size=6, context=17, order="random", teammate_actions=True, **options),
    ]


def assert_equal_batches(one, two) -> None:
    """Assert that two batches have equal arrays and that the same fields are None."""
    assert one._fields == two._fields
    for name, array in one._asdict().items():
        np.testing.assert_array_equal(array, getattr(two, name), err_msg=name, strict=True)


def batches_digest(root: Path) -> str:
    """Return the SHA-256 of a few AD and DPT batches, drawn from a release's histories on demo_wide."""
    dataset = load_icrl4aht(root, layout="demo_wide")
    samplers = [
        dataset.ad(batch_size=5, length=40, seed=7, teammate_actions=True),
        dataset.dpt(batch_size=5, context=12, seed=7),
        dataset.dpt(batch_size=5, context=12, seed=7, order="random"),
    ]
    state = hashlib.sha256()
    for sampler in samplers:
        for i in (0, 1, 1000):
            for name, array in sampler[i]._asdict().items():
                state.update(name.encode() + (b"" if array is None else array.tobytes()))
    return state.hexdigest()
