"""Draws the parts of a state (cells, pots, buttons, items, chefs) as a list of primitive shapes, see `Canvas`.

`render` draws the shapes as pixels; a web page draws the shapes from JSON, see `browsing.drawings`. Positions and
lengths are in cells, and (0, 0) is the top left corner of the map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.overcooked import cells
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import COOKED, FACINGS, PLATE, STEP, WINDOW
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import BUTTON_STEPS, POT_STEPS, columns, record_size

Colour = tuple[int, int, int]
"""Colour as red, green and blue, each from 0 to 255."""

FOOTER = 0.8
"""Height, in cells, of the strip below the map that shows the recipe."""

AGENT_COLOURS = {EGO: (33, 104, 222), TEAMMATE: (213, 33, 53)}
"""Colour of each agent's coat."""

INK, _STEEL, _DARK_STEEL, _WHITE = (43, 48, 58), (124, 133, 146), (58, 64, 75), (255, 255, 255)
_FLOOR, _FAR_WALL, PAPER = ((248, 245, 238), (239, 234, 224)), (199, 193, 184), (255, 252, 240)
_COUNTER, _COUNTER_TOP, _CRATE, _CRATE_INSIDE = (168, 131, 92), (205, 171, 130), (133, 92, 54), (92, 62, 38)
_HEAT, _READY, _LAMP, _PLATE_RIM = (255, 140, 40), (67, 190, 95), (255, 205, 40), (160, 178, 200)
_CHEF_EDGE = {EGO: (17, 58, 133), TEAMMATE: (122, 14, 27)}
_SKIN, _PLEAT, _LEAF, _GOLD = (250, 214, 180), (196, 204, 216), (62, 132, 60), (246, 190, 50)

_AROUND = [(math.cos(k * math.tau / 7), math.sin(k * math.tau / 7)) for k in range(7)]
_INGREDIENTS = {
    0: (  # an onion
        (176, 120, 20),
        *((0.12, _GOLD, (0, -0.95), (x, -0.3)) for x in (-0.36, 0, 0.36)),
        *((0.06, _GOLD, (0, 0.8), (x, 0.95)) for x in (-0.3, 0, 0.3)),
        (1.4, _GOLD, (-0.12, 0.14), (0.12, 0.14)),
        *((0.13, (255, 228, 145), (x, -0.4), (3 * x, 0.1), (x, 0.6)) for x in (-0.14, 0.14)),
    ),
    1: (  # a tomato
        (150, 36, 18),
        (1.6, (240, 84, 48), (0, 0.08)),
        *((0.22, _LEAF, (0, -0.45), end) for end in ((-0.45, -0.55), (0.45, -0.55), (0, -0.9))),
    ),
    2: (_LEAF, *((0.7, (140, 205, 85), (0.5 * x, 0.5 * y)) for x, y in _AROUND), (0.8, (196, 235, 140), (0, 0))),
    3: (  # an aubergine
        (66, 28, 96),
        (0.62, (165, 95, 205), (-0.3, 0.32), (0.35, -0.3)),
        (0.92, (165, 95, 205), (-0.28, 0.3)),
        (0.36, (90, 170, 80), (0.48, -0.44), (0.72, -0.7)),
    ),
}
"""Drawing of each ingredient by id: edge colour, then strokes within a radius of 1, see `Canvas.strokes`."""
_OTHER_INGREDIENT = (INK, (1.6, _STEEL, (0, 0)))


