"""Means and confidence intervals of values with known intervals."""

from __future__ import annotations

import numpy as np
import pytest
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from scipy.stats import bootstrap


def test_one_cell_has_the_percentile_interval():
    values = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    found = mean_interval(values)
    expected = bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(1)).confidence_interval
    assert found.mean == 4.0
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high], atol=0.2)
    assert mean_interval(values) == found, "random numbers are fixed"


def test_equal_values_single_instances_and_empty_input():
    found = mean_interval(np.full(5, 7.0), np.full((3, 2), 1.0))
    assert found == (4.0, 4.0, 4.0) and found.text() == "4.0 (4.0 to 4.0)"
    single = mean_interval(np.array([[1.0, 2.0]]))
    assert single.mean == 1.5 and np.isnan(single.low) and single.text(2, "+") == "+1.50"
    assert np.isnan(mean_interval()).all() and MeanInterval(-0.01, -0.2, 0.3).text(sign="+") == "+0.0 (-0.2 to +0.3)"


def test_seeds_do_not_count_as_instances_and_cells_are_not_resampled():
    """Compare 15 values as instances, as seeds of five different instances and of five equal ones."""
    values = np.linspace(-1, 1, 15)
    flat, differing, alike = (mean_interval(found) for found in (values, values.reshape(5, 3), values.reshape(3, 5).T))
    widths = [high - low for _, low, high in (flat, differing, alike)]
    assert widths[1] > 1.3 * widths[0] and widths[2] < widths[1]
    assert mean_interval(np.full(3, 0.0), np.full(3, 10.0)) == pytest.approx((5.0, 5.0, 5.0))
