"""Conversion of game states to lists of shapes, which a web page can draw without knowing the game."""

from __future__ import annotations

from typing import Any

import numpy as np

from icrl4aht_data.overcooked.drawing import FOOTER, PAPER, VIEW, Canvas, Colour, state_parts
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size

_DIGITS = 3  # decimal places of coordinates, which are in map cells

Drawings = dict[str, dict[str, list]]
"""Name of a drawn part -> its state values, joined by commas -> shapes; see `layout_drawings`."""


def shape_to_json(shape: tuple[Any, ...]) -> list[str | float]:
    """Return a shape of a `Canvas` as a JSON list; colours become strings such as "#2b303a", numbers are rounded."""
    return [
        value if isinstance(value, str) else hex_colour(value) if isinstance(value, tuple) else _round_coordinate(value)
        for value in shape
    ]


def _round_coordinate(value: float) -> float:
    short = round(float(value), _DIGITS)
    return int(short) if short.is_integer() else short


def _distinct_rows(rows: np.ndarray) -> list[list[int]]:
    """Return the distinct rows of a uint8 array of shape (N, K); for small K, much faster than `np.unique`."""
    if len(rows) == 1:
        return rows.tolist()
    found = np.zeros((256,) * rows.shape[1], bool)
    found[tuple(rows.T)] = True
    return np.argwhere(found).tolist()


def hex_colour(colour: Colour) -> str:
    """Return a colour in CSS notation, such as #2b303a."""
    return "#" + bytes(colour).hex()


def add_drawings(layout: Layout, records: np.ndarray, known: Drawings) -> Drawings:
    """Add the drawings of the given states to `known`, and return only the new drawings.

    Args:
        layout: the layout.
        records: state records, uint8 of shape (N, S).
        known: drawings made so far; extended in place.
    """
    new: Drawings = {}
    for part in state_parts(layout):
        of_part = known.setdefault(part.name, {})
        for values in _distinct_rows(records[:, list(part.columns)]):
            key = ",".join(map(str, values))
            if key not in of_part:
                canvas = Canvas()
                part.draw(canvas, 0.0, 0.0, *values)
                of_part[key] = new.setdefault(part.name, {})[key] = list(map(shape_to_json, canvas.shapes))
    return new


def layout_drawings(layout: Layout, records: np.ndarray) -> dict[str, Any]:
    """Return a JSON object with the shapes that a web page needs to draw the given states of a layout.

    Args:
        layout: the layout.
        records: state records, uint8 of shape (N, S).

    Returns:
        width, height: size of the map in cells; footer: height of the strip below the map; paper: background colour.
        record_size: S, the number of bytes of a state record.
        view: name of the part that outlines the cells that the ego observes.
        parts: [name, moves, anchor, columns] of each part, in drawing order, see `StatePart`.
        drawings: name of a part -> the part's state values, joined by commas -> shapes, see `Canvas`, with coordinates
            relative to the centre of the cell; only for values that occur in the records.
    """
    drawings: Drawings = {}
    add_drawings(layout, records, drawings)
    return {
        "width": layout.width,
        "height": layout.height,
        "footer": FOOTER,
        "paper": hex_colour(PAPER),
        "record_size": record_size(layout),
        "view": VIEW,
        "parts": [[part.name, part.moves, part.anchor, list(part.columns)] for part in state_parts(layout)],
        "drawings": drawings,
    }