class Canvas:
    """Records drawn shapes in a list, with positions and lengths in cells.

    Attributes:
        shapes: ("box", x, y, width, height, fill, radius), ("disc", x, y, radius, fill, part),
            ("line", thickness, fill, x, y, x, y, ...), ("frame", left, top, right, bottom, thickness, fill) or
            ("text", x, y, words, size, fill, anchor, max_width), in drawing order.
    """

    def __init__(self) -> None:
        self.shapes: list[tuple[Any, ...]] = []

    def box(self, x: float, y: float, width: float, height: float, fill: Colour, radius: float = 0) -> None:
        """Add a filled rectangle with centre (x, y) and rounded corners."""
        self.shapes.append(("box", x, y, width, height, fill, radius))

    def disc(self, x: float, y: float, radius: float, fill: Colour, part: float = 1) -> None:
        """Add a disc, or only the fraction `part` of the disc, clockwise from the top."""
        self.shapes.append(("disc", x, y, radius, fill, part))

    def line(self, points: Sequence[tuple[float, float]], thickness: float, fill: Colour) -> None:
        """Add a line with round ends through the points; a single point gives a disc."""
        self.shapes.append(("line", thickness, fill, *(value for point in points for value in point)))

    def frame(self, corners: Sequence[float], thickness: float, fill: Colour) -> None:
        """Add a border just inside the rectangle (left, top, right, bottom)."""
        self.shapes.append(("frame", *corners, thickness, fill))

    def text(
        self, x: float, y: float, words: str, size: float, fill: Colour, anchor: str = "mm", max_width: float = 99
    ) -> None:
        """Add text, shrunk if it is wider than `max_width`; `anchor` is a text anchor of Pillow, such as "mm"."""
        self.shapes.append(("text", x, y, words, size, fill, anchor, max_width))

    def strokes(
        self,
        parts: Iterable,
        x: float,
        y: float,
        size: float = 1.0,
        turn: tuple[float, float] = (1.0, 0.0),
        edge: Colour | None = None,
        rim: float = 0.0,
    ) -> None:
        """Add lines or discs, each given as (thickness, fill, *points), with a common outline of colour `edge`.

        The points are relative to (x, y), in units of `size`, and rotated so that the x-axis points along `turn`.
        """
        for colour, grow in ((edge, 2 * rim), (None, 0)) if edge else ((None, 0),):
            for thick, fill, *points in parts:
                turned = [(a * turn[0] - b * turn[1], a * turn[1] + b * turn[0]) for a, b in points]
                ends = [(x + size * a, y + size * b) for a, b in turned]
                self.line(ends, size * (thick + grow), colour or fill)


class StatePart(NamedTuple):
    """One drawn part of a state, such as a pot or a chef.

    Attributes:
        name: name of the part; on one layout, parts with the same name and values look the same.
        moves: whether the position of the part depends on the state.
        anchor: number of the part's cell; for a moving part, the column of the state record that contains the cell.
        columns: columns of the state record that determine what the part looks like.
        draw: function of a canvas, the coordinates of the cell's centre, and the values in `columns`.
    """

    name: str
    moves: bool
    anchor: int
    columns: tuple[int, ...]
    draw: Callable[..., None]


VIEW = "view"
"""Name of the part that draws an outline around the cells that the ego observes."""


@lru_cache(maxsize=32)
def state_parts(layout: Layout) -> tuple[StatePart, ...]:
    """Return the parts that make up the picture of any state of a layout, in drawing order."""
    at, number = columns(layout), np.arange(record_size(layout))
    ego = int(number[at.positions][EGO])
    parts = []
    for cell, kind in enumerate(layout.kinds.tolist()):
        shown, draw = (), partial(_draw_constant, layout, cell)
        if kind == cells.INDICATOR:
            shown, draw = (at.recipe,), partial(_draw_indicator, layout)
        elif kind == cells.GOAL:
            shown, draw = (at.delivered,), _draw_goal
        parts.append(StatePart(f"cell {cell}", False, cell, shown, draw))
    for cell, *pair in zip(layout.pots, number[at.pot_items].tolist(), number[at.pot_timers].tolist(), strict=True):
        parts.append(StatePart("pot", False, cell, tuple(pair), partial(_draw_pot, layout)))
    for cell, timer in zip(layout.buttons, number[at.buttons].tolist(), strict=True):
        parts.append(StatePart("button", False, cell, (at.recipe, timer), partial(_draw_button, layout)))
    for cell, item in zip(layout.counters, number[at.counters].tolist(), strict=True):
        parts.append(StatePart("counter", False, cell, (item,), partial(_draw_item, layout, radius=0.33)))
    parts.append(StatePart(VIEW, True, ego, (ego,), partial(_draw_view, layout)))
    for agent, name in ((EGO, "ego"), (TEAMMATE, "teammate")):
        position, facing, hand = (int(number[field][agent]) for field in at[:3])
        parts.append(StatePart(name, True, position, (facing, hand), partial(_draw_chef, layout, agent)))
    lowest = layout.cells - layout.width  # first cell of the last row; the footer is below this row
    parts.append(StatePart("recipe", False, lowest, (at.recipe,), partial(_draw_footer, layout)))
    return tuple(parts)


def cell_centre(layout: Layout, cell: int) -> tuple[float, float]:
    """Return the coordinates (x, y) of a cell's centre."""
    return cell % layout.width + 0.5, cell // layout.width + 0.5


