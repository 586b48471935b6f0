"""Samplers of each kind, and equality of batches."""

from __future__ import annotations

import numpy as np

from icrl4aht_data.reading.sources import CacheMode

CACHES: tuple[CacheMode, ...] = ("ram", "mmap", "stream")


def samplers(dataset, **options):
    """Return samplers of each kind and order."""
    return [
        dataset.ad(batch_size=6, length=50, teammate_actions=True, **options),
        dataset.ad(batch_size=6, length=130, **options),  # longer than the histories
        dataset.dpt(batch_size=6, context=17, **options),
        dataset.dpt(batch_size=6, context=17, order="random", teammate_actions=True, **options),
    ]


def assert_equal(one, two) -> None:
    """Assert that two batches have equal arrays, and None for the same fields."""
    assert one._fields == two._fields
    for name, array in one._asdict().items():
        np.testing.assert_array_equal(array, getattr(two, name), err_msg=name, strict=True)
