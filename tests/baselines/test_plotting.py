"""Test figures of training logs: few panels, one legend, and shared axes of returns."""

from __future__ import annotations

import json
from itertools import product

import pytest
from icrl4aht_baselines import plotting

from icrl4aht_data.benchmark.facts import LAYOUT_NAMES


@pytest.fixture
def saved_figures(monkeypatch):
    """Return a list that collects the figures instead of writing them to files."""
    figures = []
    monkeypatch.setattr(plotting, "save_figure", lambda figure, path: figures.append(figure))
    return figures


def visible_axes(figure):
    return [axes for axes in figure.axes if axes.axison]


@pytest.mark.parametrize(("layouts", "panels"), [(LAYOUT_NAMES[:6], 7), ((*LAYOUT_NAMES, "a", "b", "c"), 2)])
def test_figure_of_a_log_with_many_returns_has_few_panels(layouts, panels, tmp_path, saved_figures):
    names = [f"return {layout} {kind}" for layout, kind in product(layouts, ("territory", "recipe_aware_button"))]
    lines = [{"step": step, "part": "train", "loss": 1.0} | dict.fromkeys(names, 40.0) for step in range(60)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    plotting.plot_training_log(tmp_path / "metrics.jsonl", tmp_path / "curves.png", "rl2")
    (figure,) = saved_figures
    assert len(visible_axes(figure)) == panels
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["train", "territory", "recipe aware button"]
    limits = {axes.get_ylim() for axes in visible_axes(figure) if axes.get_title().startswith("return")}
    assert len(limits) == 1
    assert next(iter(limits))[0] < 0 < 40 < next(iter(limits))[1]
