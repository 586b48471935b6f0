"""Mean returns of the reference egos, and groups of test tasks whose teammates behave the same."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from icrl4aht_data.benchmark.facts import FAMILIES
from icrl4aht_data.utils.text import card_file, markdown_table

REFERENCES = ("stay", "random", "oracle")
"""Names of the reference egos."""

HEURISTICS = FAMILIES[1:]
"""The teammate families of the test tasks."""

_NO_HEADROOM = 1.0  # a pair (layout, family) has headroom if `oracle` earns more than `stay` plus this return

Cell = tuple[str, str]
"""Pair of a layout's short name and a teammate family."""


def read_reference_returns(protocol: str) -> dict[Cell, dict[str, float]]:
    """Return the reference egos' mean returns by (layout, family); empty for a protocol without measurements."""
    content = json.loads(card_file("headroom.json").read_text(encoding="utf-8")).get(protocol, {})
    return {(layout, family): agents for layout, families in content.items() for family, agents in families.items()}


def stay_returns(protocol: str) -> dict[str, float]:
    """Return the mean return of the ego `stay` by task id; empty for a protocol without measurements."""
    return json.loads(card_file("stay.json").read_text(encoding="utf-8")).get(protocol, {})


def same_behaviour_tasks() -> list[list[str]]:
    """Return groups of test task ids; the teammates of the tasks in one group behave the same."""
    return json.loads(card_file("behaviours.json").read_text(encoding="utf-8"))


def has_headroom(references: Mapping[str, float]) -> bool:
    """Return whether the mean return of `oracle` exceeds the mean return of `stay` by more than 1."""
    return references["oracle"] - references["stay"] > _NO_HEADROOM


def cells_without_headroom(cells: Mapping[Cell, Mapping[str, float]], layouts: Sequence[str]) -> list[Cell]:
    """Return the pairs (layout, family) for which the mean return of `oracle` exceeds that of `stay` by at most 1."""
    known = [(layout, family) for layout in layouts for family in HEURISTICS if (layout, family) in cells]
    return [cell for cell in known if not has_headroom(cells[cell])]


def headroom_table(cells: Mapping[Cell, Mapping[str, float]], layouts: Sequence[str]) -> str:
    """Return a Markdown table of the mean returns of `stay`, `random` and `oracle` for each family and layout.

    The table has one row per family and one column per layout; cells with headroom are bold. A line below the table
    lists the cells without headroom.
    """
    rows = [[family, *(_cell_text(cells.get((layout, family))) for layout in layouts)] for family in HEURISTICS]
    flat = ["/".join(cell) for cell in cells_without_headroom(cells, layouts)]
    return f"{markdown_table(['family', *layouts], rows)}\n\nNo headroom: {', '.join(flat) or 'none'}."


def _cell_text(references: Mapping[str, float] | None) -> str:
    if references is None:
        return ""
    text = " / ".join(f"{references[agent]:z.1f}" for agent in REFERENCES)
    return f"**{text}**" if has_headroom(references) else text
