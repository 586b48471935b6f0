"""Test confidence intervals and p-values against known numbers, and the coverage of intervals by simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.report.statistics import (
    MeanInterval,
    Stratum,
    holm_corrected,
    interquartile_mean,
    mean_interval,
    ratio_interval,
    stratum_of_values,
)
from scipy.stats import ttest_1samp, ttest_ind


def test_interval_and_p_value_of_normal_values_are_close_to_students_t():
    values = np.random.default_rng(3).normal(0.3, 1.0, 40)
    found = mean_interval(values)
    expected: Any = ttest_1samp(values, 0.0)
    low, high = expected.confidence_interval()
    np.testing.assert_allclose([found.low, found.high], [low, high], atol=0.06)
    assert found.mean == pytest.approx(values.mean()) and found.p == pytest.approx(expected.pvalue, abs=0.02)
    assert mean_interval(values) == found, "the random numbers are fixed"


def test_equal_values_give_a_point_interval_and_too_few_values_give_nan():
    found = mean_interval(np.full(5, 7.0), np.full((3, 2), 1.0))
    assert found[:3] == (4.0, 4.0, 4.0) and found.p == 0 and found.text() == "4.0 (4.0 to 4.0)"
    pair = mean_interval(np.array([[1.0, 2.0]]))
    assert pair.mean == 1.5 and np.isnan(pair.low) and pair.text(2, "+") == "+1.50"
    assert MeanInterval(-0.01, -0.2, 0.3).text(sign="+") == "+0.0 (-0.2 to +0.3)"


def test_interval_is_missing_if_most_strata_have_one_unit():
    """The single units' variance is unknown, so an interval would be too narrow."""
    several, single = Stratum(np.arange(4.0)[None], np.ones(4)), Stratum(np.ones((1, 1)), np.ones(1))
    assert np.isnan(ratio_interval([[several], [single], [single]]).low)
    assert np.isfinite(ratio_interval([[several], [single]]).low)


def test_intervals_resample_instances_but_not_groups():
    """Compare intervals of 15 values: one per instance, three seeds of five instances, and 15 seeds of one instance."""
    values = np.linspace(-1, 1, 15)
    flat, nested, single = (mean_interval(found) for found in (values, values.reshape(5, 3), values.reshape(1, 15)))
    assert nested.high - nested.low > 1.3 * (flat.high - flat.low) and single == flat
    assert mean_interval(np.full(3, 0.0), np.full(3, 10.0))[:3] == pytest.approx((5.0, 5.0, 5.0))


def test_interval_of_a_ratio_is_wider_over_several_training_runs():
    gains, scales = np.array([[1.0, 3.0, 2.0, 4.0]]), np.array([2.0, 4.0, 2.0, 8.0])
    one = Stratum(gains, scales)
    assert ratio_interval([[one], [Stratum(gains[:, :2], scales[:2])]]).mean == pytest.approx((10 / 16 + 4 / 6) / 2)
    several = Stratum(np.concatenate([gains - 2, gains, gains + 2]), scales)
    found = [ratio_interval([[stratum]]) for stratum in (one, several)]
    assert found[0].mean == pytest.approx(found[1].mean)
    assert found[1].high - found[1].low > found[0].high - found[0].low


def test_difference_of_two_agents_has_the_variances_of_the_training_runs_of_both():
    units, higher = np.arange(20.0)[None], np.random.default_rng(0).normal(1.0, 0.5, 20)
    spread = np.concatenate([units - 2, units, units + 2])
    equal, several, both = (
        ratio_interval([[Stratum(np.concatenate([one, other]), np.ones(20))]], subtracted=len(other))
        for one, other in ((units + higher, units), (spread + higher, units), (spread + higher, spread))
    )
    assert [equal.mean, several.mean, both.mean] == pytest.approx([higher.mean()] * 3)
    welch: Any = ttest_ind([-1.0, 1.0, 3.0], [-2.0, 0.0, 2.0], equal_var=False)
    low, high = welch.confidence_interval()
    assert both.high - both.low == pytest.approx(high - low, rel=0.02), "the variance of units is small"
    same: Any = ttest_ind([-2 + both.mean, both.mean, 2 + both.mean], [-2, 0, 2])
    assert both.p == pytest.approx(same.pvalue, rel=0.02)
    assert 10 * (equal.high - equal.low) < several.high - several.low


