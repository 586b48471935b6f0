"""A table of facts as HTML, for notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

_WIDEST = 840  # pixels


def facts_html(title: str, facts: Mapping[str, str], figure: str = "") -> str:
    """Return a title, a figure and a table of facts as HTML.

    Args:
        title: text of the first line.
        facts: name -> value, one row each.
        figure: HTML between the title and the table, such as `plotting.curve_svg` returns.
    """
    cell = "text-align:left;vertical-align:top;padding:1px 12px 1px 0"
    table = "margin:4px 0;table-layout:auto"  # notebooks would centre it
    rows = "".join(
        f'<tr><th scope="row" style="{cell};white-space:nowrap">{escape(name)}</th>'
        f'<td style="{cell}">{escape(value)}</td></tr>'
        for name, value in facts.items()
    )
    return (
        f'<div style="max-width:{_WIDEST}px"><strong>{escape(title)}</strong>{figure}'
        f'<table style="{table}">{rows}</table></div>'
    )
