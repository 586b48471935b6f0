"""Pictures of state records, for people: a frame as an array or PNG, an episode as an animated GIF.

Positions and lengths are in cells, (0, 0) is the map's top left corner. Drawn enlarged, then reduced, for smooth edges.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked import layouts
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import COOKED, PLATE, WINDOW, Layout
from icrl4aht_data.overcooked.state import BUTTON_STEPS, POT_STEPS, faults, record_size, unpack
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.new_file import MARK

if TYPE_CHECKING:
    from PIL import Image

_ENLARGE, _FOOTER, _SMALLEST_CELL, _GIF_COLOURS = (
    4,
    0.8,
    16,
    127,
)  # and one transparent colour for pixels that do not change

_INK, _STEEL, _DARK_STEEL, _WHITE = (43, 48, 58), (124, 133, 146), (58, 64, 75), (255, 255, 255)
_FLOOR, _FAR_WALL, _PAPER = ((248, 245, 238), (239, 234, 224)), (199, 193, 184), (255, 252, 240)
_COUNTER, _COUNTER_TOP, _CRATE, _CRATE_INSIDE = (168, 131, 92), (205, 171, 130), (133, 92, 54), (92, 62, 38)
_HEAT, _READY, _LAMP, _PLATE_RIM = (255, 140, 40), (67, 190, 95), (255, 205, 40), (160, 178, 200)
_CHEF = {EGO: (33, 104, 222), TEAMMATE: (213, 33, 53)}
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
"""ingredient id -> its edge colour and the strokes that draw it within a radius of 1, see `_Canvas.strokes`."""
_OTHER_INGREDIENT = (_INK, (1.6, _STEEL, (0, 0)))


def draw_frame(
    layout: Layout, record: np.ndarray, *, cell: int = 48, caption: str = "", view: bool = True
) -> np.ndarray:
    """Return a picture of one state: ego blue, teammate red, a footer with the current recipe and a one-line caption.

    Args:
        layout: the layout.
        record: state record uint8 (S,).
        cell: side of a map cell in pixels, at least 16.
        caption: text for the footer; a long one gets a smaller font.
        view: whether to outline the cells that the ego observes.

    Returns:
        uint8 (height, width, 3), RGB: `cell` pixels per row and column of the map, and a footer of 0.8 cells below.

    Raises:
        OptionError: if Pillow is missing, the record has another shape or dtype or impossible values, or `cell` is too
            small.
    """
    return np.array(_picture(layout, _checked(layout, record, 1, cell), cell, caption, view))


def save_frame(path: str | Path, layout: Layout, record: np.ndarray, **options: Any) -> None:
    """Write the picture of one state as PNG; record uint8 (S,), options and errors as in `draw_frame`."""
    frame = draw_frame(layout, record, **options)
    with atomic_write(Path(path)) as partial:
        _pillow()[0].fromarray(frame).save(partial, format="PNG")


def save_episode(
    path: str | Path,
    layout: Layout,
    records: np.ndarray,
    rewards: np.ndarray | None = None,
    *,
    cell: int = 32,
    fps: int = 8,
) -> None:
    """Write an episode as a GIF of T frames that loops endlessly. The file appears complete or not at all.

    Args:
        path: the file to write.
        layout, records, rewards, cell, fps: see `encode_episode`, also for the errors.
    """
    content = encode_episode(layout, records, rewards, cell=cell, fps=fps)
    with atomic_write(Path(path)) as partial:
        partial.write_bytes(content)


def encode_episode(
    layout: Layout, records: np.ndarray, rewards: np.ndarray | None = None, *, cell: int = 32, fps: int = 8
) -> bytes:
    """Return an episode as the content of a GIF file of T frames that loops endlessly.

    Args:
        layout: the layout.
        records: state records uint8 (T, S) in order.
        rewards: real (T,), the reward of the step from each record; the captions then show the return so far.
        cell: side of a map cell in pixels, at least 16.
        fps: frames per second, 1 to 50.

    Raises:
        OptionError: as in `draw_frame`, if there is no record, or if rewards or fps do not fit.
    """
    records = _checked(layout, records, 2, cell)
    rewards = np.full(len(records), np.nan) if rewards is None else np.asarray(rewards)
    _require(rewards.shape == (len(records),), f"rewards ({len(records)},), one a record", rewards.shape)
    _require(1 <= fps <= 50, "fps from 1 to 50", fps)
    frames, earned = [], 0.0
    for step, (record, reward) in enumerate(zip(records, rewards.tolist(), strict=True)):
        caption = f"step {step}" if math.isnan(reward) else f"step {step}   return {earned:g}"
        frames.append(_picture(layout, record, cell, caption, True))
        earned += reward
    colours, dither = _shared_palette(frames), _pillow()[0].Dither.NONE
    first, *rest = (frame.quantize(palette=colours, dither=dither) for frame in frames)
    other = {"duration": round(1000 / fps), "loop": 0, "comment": MARK.encode()}
    palette = bytes(colours.getpalette() or [])  # passed explicitly, it is written once instead of once per frame
    content = BytesIO()
    first.save(content, format="GIF", save_all=True, append_images=rest, palette=palette, optimize=True, **other)
    return content.getvalue()


def _pillow():
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise OptionError("drawing needs Pillow: pip install 'icrl4aht-data[plot]'") from error
    return Image, ImageDraw, ImageFont


def _require(fulfilled: bool, expected: str, found: object) -> None:
    if not fulfilled:
        raise OptionError(f"expected {expected}, found {found}")


def _checked(layout: Layout, records: np.ndarray, dimensions: int, cell: int) -> np.ndarray:
    records, size = np.asarray(records), record_size(layout)
    fits = records.dtype == np.uint8 and records.ndim == dimensions and records.shape[-1] == size and records.size > 0
    expected = f"uint8 ({size},)" if dimensions == 1 else f"uint8 (T, {size})"
    _require(fits, f"{expected} for layout {layout.name}", f"{records.dtype} {records.shape}")
    wrong = faults(layout, records)
    _require(not wrong, f"possible states of layout {layout.name}", "; ".join(wrong))
    _require(cell >= _SMALLEST_CELL, f"cell of at least {_SMALLEST_CELL} pixels", cell)
    return records


def _shared_palette(frames: list[Image.Image]) -> Image.Image:
    """The colours that are most frequent in any single frame, so that a colour of few frames is kept."""
    most = Counter()
    for frame in frames:
        most |= Counter({colour: count for count, colour in frame.getcolors(frame.width * frame.height) or []})
    palette = _pillow()[0].new("P", (1, 1))
    palette.putpalette([value for colour, _ in most.most_common(_GIF_COLOURS) for value in colour])
    return palette


@lru_cache(maxsize=32)
def _font(pixels: int) -> Any:
    return _pillow()[2].load_default(pixels)


class _Canvas:
    """An enlarged picture with methods that draw shapes in units of cells."""

    def __init__(self, width: float, height: float, cell: int) -> None:
        image, draw, _ = _pillow()
        self.unit = cell * _ENLARGE
        self.image = image.new("RGB", (round(width * cell) * _ENLARGE, round(height * cell) * _ENLARGE), _PAPER)
        self.pen = draw.Draw(self.image)

    def box(self, x: float, y: float, width: float, height: float, fill: tuple, radius: float = 0) -> None:
        left, top, wide, high = (self.unit * v for v in (x - width / 2, y - height / 2, width, height))
        self.pen.rounded_rectangle((left, top, left + wide - 1, top + high - 1), self.unit * radius, fill)

    def disc(self, x: float, y: float, radius: float, fill: tuple, part: float = 1) -> None:
        """A disc, or the first `part` (0..1) of one, clockwise from the top."""
        bounds = [self.unit * v for v in (x - radius, y - radius, x + radius, y + radius)]
        self.pen.pieslice(bounds, -90, 360 * part - 90, fill)

    def strokes(self, parts: Iterable, x: float, y: float, size=1.0, turn=(1.0, 0.0), edge=None, rim=0.0) -> None:
        """Lines with round ends, or discs, (thickness, fill, *points), within one rim of the colour `edge`.

        The points are relative to (x, y), in units of `size`; their first axis points to `turn`.
        """
        for colour, grow in ((edge, 2 * rim), (None, 0)) if edge else ((None, 0),):
            for thick, fill, *points in parts:
                turned = [(a * turn[0] - b * turn[1], a * turn[1] + b * turn[0]) for a, b in points]
                ends = [(x + size * a, y + size * b) for a, b in turned]
                wide = size * (thick + grow)
                self.pen.line([self.unit * v for end in ends for v in end], colour or fill, round(self.unit * wide))
                for end in ends:
                    self.disc(*end, wide / 2, colour or fill)

    def text(self, x: float, y: float, words: str, size: float, fill: tuple, anchor="mm", room: float = 99) -> None:
        """Text, smaller than `size` where that is wider than `room`."""
        width = self.pen.textlength(words, _font(round(self.unit * size))) / self.unit
        font = _font(max(1, int(self.unit * size * room / max(room, width))))
        self.pen.text((self.unit * x, self.unit * y), words, fill, font, anchor, stroke_width=round(font.size / 40))


def _picture(layout: Layout, record: np.ndarray, cell: int, caption: str, view: bool) -> Image.Image:
    canvas = _Canvas(layout.width, layout.height + _FOOTER, cell)
    state = unpack(layout, record)
    recipe = _contents(layout, int(state.recipe))
    for position in range(layout.cells):
        _draw_fixture(canvas, layout, position, recipe, bool(state.delivered))
    for position, item, timer in zip(layout.pots, state.pot_items.tolist(), state.pot_timers.tolist(), strict=True):
        _draw_pot(canvas, *_centre(layout, position), _contents(layout, item), timer, item & COOKED > 0)
    for position, timer in zip(layout.buttons, state.buttons.tolist(), strict=True):
        _draw_button(canvas, *_centre(layout, position), recipe, timer)
    for position, item in zip(layout.counters, state.counters.tolist(), strict=True):
        _draw_item(canvas, layout, item, *_centre(layout, position), 0.33)
    if view:
        _draw_view(canvas, layout, int(state.positions[EGO]))
    for agent in (EGO, TEAMMATE):
        _draw_chef(canvas, layout, agent, *(int(field[agent]) for field in state[:3]))
    middle = layout.height + _FOOTER / 2
    canvas.text(0.15, middle, "Recipe", 0.34, _INK, "lm")
    for number, ingredient in enumerate(recipe):
        _draw_ingredient(canvas, ingredient, 1.56 + 0.42 * number, middle, 0.2)
    canvas.text(layout.width - 0.15, middle, caption, 0.34, _INK, "rm", room=layout.width - 2.9)
    return canvas.image.reduce(_ENLARGE)


def _centre(layout: Layout, cell: int) -> tuple[float, float]:
    return cell % layout.width + 0.5, cell // layout.width + 0.5


def _contents(layout: Layout, item: int) -> list[int]:
    """The ingredient ids in an item byte, with repeats, ascending."""
    return [i for i in layout.ingredients for _ in range(item // layout.ingredient_item(i) & 3)]


def _draw_fixture(canvas: _Canvas, layout: Layout, cell: int, recipe: list[int], delivered: bool) -> None:
    """The constant part of a cell; under pots and buttons only the counter."""
    (x, y), kind = _centre(layout, cell), layout.kinds[cell]
    floor, far_wall = kind == layouts.EMPTY, kind == layouts.WALL and cell not in layout.counters
    canvas.box(x, y, 1, 1, _FLOOR[int(x + y) % 2] if floor else _FAR_WALL if far_wall else _COUNTER)
    if floor or far_wall:
        return
    canvas.box(x, y, 0.94, 0.94, _COUNTER_TOP, 0.08)
    if kind == layouts.GOAL:  # a serving bell, its hatch lit in the step after a correct delivery
        hatch = _LAMP if delivered else _READY
        canvas.box(x, y, 0.88, 0.88, hatch, 0.08)
        canvas.strokes([(0.56, _WHITE, (0, 0.12)), (0.12, _WHITE, (0, -0.2))], x, y)
        canvas.box(x, y + 0.28, 0.6, 0.3, hatch)
        canvas.strokes([(0.07, _WHITE, (-0.3, 0.2), (0.3, 0.2))], x, y)
    elif kind == layouts.INDICATOR:
        canvas.box(x, y, 0.86, 0.86, _INK, 0.08)
        canvas.box(x, y, 0.74, 0.74, _PAPER, 0.04)
        _draw_trio(canvas, recipe, x, y, 0.17)
    elif kind == layouts.PLATES:
        for lift in (0.14, 0.07, 0, -0.07):
            _draw_item(canvas, layout, PLATE, x, y + lift, 0.32)
    elif kind == layouts.PILE:
        canvas.box(x, y, 0.86, 0.86, _CRATE, 0.06)
        canvas.box(x, y, 0.7, 0.7, _CRATE_INSIDE, 0.03)
        for dx, dy in ((-0.16, -0.16), (0.16, -0.16), (-0.16, 0.16), (0.16, 0.16)):
            _draw_item(canvas, layout, int(layout.piles[cell]), x + dx, y + dy, 0.2)


def _draw_pot(canvas: _Canvas, x: float, y: float, contents: list[int], timer: int, cooked: bool) -> None:
    """A pot: free slots as rings; while cooking an orange rim and the steps left; when cooked green with a tick."""
    canvas.box(x, y, 0.9, 0.9, _DARK_STEEL, 0.08)
    canvas.strokes([(0.12, _STEEL, (-0.4, 0), (0.4, 0))], x, y - 0.05)
    canvas.disc(x, y - 0.05, 0.38, _READY if cooked else _STEEL)
    if timer:
        canvas.disc(x, y - 0.05, 0.38, _HEAT, 1 - timer / POT_STEPS)
    canvas.disc(x, y - 0.05, 0.31, _INK)
    _draw_trio(canvas, contents, x, y - 0.08, 0.14, empty=_STEEL)
    if timer:
        canvas.box(x, y + 0.26, 0.5, 0.34, _HEAT, 0.1)
        canvas.text(x, y + 0.26, str(timer), 0.34, _WHITE)
    if cooked:
        tick = (0.06, _WHITE, (-0.08, 0), (-0.02, 0.07), (0.09, -0.07))
        canvas.strokes([(0.4, _WHITE, (0, 0)), (0.34, _READY, (0, 0)), tick], x, y + 0.25)


def _draw_button(canvas: _Canvas, x: float, y: float, recipe: list[int], timer: int) -> None:
    """A knob with a question mark; while lit a lamp with the recipe, whose ring shows the time left."""
    canvas.box(x, y, 0.88, 0.88, _DARK_STEEL, 0.2)
    canvas.disc(x, y, 0.42, _LAMP, timer / BUTTON_STEPS)
    canvas.disc(x, y, 0.35, _PAPER if timer else _STEEL)
    if timer:
        _draw_trio(canvas, recipe, x, y, 0.15)
    else:
        canvas.text(x, y, "?", 0.5, _WHITE)


def _draw_item(canvas: _Canvas, layout: Layout, item: int, x: float, y: float, radius: float) -> None:
    """An item byte: nothing, one ingredient, or a plate with its content."""
    contents = _contents(layout, item)
    if item & PLATE:
        for part, colour in ((1, _PLATE_RIM), (0.88, _WHITE), (0.7, _PLATE_RIM), (0.62, _WHITE)):
            canvas.disc(x, y, radius * part, colour)
        _draw_trio(canvas, contents, x, y, radius * 0.42)
    elif contents:
        _draw_ingredient(canvas, contents[0], x, y, radius * 0.85)


def _draw_trio(canvas: _Canvas, contents: list[int], x: float, y: float, radius: float, empty=None) -> None:
    """Up to three ingredients in a triangle, and rings of the colour `empty` in the free slots."""
    for number, (dx, dy) in enumerate(((0, -0.95), (-1.02, 0.75), (1.02, 0.75))):
        centre = (x + dx * radius, y + dy * radius)
        if number < len(contents):
            _draw_ingredient(canvas, contents[number], *centre, radius)
        elif empty:
            canvas.disc(*centre, radius * 0.8, empty)
            canvas.disc(*centre, radius * 0.6, _INK)


def _draw_ingredient(canvas: _Canvas, ingredient: int, x: float, y: float, radius: float) -> None:
    edge, *parts = _INGREDIENTS.get(ingredient, _OTHER_INGREDIENT)
    canvas.strokes(parts, x, y, radius, edge=edge, rim=0.12)


def _draw_view(canvas: _Canvas, layout: Layout, cell: int) -> None:
    """The outline of the ego's window, clipped to the map."""
    x, y = _centre(layout, cell)
    reach = WINDOW / 2
    corners = np.clip([x - reach, y - reach, x + reach, y + reach], 0, [layout.width, layout.height] * 2)
    for thick, colour in ((0.1, _WHITE), (0.065, _CHEF[EGO])):
        canvas.pen.rectangle((canvas.unit * corners).tolist(), outline=colour, width=round(canvas.unit * thick))


