"""Bootstrap intervals of means.

Several values of one instance of a teammate, such as those of several seeds, are not independent: instances are
resampled first, then the values of each.

Shapes: U instances, S values of each.
"""

from __future__ import annotations

from collections.abc import Sequence
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


def bootstrap_interval(values: Float[np.ndarray, "U ..."], rng: np.random.Generator) -> tuple[float, float]:
    """Returns the 95 % bootstrap interval of the mean of some values, (U,) or (U, S)."""
    return _ends(_resampled_means(values, rng))


def mean_of_cells(cells: Sequence[Float[np.ndarray, "U ..."]]) -> MeanInterval:
    """Returns the mean of the means of some cells, with an interval for which values are resampled within each cell.

    Args:
        cells: the values of each cell, (U,) or (U, S). Cells themselves are not resampled.
    """
    if not cells:
        return MeanInterval(float("nan"), float("nan"), float("nan"))
    rng = np.random.default_rng(0)
    low, high = _ends(np.mean([_resampled_means(values, rng) for values in cells], axis=0))
    return MeanInterval(float(np.mean([values.mean() for values in cells])), low, high)


def _resampled_means(values: Float[np.ndarray, "U ..."], rng: np.random.Generator) -> Float[np.ndarray, " R"]:
    if values.ndim == 1:
        return rng.choice(values, (_RESAMPLES, len(values))).mean(axis=1)
    instances, seeds = values.shape
    rows = rng.integers(instances, size=(_RESAMPLES, instances, 1))
    return values[rows, rng.integers(seeds, size=(_RESAMPLES, instances, seeds))].mean(axis=(1, 2))


def _ends(means: Float[np.ndarray, " R"]) -> tuple[float, float]:
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)
