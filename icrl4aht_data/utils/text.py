"""Formatting of numbers with nouns, and of HTML tables for notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape


def counted_noun(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun in the singular or plural; the default plural adds an s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def counted_histories(number: int) -> str:
    """Return a number of histories as text, such as "1 history" or "2,000 histories"."""
    return counted_noun(number, "history", "histories")


_LISTED = 10  # most names of a list in a text


def listed_names(names: Sequence[str]) -> str:
    """Return names as text, of many the first ones, such as "a, b and 198 others"."""
    if len(names) <= _LISTED:
        return ", ".join(names)
    return f"{', '.join(names[: _LISTED - 1])} and {len(names) - _LISTED + 1} others"


_WIDEST = 840  # pixels


def facts_html(title: str, facts: Mapping[str, str], figure: str = "") -> str:
    """Return a title, a figure and a table of facts as HTML.

    Args:
        title: text of the first line.
        facts: name -> value, one table row each.
        figure: HTML between the title and the table, for example from `plotting.curve_svg`.
    """
    cell = "text-align:left;vertical-align:top;padding:1px 12px 1px 0"
    table = "margin:4px 0;table-layout:auto"  # notebooks centre tables by default
    rows = "".join(
        f'<tr><th scope="row" style="{cell};white-space:nowrap">{escape(name)}</th>'
        f'<td style="{cell}">{escape(value)}</td></tr>'
        for name, value in facts.items()
    )
    return (
        f'<div style="max-width:{_WIDEST}px"><strong>{escape(title)}</strong>{figure}'
        f'<table style="{table}">{rows}</table></div>'
    )