def item_contents(layout: Layout, item: int) -> list[int]:
    """Return the ids of the ingredients in an item byte, ascending, with one entry per piece."""
    return [i for i in layout.ingredients for _ in range(item // layout.ingredient_item(i) & 3)]


def _draw_constant(layout: Layout, cell: int, canvas: Canvas, x: float, y: float) -> None:
    """Draw the constant part of a cell: floor, a wall or a pile, or the counter under a pot or a button."""
    kind, odd = layout.kinds[cell], (cell % layout.width + cell // layout.width) % 2
    if kind == cells.EMPTY:
        canvas.box(x, y, 1, 1, _FLOOR[1 - odd])
    elif kind == cells.WALL and cell not in layout.counters:
        canvas.box(x, y, 1, 1, _FAR_WALL)
    else:
        _draw_counter(canvas, x, y)
    if kind == cells.PLATES:
        for lift in (0.14, 0.07, 0, -0.07):
            _draw_item(layout, canvas, x, y + lift, PLATE, radius=0.32)
    elif kind == cells.PILE:
        canvas.box(x, y, 0.86, 0.86, _CRATE, 0.06)
        canvas.box(x, y, 0.7, 0.7, _CRATE_INSIDE, 0.03)
        for dx, dy in ((-0.16, -0.16), (0.16, -0.16), (-0.16, 0.16), (0.16, 0.16)):
            _draw_item(layout, canvas, x + dx, y + dy, int(layout.piles[cell]), radius=0.2)


def _draw_counter(canvas: Canvas, x: float, y: float) -> None:
    canvas.box(x, y, 1, 1, _COUNTER)
    canvas.box(x, y, 0.94, 0.94, _COUNTER_TOP, 0.08)


def _draw_goal(canvas: Canvas, x: float, y: float, delivered: int) -> None:
    """Draw the goal as a serving bell, which is lit in the step after a correct delivery."""
    hatch = _LAMP if delivered else _READY
    _draw_counter(canvas, x, y)
    canvas.box(x, y, 0.88, 0.88, hatch, 0.08)
    canvas.strokes([(0.56, _WHITE, (0, 0.12)), (0.12, _WHITE, (0, -0.2))], x, y)
    canvas.box(x, y + 0.28, 0.6, 0.3, hatch)
    canvas.strokes([(0.07, _WHITE, (-0.3, 0.2), (0.3, 0.2))], x, y)


def _draw_indicator(layout: Layout, canvas: Canvas, x: float, y: float, recipe: int) -> None:
    _draw_counter(canvas, x, y)
    canvas.box(x, y, 0.86, 0.86, INK, 0.08)
    canvas.box(x, y, 0.74, 0.74, PAPER, 0.04)
    _draw_contents(canvas, item_contents(layout, recipe), x, y, 0.17)


def _draw_pot(layout: Layout, canvas: Canvas, x: float, y: float, item: int, timer: int) -> None:
    """Draw a pot: rings for missing ingredients, an orange rim and the steps left while cooking, a tick if cooked."""
    contents, cooked = item_contents(layout, item), item & COOKED > 0
    canvas.box(x, y, 0.9, 0.9, _DARK_STEEL, 0.08)
    canvas.strokes([(0.12, _STEEL, (-0.4, 0), (0.4, 0))], x, y - 0.05)
    canvas.disc(x, y - 0.05, 0.38, _READY if cooked else _STEEL)
    if timer:
        canvas.disc(x, y - 0.05, 0.38, _HEAT, 1 - timer / POT_STEPS)
    canvas.disc(x, y - 0.05, 0.31, INK)
    _draw_contents(canvas, contents, x, y - 0.08, 0.14, empty=_STEEL)
    if timer:
        canvas.box(x, y + 0.26, 0.5, 0.34, _HEAT, 0.1)
        canvas.text(x, y + 0.26, str(timer), 0.34, _WHITE)
    if cooked:
        tick = (0.06, _WHITE, (-0.08, 0), (-0.02, 0.07), (0.09, -0.07))
        canvas.strokes([(0.4, _WHITE, (0, 0)), (0.34, _READY, (0, 0)), tick], x, y + 0.25)


def _draw_button(layout: Layout, canvas: Canvas, x: float, y: float, recipe: int, timer: int) -> None:
    """Draw a button: a question mark if unlit, or the recipe in a ring that shows the time left if lit."""
    canvas.box(x, y, 0.88, 0.88, _DARK_STEEL, 0.2)
    canvas.disc(x, y, 0.42, _LAMP, timer / BUTTON_STEPS)
    canvas.disc(x, y, 0.35, PAPER if timer else _STEEL)
    if timer:
        _draw_contents(canvas, item_contents(layout, recipe), x, y, 0.15)
    else:
        canvas.text(x, y, "?", 0.5, _WHITE)


def _draw_item(layout: Layout, canvas: Canvas, x: float, y: float, item: int, *, radius: float) -> None:
    """Draw the item that a byte encodes: nothing, one ingredient, or a plate with its content."""
    contents = item_contents(layout, item)
    if item & PLATE:
        for part, colour in ((1, _PLATE_RIM), (0.88, _WHITE), (0.7, _PLATE_RIM), (0.62, _WHITE)):
            canvas.disc(x, y, radius * part, colour)
        _draw_contents(canvas, contents, x, y, radius * 0.42)
    elif contents:
        _draw_ingredient(canvas, contents[0], x, y, radius * 0.85)


def _draw_contents(canvas: Canvas, contents: list[int], x: float, y: float, radius: float, empty=None) -> None:
    """Draw up to three ingredients in a triangle, with rings of colour `empty` for missing ingredients."""
    for number, (dx, dy) in enumerate(((0, -0.95), (-1.02, 0.75), (1.02, 0.75))):
        centre = (x + dx * radius, y + dy * radius)
        if number < len(contents):
            _draw_ingredient(canvas, contents[number], *centre, radius)
        elif empty:
            canvas.disc(*centre, radius * 0.8, empty)
            canvas.disc(*centre, radius * 0.6, INK)


def _draw_ingredient(canvas: Canvas, ingredient: int, x: float, y: float, radius: float) -> None:
    edge, *parts = _INGREDIENTS.get(ingredient, _OTHER_INGREDIENT)
    canvas.strokes(parts, x, y, radius, edge=edge, rim=0.12)


def _draw_view(layout: Layout, canvas: Canvas, x: float, y: float, cell: int) -> None:
    """Draw the outline of the ego's window, clipped to the map."""
    column, row = cell_centre(layout, cell)
    reach = WINDOW / 2
    visible = np.clip([column - reach, row - reach, column + reach, row + reach], 0, [layout.width, layout.height] * 2)
    corners = visible + [x - column, y - row] * 2
    for thick, colour in ((0.1, _WHITE), (0.065, AGENT_COLOURS[EGO])):
        canvas.frame(corners.tolist(), thick, colour)


def _draw_chef(layout: Layout, agent: int, canvas: Canvas, x: float, y: float, facing: int, hand: int) -> None:
    """Draw an agent as a chef seen from above, in the agent's colour, turned the way the agent faces."""
    forward = STEP[FACINGS[facing]]
    body = [
        (0.42, AGENT_COLOURS[agent], (-0.16, -0.2), (-0.16, 0.2)),
        *((0.15, AGENT_COLOURS[agent], (-0.1, 0.33 * side), (0.26, 0.27 * side)) for side in (-1, 1)),
        *((0.16, _SKIN, (0.34, 0.24 * side)) for side in (-1, 1)),
        (0.43, _SKIN, (0.03, 0)),
        *((0.075, INK, (0.17, 0.08 * side)) for side in (-1, 1)),
    ]
    hat = [
        *((0.2, _WHITE, (0.13 * a, 0.13 * b)) for a, b in [*_AROUND, (0, 0)]),
        *((0.025, _PLEAT, (0.06 * a, 0.06 * b), (0.15 * a, 0.15 * b)) for a, b in _AROUND),
    ]
    canvas.strokes(body, x, y, turn=forward, edge=_CHEF_EDGE[agent], rim=0.03)
    canvas.strokes(hat, x - 0.12 * forward[0], y - 0.12 * forward[1], turn=forward, edge=_PLEAT, rim=0.02)
    _draw_item(layout, canvas, x + 0.38 * forward[0], y + 0.38 * forward[1], hand, radius=0.24)


def _draw_footer(layout: Layout, canvas: Canvas, x: float, y: float, recipe: int) -> None:
    """Draw the current recipe at the left of the strip below the map."""
    left, middle = x - 0.5, y + 0.5 + FOOTER / 2
    canvas.text(left + 0.15, middle, "Recipe", 0.34, INK, "lm", max_width=1.15)
    for number, ingredient in enumerate(item_contents(layout, recipe)):
        _draw_ingredient(canvas, ingredient, left + 1.56 + 0.42 * number, middle, 0.2)
