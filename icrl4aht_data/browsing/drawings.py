"""Conversion of states to lists of shapes, which a page can draw without knowing the game."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from icrl4aht_data.overcooked.drawing import FOOTER, PAPER, VIEW, Canvas, Colour, state_parts
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size

_DIGITS = 3  # decimals of coordinates, in cells

Drawings = dict[str, dict[str, list]]
"""Name of a part -> values of its columns, joined by commas -> shapes, see `layout_drawings`."""


class ShapeRecorder(Canvas):
    """Canvas that records shapes as lists: the kind of shape, then the arguments of the method of `Canvas`.

    Attributes:
        shapes: ["box", x, y, width, height, fill, radius], ["disc", x, y, radius, fill, part],
            ["line", thickness, fill, x, y, x, y, ...], ["frame", left, top, right, bottom, thickness, fill] or
            ["text", x, y, words, size, fill, anchor, room]; a fill is a colour such as "#2b303a".
    """

    def __init__(self) -> None:
        self.shapes: list[list[Any]] = []

    def box(self, x: float, y: float, width: float, height: float, fill: Colour, radius: float = 0) -> None:
        self._add("box", x, y, width, height, hex_colour(fill), radius)

    def disc(self, x: float, y: float, radius: float, fill: Colour, part: float = 1) -> None:
        self._add("disc", x, y, radius, hex_colour(fill), part)

    def line(self, points: Sequence[tuple[float, float]], thickness: float, fill: Colour) -> None:
        self._add("line", thickness, hex_colour(fill), *(value for point in points for value in point))

    def frame(self, corners: Sequence[float], thickness: float, fill: Colour) -> None:
        self._add("frame", *corners, thickness, hex_colour(fill))

    def text(
        self, x: float, y: float, words: str, size: float, fill: Colour, anchor: str = "mm", room: float = 99
    ) -> None:
        self._add("text", x, y, words, size, hex_colour(fill), anchor, room)

    def _add(self, kind: str, *values: Any) -> None:
        self.shapes.append([kind, *(value if isinstance(value, str) else _rounded(value) for value in values)])


def _rounded(value: float) -> float:
    short = round(float(value), _DIGITS)
    return int(short) if short.is_integer() else short


def _distinct(rows: np.ndarray) -> list[list[int]]:
    """Return the distinct rows of uint8 (N, K); much faster than `np.unique` for few columns."""
    if len(rows) == 1:
        return rows.tolist()
    found = np.zeros((256,) * rows.shape[1], bool)
    found[tuple(rows.T)] = True
    return np.argwhere(found).tolist()


def hex_colour(colour: Colour) -> str:
    """Return a colour in CSS notation, such as #2b303a."""
    return "#" + bytes(colour).hex()


def add_drawings(layout: Layout, records: np.ndarray, known: Drawings) -> Drawings:
    """Add the drawings that states need to `known`, and return those that it did not have.

    Args:
        layout: the layout.
        records: state records uint8 (N, S).
        known: drawings so far.
    """
    new: Drawings = {}
    for part in state_parts(layout):
        of_part = known.setdefault(part.name, {})
        for values in _distinct(records[:, list(part.columns)]):
            key = ",".join(map(str, values))
            if key not in of_part:
                recorder = ShapeRecorder()
                part.draw(recorder, 0.0, 0.0, *values)
                of_part[key] = new.setdefault(part.name, {})[key] = recorder.shapes
    return new


def layout_drawings(layout: Layout, records: np.ndarray) -> dict[str, Any]:
    """Return a JSON object with the shapes that a page needs to draw these states of a layout.

    Args:
        layout: the layout.
        records: state records uint8 (N, S).

    Returns:
        width, height: of the map, in cells; footer: height of the strip below it; paper: colour of the background.
        record_size: S.
        view: name of the part that outlines the cells that the ego observes.
        parts: [name, moves, anchor, columns] of each part, in drawing order, see `StatePart`.
        drawings: name of a part -> values of its columns, joined by commas -> shapes relative to the centre of the
            cell, see `ShapeRecorder`; only for values in the records.
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
