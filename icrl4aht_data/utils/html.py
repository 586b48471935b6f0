"""Pieces of HTML for notebooks: a table of facts, and learning curves as inline SVG. They need no optional library."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _MARGIN = 420, 130, 44, 18, 8  # pixels
_MOST_POINTS = 200  # of a curve; more would not be seen
_COLOURS = ("#1f77b4", "#d9730d", "#2ca02c", "#9467bd")  # readable on white and on black


def facts_html(title: str, facts: Mapping[str, str], figure: str = "") -> str:
    """Return a title, a figure and a table of facts as HTML.

    Args:
        title: text of the first line.
        facts: name -> value, one row each.
        figure: HTML between the title and the table, such as `curve_svg` returns.
    """
    cell = "text-align:left;vertical-align:top;padding:1px 12px 1px 0"
    rows = "".join(
        f'<tr><th scope="row" style="{cell}">{escape(name)}</th><td style="{cell}">{escape(value)}</td></tr>'
        for name, value in facts.items()
    )
    return f'<div style="max-width:{2 * _WIDTH}px"><strong>{escape(title)}</strong>{figure}<table>{rows}</table></div>'


def curve_svg(curves: Mapping[str, np.ndarray], axis: str = "episode") -> str:
    """Return curves in one pair of axes as an SVG element that uses the page's text colour.

    Args:
        curves: label -> values at equal distances, (N,) of at least one.
        axis: label of the horizontal axis.
    """
    low, high = (float(of([of(values) for values in curves.values()])) for of in (np.min, np.max))
    span = high - low or 1.0
    lines, legend = [], []
    for number, (label, values) in enumerate(curves.items()):
        points = [float(part.mean()) for part in np.array_split(values, min(len(values), _MOST_POINTS))]
        xs = np.linspace(_LEFT, _WIDTH - _MARGIN, len(points)).tolist()
        ys = [_MARGIN + (_HEIGHT - _BOTTOM - _MARGIN) * (high - value) / span for value in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
        colour = _COLOURS[number % len(_COLOURS)]
        lines.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        legend.append(f'<tspan fill="{colour}"> {escape(label)}</tspan>')
    floor, right = _HEIGHT - _BOTTOM, _WIDTH - _MARGIN
    words = f"return from {low:g} to {high:g} by {axis}, of {', '.join(curves)}"
    return (
        f'<svg role="img" aria-label="{escape(words)}" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" '
        f'height="{_HEIGHT}" style="display:block;max-width:100%;font:11px sans-serif">'
        f'<path d="M{_LEFT},{_MARGIN}V{floor}H{right}" fill="none" stroke="currentColor" stroke-opacity="0.4"/>'
        f'<g fill="currentColor"><text x="{_LEFT - 5}" y="{_MARGIN + 8}" text-anchor="end">{high:.1f}</text>'
        f'<text x="{_LEFT - 5}" y="{floor}" text-anchor="end">{low:.1f}</text>'
        f'<text x="{_LEFT}" y="{_HEIGHT - 4}">return by {escape(axis)}</text>'
        f'<text x="{right}" y="{_HEIGHT - 4}" text-anchor="end">{"".join(legend)}</text></g>{"".join(lines)}</svg>'
    )
