"""Without matplotlib and Pillow, work whose results will be drawn is refused before it starts, with a command."""

from __future__ import annotations

import re
import sys

import pytest
from icrl4aht_baselines.demo import run_demo
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.build import build_releases
from rich.console import Console

from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import can_draw, new_figure
from icrl4aht_data.utils.install_hints import install_command

CONSOLE = Console(quiet=True)
SMOKE = load_profile("smoke")
HINT = re.escape(install_command("plot"))


@pytest.fixture(params=["matplotlib", "PIL"])
def missing(request, monkeypatch) -> str:
    """The name of a library that cannot be imported."""
    assert can_draw()
    monkeypatch.setitem(sys.modules, request.param, None)
    return request.param


@pytest.mark.parametrize(
    "work",
    [
        lambda out: run_demo(out, CONSOLE),
        lambda out: build_releases(SMOKE, out, ("lite",), CONSOLE),
    ],
    ids=["demo", "releases"],
)
def test_work_with_pictures_is_refused_at_once(missing, work, tmp_path):
    with pytest.raises(OptionError, match=f"drawing needs matplotlib and Pillow: {HINT}"):
        work(tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_figure_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(OptionError, match=f"drawing needs matplotlib: {HINT}"):
        new_figure(1, 1)
