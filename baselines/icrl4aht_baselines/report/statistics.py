"""Means and ratios with 95 % intervals, p-values, and the correction of p-values.

Intervals of one training run are studentized bootstrap intervals (Efron and Tibshirani 1993, ch. 12.5). With five
teammates, percentile intervals would be too narrow by a tenth, since the variance of resamples is (n - 1) / n of the
true variance; dividing by the standard error of each resample corrects this. Teammates' behaviours are resampled within
a combination of layout and family, or the seeds if fewer than three behaviours have headroom. The random generator has
a fixed seed, so that results are reproducible.

Intervals of several training runs are Student's t intervals, with the sum of the variances of behaviours and of
training runs, and Satterthwaite's degrees of freedom: a bootstrap of three runs would often draw one run three times.
In simulations of three runs, 95 % of the intervals contain the true mean if the standard deviation of the runs is at
most twice the standard error over behaviours. If it is four times as large, 93 % contain it; then, if the true mean is
0, 7 % of p-values are below 0.05, and 2 % below 0.005. With two runs 89 to 95 % contain it, and there is no p-value.

Shapes: T training runs, U units of a stratum (behaviours, or seeds), S seeds, R resamples.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.stats import bootstrap, t, trim_mean

_RESAMPLES = 4000
_LEAST_FREEDOM = 3  # with fewer degrees of freedom, too many resamples are equal, or t intervals are very wide

LEAST_UNITS = 3
"""Least number of units that are resampled: half of the resamples of two units have variance 0."""

_Key = TypeVar("_Key", bound=Hashable)


class MeanInterval(NamedTuple):
    """Mean or ratio with its 95 % interval.

    Attributes:
        mean: estimated mean or ratio.
        low: lower end of the interval; NaN with too few units to resample.
        high: upper end of the interval; NaN with too few units to resample.
        p: two-sided p-value of the hypothesis that the true value is 0; NaN without an interval, or if only one agent
            has two training runs and no agent has more: then small p-values would be too frequent.
    """

    mean: float
    low: float = float("nan")
    high: float = float("nan")
    p: float = float("nan")

    def interval_text(self, digits: int = 1, sign: str = "") -> str:
        """Return the interval as text, such as "(0.1 to 0.4)", or an empty string if there is no interval."""
        return "" if np.isnan(self.low) else f"({self.low:{sign}z.{digits}f} to {self.high:{sign}z.{digits}f})"

    def text(self, digits: int = 1, sign: str = "") -> str:
        """Return mean and interval as text, with a sign before positive numbers if `sign` is "+"."""
        return f"{self.mean:{sign}z.{digits}f} {self.interval_text(digits, sign)}".rstrip()


class Stratum(NamedTuple):
    """Group of units, such as teammates, that are resampled in the bootstrap of the ratio sum(gains) / sum(scales).

    Attributes:
        gains: each unit's part of the numerator in each training run, of shape (T, U). For a difference of two agents,
            the training runs of the second agent follow those of the first.
        scales: each unit's part of the denominator, of shape (U,).
    """

    gains: Float[np.ndarray, "T U"]
    scales: Float[np.ndarray, " U"]


def mean_interval(*cells: Float[np.ndarray, "U ..."]) -> MeanInterval:
    """Return the mean over result cells of the mean value in each cell, with its 95 % interval.

    Args:
        cells: values of each result cell, of shape (U,) or (U, S). Values are resampled within a cell; cells are not
            resampled.
    """
    return ratio_interval([[stratum_of_values(values[None])] for values in cells])


def stratum_of_values(values: Float[np.ndarray, "T U ..."]) -> Stratum:
    """Return a stratum for the mean of values: its denominators are 1, so that its ratio is this mean.

    Args:
        values: float64 of shape (T, U) or (T, U, S). If U is less than `LEAST_UNITS`, the S values of a unit are
            resampled instead.
    """
    values = values.reshape(*values.shape[:2], -1)
    units = values.mean(axis=2 if values.shape[1] >= LEAST_UNITS else 1)
    return Stratum(units, np.ones(units.shape[1]))


def ratio_interval(
    groups: Sequence[Sequence[Stratum]], resamples: int = _RESAMPLES, subtracted: int = 0
) -> MeanInterval:
    """Return the mean over groups of the ratio sum(gains) / sum(scales), with its 95 % interval.

    With `subtracted`, return the difference of this mean between two agents. Units are paired, and training runs are
    not, because training runs of different agents have nothing in common. If one agent has a single run, its variance
    between runs is taken to be that of the other agent.

    There is no interval if there are too few units: fewer than three degrees of freedom, or only one unit in most
    strata and fewer than three degrees of freedom of training runs.

    Args:
        groups: strata of each group, at least one; all strata have the same training runs.
        resamples: number of resamples.
        subtracted: number of training runs of the second agent.
    """
    strata = [[Stratum(gains[None], scales[None]) for gains, scales in group] for group in groups]
    trainings = groups[0][0].gains.shape[0]
    runs = [trainings - subtracted, subtracted][: 1 + bool(subtracted)]
    weights = np.repeat([1, -1][: len(runs)], runs) / np.repeat(runs, runs)
    (mean,), parts = _estimate(strata, weights[None], runs)
    variance = float(sum(part for (part,), _ in parts))
    of_runs = sum(number - 1 for number in runs)
    freedom = sum(len(stratum.scales) - 1 for group in groups for stratum in group) + of_runs
    several = [len(stratum.scales) > 1 for group in groups for stratum in group]
    if freedom < _LEAST_FREEDOM or (of_runs < _LEAST_FREEDOM and np.mean(several) < 0.5):
        return MeanInterval(float(mean))
    if variance < 1e-18:  # all units have the same ratio
        return MeanInterval(*[float(mean)] * 3, p=float(abs(mean) < 1e-9))
    error = float(np.sqrt(variance))
    if of_runs:
        satterthwaite = variance**2 / sum(float(part) ** 2 / own_freedom for (part,), own_freedom in parts)
        half = error * t.ppf(0.975, satterthwaite)
        p = 2 * t.sf(abs(mean) / error, satterthwaite) if of_runs > 1 else np.nan
        return MeanInterval(*map(float, (mean, mean - half, mean + half, p)))
    rng = np.random.default_rng(0)
    resampled = [[_resample(stratum, resamples, rng) for stratum in group] for group in groups]
    with np.errstate(divide="ignore", invalid="ignore"):
        means, drawn_parts = _estimate(resampled, np.tile(weights, (resamples, 1)), runs)
        variances = sum((part for part, _ in drawn_parts), np.zeros(resamples))
        variances[variances < 1e-9 * variance] = 0.0  # rounding errors; such resamples are left out
        studentized = (means - mean) / np.sqrt(variances)
    studentized = studentized[np.isfinite(studentized)]
    low, high = mean - error * np.quantile(studentized, (0.975, 0.025))
    p = (1 + np.sum(np.abs(studentized) >= abs(mean) / error)) / (1 + len(studentized))
    return MeanInterval(float(mean), float(low), float(high), float(p))


def _resample(stratum: Stratum, resamples: int, rng: np.random.Generator) -> Stratum:
    """Return R resamples of a stratum, with gains of shape (R, T, U) and scales of shape (R, U)."""
    units = rng.integers(len(stratum.scales), size=(resamples, len(stratum.scales)))
    return Stratum(stratum.gains[:, units].swapaxes(0, 1), stratum.scales[units])


def _estimate(
    groups: Sequence[Sequence[Stratum]], weights: Float[np.ndarray, "R T"], runs: Sequence[int]
) -> tuple[np.ndarray, list[tuple[np.ndarray, int]]]:
    """Return mean and variance of the ratio sum(gains) / sum(scales), averaged over groups, for each resample.

    Args:
        groups: strata with gains of shape (R, T, U) and scales of shape (R, U).
        weights: share of each training run in each resample, of shape (R, T); negative for the second agent.
        runs: number of training runs of each agent.

    Returns:
        The means of shape (R,), and the parts of the variances: an array of shape (R,) and the degrees of freedom for
        each stratum with several units, and for each agent with several training runs.
    """
    by_training, parts = np.zeros_like(weights), []
    for group in groups:
        scale = sum(stratum.scales.sum(axis=1) for stratum in group)
        ratios = sum(stratum.gains.sum(axis=2) for stratum in group) / np.reshape(scale, (-1, 1))
        ratio = (ratios * weights).sum(axis=1)
        by_training += ratios / len(groups)
        for gains, scales in group:
            units = scales.shape[1]
            if units > 1:
                mean_gains = (gains * weights[..., None]).sum(axis=1)
                influence = (mean_gains - ratio[:, None] * scales) / np.reshape(scale, (-1, 1))
                parts.append((influence.var(axis=1, ddof=1) * units / len(groups) ** 2, units - 1))
    for number, ratios, share in zip(
        runs, np.split(by_training, runs[:1], axis=1), np.split(np.abs(weights), runs[:1], axis=1), strict=False
    ):
        if number > 1:
            own_mean = (ratios * share).sum(axis=1, keepdims=True)
            of_mean = (share * (ratios - own_mean) ** 2).sum(axis=1) / (number - 1)
            # The variance of one run is `number` times that of the mean.
            parts.append((of_mean * (1 + number if 1 in runs else 1), number - 1))
    return (by_training * weights).sum(axis=1), parts


def interquartile_mean(*strata: Float[np.ndarray, " _"]) -> MeanInterval:
    """Return the interquartile mean of all values, with its BCa bootstrap interval (Agarwal et al. 2021).

    Args:
        strata: values that are resampled separately, float64 (U,) each; strata of one value form a stratum together.
    """
    parts = [values for values in strata if len(values) > 1]
    single = [values for values in strata if len(values) == 1]
    if len(single) == 1:  # a stratum needs two values to be resampled
        parts[:1] = [np.concatenate([*single, *parts[:1]])]
    elif single:
        parts.append(np.concatenate(single))

    def middle(*values: np.ndarray, axis: int = -1) -> np.ndarray:
        return trim_mean(np.concatenate(values, axis=axis), 0.25, axis=axis)

    mean = float(middle(*parts))
    if sum(len(values) - 1 for values in parts) < _LEAST_FREEDOM:
        return MeanInterval(mean)
    left_out = [
        [middle(*parts[:number], np.delete(values, place), *parts[number + 1 :]) for place in range(len(values))]
        for number, values in enumerate(parts)
    ]
    if max(map(np.ptp, left_out)) < 1e-9:  # BCa divides by the variance of the jackknife means
        return MeanInterval(mean)
    options = {"n_resamples": _RESAMPLES, "method": "BCa", "vectorized": True, "rng": np.random.default_rng(0)}
    return MeanInterval(mean, *map(float, bootstrap(parts, middle, **options).confidence_interval))


def holm_corrected(p_values: Mapping[_Key, float]) -> dict[_Key, float]:
    """Return p-values corrected by Holm's method, which bounds the probability of any false rejection.

    A p-value of NaN stays NaN and does not count in the number of hypotheses.
    """
    keys = sorted((key for key, p in p_values.items() if not np.isnan(p)), key=lambda key: p_values[key])
    multiplied = [p_values[key] * (len(keys) - rank) for rank, key in enumerate(keys)]
    corrected = np.maximum.accumulate(np.minimum(1.0, multiplied)).tolist()
    return dict(p_values) | dict(zip(keys, corrected, strict=True))
