"""Test the HTML report in headless Chromium at the width of a phone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from icrl4aht_baselines.report import page
from icrl4aht_baselines.report.gifs import EpisodePair, ShownEpisode
from icrl4aht_baselines.report.results import TEST_LAYOUTS, ResultCell
from PIL import Image

from tests.helpers.chromium import NEEDS_CHROMIUM, PHONE, check_fits_window, chromium
from tests.helpers.evaluated import evaluated_run

pytestmark = [pytest.mark.slow, NEEDS_CHROMIUM]

TOO_WIDE = """(width) => [...document.body.querySelectorAll("*")]
    .filter((element) => !element.closest(".wide, svg") && element.getBoundingClientRect().right > width + 0.5)
    .map((element) => element.outerHTML.slice(0, 100))"""
"""JavaScript function: elements that extend beyond the page's width, except tables in `.wide`, which can scroll."""


@pytest.fixture(scope="module")
def report_file(tmp_path_factory) -> Path:
    """Write a report with every section, all layouts, long names and pictures of episodes; return its path."""
    folder = tmp_path_factory.mktemp("report")
    Image.fromarray(np.zeros((400, 900), np.uint8)).save(folder / "a.gif")
    runs = [evaluated_run(name, TEST_LAYOUTS, protocol="published") for name in ("AD", "random")]
    runs += [evaluated_run("AD", note=f"K{k}", protocol="published") for k in (250, 500)]
    runs.append(evaluated_run("AD+TA+next_obs-" + "x" * 60, protocol="published"))
    shown = tuple(ShownEpisode(number, 20.0 * number, folder / "a.gif") for number in (1, 100))
    caption = "Task 0123456789abcdef, protocol published"
    pairs = [EpisodePair(ResultCell("demo_wide", "H1"), "AD with H1/t0 on demo_wide", caption, shown)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "family_gifs", lambda *options: pairs)
        page.write_page(runs, folder / "report.html", gifs=True)
    return folder / "report.html"


@pytest.mark.parametrize("dark", [False, True])
def test_report_fits_the_width_of_a_phone(report_file, dark):
    with chromium() as open_page:
        shown = open_page(report_file.as_uri(), PHONE, dark)
        shown.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true })")
        assert shown.locator("section").count() == 6
        assert shown.evaluate(TOO_WIDE, PHONE) == []
        check_fits_window(shown, PHONE, dark)