def test_interquartile_mean_drops_a_quarter_of_values_at_each_end():
    found = interquartile_mean(np.array([-100.0, 0, 1, 2, 3, 4, 5, 900]))
    assert found.mean == 2.5 and found.low < 2.5 < found.high
    few = interquartile_mean(np.array([0.0, 1.0]), np.array([2.0, 4.0]))
    assert few.mean == 1.5 and np.isnan(few.low), "two degrees of freedom"
    assert np.isnan(interquartile_mean(np.ones(3)).low) and np.isnan(interquartile_mean(np.ones(1), np.ones(5)).low)


def test_interquartile_mean_resamples_strata_separately():
    """Values differ between strata more than within: stratified resampling gives a narrower interval."""
    strata = [5.0 * number + np.array([0.0, 0.1, 0.2, 0.4]) for number in range(4)]
    joined, separate = interquartile_mean(np.concatenate(strata)), interquartile_mean(*strata)
    assert joined.mean == separate.mean and separate.high - separate.low < 0.3 * (joined.high - joined.low)
    assert interquartile_mean(*strata, np.array([7.0])).mean == pytest.approx(
        interquartile_mean(np.append(np.concatenate(strata), 7.0)).mean
    )


def test_holm_corrects_p_values():
    found = holm_corrected({"a": 0.01, "b": 0.04, "c": 0.03, "d": float("nan")})
    assert [found[name] for name in "abc"] == pytest.approx([0.03, 0.06, 0.06]) and np.isnan(found["d"])
    assert holm_corrected({}) == {}


@pytest.mark.slow
@pytest.mark.parametrize("trainings", [1, 3, 5])
def test_intervals_have_the_nominal_coverage(trainings):
    """Simulate four groups of five units with unequal variances, and an effect of each training run on all units."""
    rng, covered, rounds = np.random.default_rng(1), 0, 800
    for _ in range(rounds):
        common = rng.normal(0.0, 0.5, (trainings, 1)) if trainings > 1 else np.zeros((1, 1))
        cells = [common + rng.normal(cell, 1.0 + cell, 5) for cell in range(4)]
        found = ratio_interval([[stratum_of_values(cell)] for cell in cells], resamples=1000)
        covered += found.low <= 1.5 <= found.high
    assert 0.92 < covered / rounds < 0.98


@pytest.mark.slow
def test_small_p_values_are_about_as_frequent_as_stated_with_three_training_runs():
    """Simulate training runs that differ by two and four times the standard error of the mean over 12 units.

    The last simulation is of the difference between an agent with three runs and an agent with one run.
    """
    rng, rounds = np.random.default_rng(2), 3000
    for ratio, stated in ((2, (0.05, 0.008)), (4, (0.07, 0.02))):
        effects = rng.normal(0.0, ratio / np.sqrt(12), (rounds, 3, 1))
        p = [ratio_interval([[Stratum(own + rng.normal(0.0, 1.0, 12), np.ones(12))]]).p for own in effects]
        found = [np.mean(np.array(p) < level) for level in (0.05, 0.005)]
        assert found[0] == pytest.approx(stated[0], abs=0.015) and found[1] == pytest.approx(stated[1], abs=0.007)
    effects = rng.normal(0.0, 2 / np.sqrt(12), (rounds, 4, 1))
    units = [np.concatenate([rng.normal(0.0, 1.0, (1, 12))] * 3 + [np.zeros((1, 12))]) for _ in range(rounds)]
    p = [ratio_interval([[Stratum(a + b, np.ones(12))]], subtracted=1).p for a, b in zip(effects, units, strict=True)]
    assert np.mean(np.array(p) < 0.05) < 0.065


def test_two_training_runs_have_an_interval_without_a_p_value():
    gains = np.random.default_rng(0).normal(1.0, 1.0, (2, 12))
    one = ratio_interval([[Stratum(gains, np.ones(12))]])
    assert np.isfinite(one.low) and np.isnan(one.p)
    both = ratio_interval([[Stratum(np.concatenate([gains, gains - 1]), np.ones(12))]], subtracted=2)
    assert both.p < 0.2