def _draw_chef(canvas: _Canvas, layout: Layout, agent: int, cell: int, facing: int, hand: int) -> None:
    """A chef from above: coat in the agent's colour, white hat; eyes, arms and the item in hand point forward."""
    x, y = _centre(layout, cell)
    front_x, front_y = _centre(layout, int(layout.ahead[cell, facing]))
    forward = front_x - x, front_y - y
    body = [
        (0.42, _CHEF[agent], (-0.16, -0.2), (-0.16, 0.2)),
        *((0.15, _CHEF[agent], (-0.1, 0.33 * side), (0.26, 0.27 * side)) for side in (-1, 1)),
        *((0.16, _SKIN, (0.34, 0.24 * side)) for side in (-1, 1)),
        (0.43, _SKIN, (0.03, 0)),
        *((0.075, _INK, (0.17, 0.08 * side)) for side in (-1, 1)),
    ]
    hat = [
        *((0.2, _WHITE, (0.13 * a, 0.13 * b)) for a, b in [*_AROUND, (0, 0)]),
        *((0.025, _PLEAT, (0.06 * a, 0.06 * b), (0.15 * a, 0.15 * b)) for a, b in _AROUND),
    ]
    canvas.strokes(body, x, y, turn=forward, edge=_CHEF_EDGE[agent], rim=0.03)
    canvas.strokes(hat, x - 0.12 * forward[0], y - 0.12 * forward[1], turn=forward, edge=_PLEAT, rim=0.02)
    _draw_item(canvas, layout, hand, x + 0.38 * forward[0], y + 0.38 * forward[1], 0.24)
