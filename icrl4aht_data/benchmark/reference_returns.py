"""Mean returns of the reference egos, which show where an ego can improve on `stay`, and test tasks that are alike."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from icrl4aht_data.benchmark.facts import FAMILIES
from icrl4aht_data.utils.templates import card_file, markdown_table

REFERENCES = ("stay", "random", "oracle")
"""The reference egos."""

HEURISTICS = FAMILIES[1:]
"""The teammate families of the test tasks."""

_NO_HEADROOM = 1.0  # a cell has headroom if `oracle` exceeds `stay` by more than this

Cell = tuple[str, str]
"""(layout, family)."""


def read_headroom(protocol: str) -> dict[Cell, dict[str, float]]:
    """Return cell -> mean returns of the reference egos; empty if the protocol was not measured."""
    content = json.loads(card_file("headroom.json").read_text(encoding="utf-8")).get(protocol, {})
    return {(layout, family): agents for layout, families in content.items() for family, agents in families.items()}


def stay_returns(protocol: str) -> dict[str, float]:
    """Return task id -> mean return of the ego `stay`; empty if the protocol was not measured."""
    return json.loads(card_file("stay.json").read_text(encoding="utf-8")).get(protocol, {})


def alike_tasks() -> list[list[str]]:
    """Return lists of test task ids; the teammates of the tasks in a list act alike."""
    return json.loads(card_file("behaviours.json").read_text(encoding="utf-8"))


def has_headroom(references: Mapping[str, float]) -> bool:
    """Return whether `oracle` earns over one point more than `stay`."""
    return references["oracle"] - references["stay"] > _NO_HEADROOM


def cells_without_headroom(cells: Mapping[Cell, Mapping[str, float]], layouts: Sequence[str]) -> list[Cell]:
    """Return the cells of some layouts in which `oracle` earns no more than `stay`, by layout and family."""
    known = [(layout, family) for layout in layouts for family in HEURISTICS if (layout, family) in cells]
    return [cell for cell in known if not has_headroom(cells[cell])]


def headroom_table(cells: Mapping[Cell, Mapping[str, float]], layouts: Sequence[str]) -> str:
    """Return a Markdown table of `stay / random / oracle`, and a line that lists the cells without headroom.

    One row per family, one column per layout; cells with headroom are bold.
    """
    rows = [[family, *(_cell_text(cells.get((layout, family))) for layout in layouts)] for family in HEURISTICS]
    flat = ["/".join(cell) for cell in cells_without_headroom(cells, layouts)]
    return f"{markdown_table(['family', *layouts], rows)}\n\nNo headroom: {', '.join(flat) or 'none'}."


def _cell_text(references: Mapping[str, float] | None) -> str:
    if references is None:
        return ""
    text = " / ".join(f"{references[agent]:z.1f}" for agent in REFERENCES)
    return f"**{text}**" if has_headroom(references) else text
