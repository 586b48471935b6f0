"""Test the figure of returns by episode."""

from __future__ import annotations

import numpy as np

from icrl4aht_data.plotting import SourceCurves, add_curve, average_in_blocks, plot_source_curves


def test_panel_of_a_source_shows_means_by_layout_and_split():
    curves = SourceCurves()
    add_curve(curves, "search", "demo_wide", "train", np.array([0.0, 20, 40, 40]))
    add_curve(curves, "search", "coord_ring", "train", np.array([0.0, 0, 0]))
    add_curve(curves, "search", "demo_wide", "validation", np.array([-20.0, 20]))
    add_curve(curves, "noise", "demo_wide", "train", np.arange(1000.0))
    figure = plot_source_curves(curves)
    noise, search = figure.axes
    assert [axes.get_title() for axes in (noise, search)] == ["source noise, 1 history", "source search, 3 histories"]
    assert noise.get_xscale() == search.get_xscale() == "log"
    assert noise.get_ylim() == search.get_ylim()
    drawn = {line.get_label(): np.asarray(line.get_xydata()) for line in search.lines}
    np.testing.assert_allclose(drawn["demo_wide"], [[1, 0], [2, 20], [3, 40], [4, 40]])
    # The mean over histories ends with the shortest history.
    np.testing.assert_allclose(drawn["all of split train"], [[1, 0], [2, 10], [3, 20]])
    np.testing.assert_allclose(drawn["all of split validation"], [[1, -20], [2, 20]])
    first = np.asarray(noise.lines[0].get_xydata())
    assert len(first) <= 25
    np.testing.assert_allclose(first[0], [1, 0])
    # Each drawn point is the mean of a block of episodes, and the blocks cover all episodes.
    assert first[-1, 1] > 800
    assert np.all(np.diff(first[:, 1]) > 0)


def test_blocks_of_episodes_are_averaged_and_equally_long_on_a_log_axis():
    returns = np.stack([np.arange(1.0, 101.0), np.ones(100)])
    episodes, means = average_in_blocks(returns)
    assert episodes[0] == 1 and means[0, 0] == 1 and len(episodes) == means.shape[1] <= 25
    np.testing.assert_allclose(means[0], episodes, rtol=0.02)  # the mean episode is close to the centre
    assert (means[1] == 1).all()
    ratios = episodes[1:] / episodes[:-1]
    assert ratios[-8:].max() < 1.1 * ratios[-8:].min(), "later blocks grow by a constant factor"
