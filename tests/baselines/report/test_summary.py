"""The summary that a report opens with, and its charts: scores between the reference egos, curves on shared axes."""

from __future__ import annotations

import numpy as np
import pytest
from icrl4aht_baselines.report.charts import curve_figure, return_bars, score_bars, sweep_figure
from icrl4aht_baselines.report.headline import find_headlines, headline_text
from icrl4aht_baselines.report.results import published_cells
from icrl4aht_baselines.report.tables import sweep_points

from icrl4aht_data.benchmark.reference_returns import HEURISTICS, read_headroom
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.plotting import return_limits, running_mean
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

SCALES = read_headroom("published")


def score(value: float, layout: str, family: str) -> float:
    egos = SCALES[layout, family]
    return (value - egos["stay"]) / (egos["oracle"] - egos["stay"])


def test_the_score_is_the_mean_over_complete_cells_with_headroom():
    run = evaluated_run("mine", ("coord_simple", "demo_wide"), protocol="published")
    (headline,) = find_headlines(run)
    expected = np.mean([score(11.0, "demo_wide", family) for family in HEURISTICS])
    assert headline.score is not None and headline.gain is not None
    assert headline.score == pytest.approx((expected,) * 3), "equal instances"
    assert headline.gain.mean == 2.0
    assert headline.tasks == "4 test cells with headroom, of 8 played"
    assert list(headline.paper) == ["AD", "DPT"]
    assert headline.paper["AD"] == pytest.approx(
        np.mean([score(published_cells("AD")["demo_wide"][family][0], "demo_wide", family) for family in HEURISTICS])
    )
    assert headline_text(headline) == (
        "mine (published), 4 test cells with headroom, of 8 played: normalised score 0.26 (0.26 to 0.26); return 11.0 "
        "(11.0 to 11.0); gain +2.0 (2.0 to 2.0): 10.0 in the first, 12.0 in the last 20 episodes. Parentheses: 95 % "
        f"intervals. The paper's normalised score in these cells: AD {headline.paper['AD']:z.2f}, "
        f"DPT {headline.paper['DPT']:z.2f}."
    )


def test_the_paper_is_quoted_where_the_protocol_matches():
    assert list(find_headlines(evaluated_run("DPT", protocol="published"))[0].paper) == ["DPT"]
    assert find_headlines(evaluated_run("DPT"))[0].paper == {}
    assert find_headlines(evaluated_run("DPT", protocol="published", variant=("K", 500)))[0].paper == {}


def test_results_without_a_score_say_why():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide"]
    theta = tasks[-1].teammate | {"theta_id": 70}
    own = make_task("teammate", "validation", "demo_wide", theta, 3)
    test, validation = find_headlines(evaluated_run("mine", tasks=[tasks[0], own]))
    assert test.score is None and not test.has_interval
    assert test.why_no_score == "No score: it needs all published tasks of a cell, in episodes of 100 steps."
    assert "these are validation tasks" in validation.why_no_score
    flat = find_headlines(evaluated_run("mine", ("coord_simple",)))[0]
    assert flat.why_no_score == "No score: no cell that was played completely has headroom."
    assert "return 11.0; gain" in headline_text(test), "no interval of a single instance"


def test_bars_run_from_stay_to_the_score():
    runs = {0: evaluated_run("mine", ("coord_simple", "demo_wide"), value=39.0, protocol="published")}
    chart = score_bars(runs, "published")
    assert chart is not None
    (rows,) = chart.layouts.values()
    stay, oracle = (tick.position for tick in chart.ticks)
    for row in rows:
        (bar,) = row.bars
        assert bar.start == pytest.approx(stay)
        assert bar.width == pytest.approx(score(40.0, "demo_wide", row.label) * (oracle - stay), abs=0.02)
        assert [mark.name for mark in row.marks] == ["AD", "DPT"]
    assert rows[0].scale == "0.0 to 40.0" and rows[0].bars[0].text == "1.00"
    assert chart.left_out == [
        "The oracle earns no more than an ego that stays: coord_simple H1, coord_simple H2, coord_simple H3, "
        "coord_simple H4."
    ]
    low = score_bars({0: evaluated_run("mine", ("asymm_right",), value=-90.0)}, "seeded")
    assert low is not None and low.layouts["asymm_right"][3].bars[0].clipped
    assert score_bars({0: evaluated_run("mine", ("coord_simple",))}, "seeded") is None
    returns = return_bars({0: evaluated_run("mine", ("coord_simple",))}, "test")
    assert (
        returns is not None
        and [bar.text for row in returns.layouts["coord_simple"] for bar in row.bars] == ["11.0"] * 4
    )


def test_a_constant_return_is_a_line_at_its_place():
    low, high = return_limits([40.0, 40.0])
    assert low <= 0 and 40 <= high < 45
    low, high = return_limits([0.0])
    assert low <= 0 and high >= 20
    run = evaluated_run("mine", value=40.0)
    figure = curve_figure({0: run}, list(run.cells))
    assert [tick.label for tick in figure.y_ticks] == ["0", "10", "20", "30", "40"]
    assert len(figure.panels) == 4
    (curve,) = figure.panels[0].curves
    assert curve.line.count("L") == 39


def test_curves_of_one_episode_can_be_drawn():
    run = evaluated_run("mine")
    cells = {cell: returns[:, :1] for cell, returns in run.cells.items()}
    run.cells.update(cells)
    assert curve_figure({0: run}, list(cells)).panels[0].curves[0].line.count("L") == 1
    assert find_headlines(run)[0].gain is None


def test_smoothing_keeps_constants_ends_and_sums():
    np.testing.assert_allclose(running_mean(np.full(7, 3.0), 3), 3.0)
    steps = np.arange(100.0)
    smooth = running_mean(steps, 10)
    np.testing.assert_allclose(smooth[5:95], steps[5:95] - 0.5)
    assert smooth[0] == np.mean(steps[:5])
    np.testing.assert_array_equal(running_mean(steps, 0), steps)


def test_sweeps_are_drawn_over_their_values():
    runs = [
        evaluated_run("AD", ("test_wide",), value=k / 50, variant=("K", k), protocol="published") for k in (250, 500)
    ]
    figure = sweep_figure(sweep_points(runs, "K"), "K")
    assert [tick.label for tick in figure.x_ticks] == ["250", "500"]
    (panel,) = figure.panels
    assert [mark.name for mark in panel.marks] == ["ours", "ours", "paper"]
