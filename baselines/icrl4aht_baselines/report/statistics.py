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
        low, high: ends of the interval; NaN if no cell has several instances.
    """

    mean: float
    low: float
    high: float

    def range(self, digits: int = 1, sign: str = "") -> str:
        """Return the interval as text, such as "(0.1 to 0.4)"; empty if there is none."""
        return "" if np.isnan(self.low) else f"({self.low:{sign}z.{digits}f} to {self.high:{sign}z.{digits}f})"

    def text(self, digits: int = 1, sign: str = "") -> str:
        """Return mean and interval as text, with a sign before positive numbers if `sign` is "+"."""
        return f"{self.mean:{sign}z.{digits}f} {self.range(digits, sign)}".rstrip()


def mean_interval(*cells: Float[np.ndarray, "U ..."]) -> MeanInterval:
    """Return the mean of the means of some cells, with its interval.

    Args:
        cells: the values of each cell, (U,) or (U, S). Values are resampled within each cell, cells are not.
    """
    mean = float(np.mean([values.mean() for values in cells])) if cells else float("nan")
    if all(len(values) == 1 for values in cells):
        return MeanInterval(mean, float("nan"), float("nan"))
    rng = np.random.default_rng(0)
    resampled = np.mean([_resampled_means(values.reshape(len(values), -1), rng) for values in cells], axis=0)
    return MeanInterval(mean, *map(float, np.percentile(resampled, (2.5, 97.5))))


def _resampled_means(values: Float[np.ndarray, "U S"], rng: np.random.Generator) -> Float[np.ndarray, " R"]:
    # scipy.stats.bootstrap resamples one level only, so it cannot draw the values of a resampled instance.
    instances, seeds = values.shape
    rows = rng.integers(instances, size=(_RESAMPLES, instances, 1))
    return values[rows, rng.integers(seeds, size=(_RESAMPLES, instances, seeds))].mean(axis=(1, 2))
