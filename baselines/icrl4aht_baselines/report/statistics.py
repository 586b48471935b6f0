"""Means with 95 % bootstrap intervals.

Several values of one instance of a teammate, such as those of several seeds, are not independent: instances are
resampled first, then the values of each. Random numbers are fixed, so that pages are reproducible.

Shapes: U instances, S values of each, R resamples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_RESAMPLES = 10_000


class MeanInterval(NamedTuple):
    """A mean with its 95 % bootstrap interval.

    Attributes:
        mean: the mean; NaN without values.
        low, high: ends of the interval; NaN without values, equal to the mean if no cell has several values.
    """

    mean: float
    low: float
    high: float


def mean_interval(*cells: Float[np.ndarray, "U ..."]) -> MeanInterval:
    """Return the mean of the means of some cells, with its interval.

    Args:
        cells: the values of each cell, (U,) or (U, S). Values are resampled within each cell, cells are not.
    """
    if not cells:
        return MeanInterval(float("nan"), float("nan"), float("nan"))
    rng = np.random.default_rng(0)
    resampled = np.mean([_resampled_means(values, rng) for values in cells], axis=0)
    low, high = np.percentile(resampled, (2.5, 97.5))
    return MeanInterval(float(np.mean([values.mean() for values in cells])), float(low), float(high))


def _resampled_means(values: Float[np.ndarray, "U ..."], rng: np.random.Generator) -> Float[np.ndarray, " R"]:
    # scipy.stats.bootstrap resamples one level only, so it cannot draw the values of a resampled instance.
    if values.ndim == 1:
        return rng.choice(values, (_RESAMPLES, len(values))).mean(axis=1)
    instances, seeds = values.shape
    rows = rng.integers(instances, size=(_RESAMPLES, instances, 1))
    return values[rows, rng.integers(seeds, size=(_RESAMPLES, instances, seeds))].mean(axis=(1, 2))
