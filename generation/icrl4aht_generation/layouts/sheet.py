"""Sheet of pictures of layouts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrl4aht_data.overcooked.layouts import FACINGS, Layout
from icrl4aht_data.overcooked.render import draw_frame
from icrl4aht_data.overcooked.state import start
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_generation.layouts.families import split_of

if TYPE_CHECKING:
    from PIL.Image import Image

_COLUMNS, _CELL = 6, 22  # pictures in a row; pixels of a cell
_GAP, _LINE = 14, 15  # pixels between pictures, and of a line of text
_COLOURS = 128


def save_sheet(path: Path, layouts: Sequence[Layout]) -> None:
    """Write a PNG with a picture of each layout at its start, and its name, split and number of recipes.

    The agents are on their starts, ego blue and teammate red; walls that no agent can face are grey.

    Raises:
        OptionError: if Pillow is missing.
    """
    pictures = [_picture(layout) for layout in layouts]
    from PIL import Image

    columns = min(_COLUMNS, len(layouts))
    rows = [pictures[first : first + columns] for first in range(0, len(pictures), columns)]
    lefts = np.cumsum([_GAP, *(_GAP + max(one.width for one in pictures[k::columns]) for k in range(columns))])
    tops = np.cumsum([_GAP, *(_GAP + max(one.height for one in row) for row in rows)])
    sheet = Image.new("RGB", (int(lefts[-1]), int(tops[-1])), "white")
    for number, picture in enumerate(pictures):
        sheet.paste(picture, (int(lefts[number % columns]), int(tops[number // columns])))
    with atomic_write(path) as partial:
        sheet.quantize(_COLOURS, dither=Image.Dither.NONE).save(partial, format="PNG", optimize=True)


def _picture(layout: Layout) -> Image:
    """Return the picture of one layout with two lines of text below."""
    starts, facing = np.array(layout.agent_cells, np.uint8), np.full(2, FACINGS.index("down"), np.uint8)
    frame = draw_frame(layout, start(layout, starts, facing, layout.recipe_items[0]), cell=_CELL, view=False)
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(12)
    lines = [layout.name, f"{split_of(layout)}, {len(layout.recipes)} recipes"]
    height = layout.height * _CELL  # without the footer, which shows the current recipe
    width = max(layout.width * _CELL, *(round(font.getlength(line)) for line in lines))
    picture = Image.new("RGB", (width, height + len(lines) * _LINE + 4), "white")
    picture.paste(Image.fromarray(frame[:height]))
    pen = ImageDraw.Draw(picture)
    for number, line in enumerate(lines):
        pen.text((0, height + 3 + number * _LINE), line, "black", font)
    return picture
