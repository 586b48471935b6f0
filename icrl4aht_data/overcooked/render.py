"""Pictures of state records: one state as an array of pixels, or an episode as an animated GIF.

Positions and lengths are in cells, and (0, 0) is the top left corner of the map. Pictures are drawn larger than
requested and then reduced, so edges are smooth.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.drawing import FOOTER, INK, PAPER, VIEW, Canvas, cell_centre, state_parts
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import faults, record_size
from icrl4aht_data.utils.files import write_atomically
from icrl4aht_data.utils.install_hints import import_optional
from icrl4aht_data.utils.options import check_int

if TYPE_CHECKING:
    from PIL import Image

_ENLARGE = 4
_GIF_COLOURS = 127  # the 128th palette entry is for transparent pixels, which keep the colour of the previous frame


def draw_frame(
    layout: Layout, record: np.ndarray, *, cell: int = 48, caption: str = "", view: bool = True
) -> np.ndarray:
    """Return a picture of one state: ego blue, teammate red, and a footer with the current recipe and a caption.

    Args:
        layout: the layout.
        record: state record uint8 (S,).
        cell: side of a map cell in pixels, 16 to 128.
        caption: one line of text for the footer; a long text gets a smaller font.
        view: whether to outline the cells that the ego observes.

    Returns:
        RGB image uint8 (height, width, 3), `cell` pixels per row and column of the map, plus a footer of 0.8 cells.

    Raises:
        OptionError: if Pillow is missing, the record has the wrong shape or dtype or impossible values, or `cell` is
            not within 16..128.
    """
    return np.array(_draw_state(layout, _check_records(layout, record, 1, cell), cell, caption, view))


def save_episode(
    path: str | Path,
    layout: Layout,
    records: np.ndarray,
    rewards: np.ndarray | None = None,
    *,
    cell: int = 32,
    fps: int = 8,
) -> None:
    """Write an episode as a GIF of T frames that loops endlessly. The file is written atomically.

    Args:
        path: path of the GIF file.
        layout, records, rewards, cell, fps: arguments of `encode_episode`, which raises the same errors.
    """
    write_atomically(Path(path), encode_episode(layout, records, rewards, cell=cell, fps=fps))


def encode_episode(
    layout: Layout, records: np.ndarray, rewards: np.ndarray | None = None, *, cell: int = 32, fps: int = 8
) -> bytes:
    """Return the content of a GIF file that shows an episode in T frames and loops endlessly.

    Args:
        layout: the layout.
        records: state records uint8 (T, S) in order of time.
        rewards: real (T,), reward of the step that starts at each record; if given, captions show the return so far.
        cell: side of a map cell in pixels, 16 to 128.
        fps: frames per second, 1 to 50.

    Raises:
        OptionError: for the reasons given in `draw_frame`, no records, rewards of the wrong shape, or an invalid fps.
    """
    records = _check_records(layout, records, 2, cell)
    rewards = np.full(len(records), np.nan) if rewards is None else np.asarray(rewards)
    _require(rewards.shape == (len(records),), f"rewards ({len(records)},), one per record", rewards.shape)
    _require(isinstance(fps, (int, float)) and 1 <= fps <= 50, "fps from 1 to 50", repr(fps))
    frames, earned = [], 0.0
    for step, (record, reward) in enumerate(zip(records, rewards.tolist(), strict=True)):
        caption = f"step {step}" if math.isnan(reward) else f"step {step}   return {earned:g}"
        frames.append(_draw_state(layout, record, cell, caption, True))
        earned += reward
    colours, dither = _shared_palette(frames), _import_pillow("Image").Dither.NONE
    first, *rest = (frame.quantize(palette=colours, dither=dither) for frame in frames)
    other = {"duration": round(1000 / fps), "loop": 0}
    palette = bytes(colours.getpalette() or [])  # Pillow writes an explicit palette once instead of once per frame
    content = BytesIO()
    first.save(content, format="GIF", save_all=True, append_images=rest, palette=palette, optimize=True, **other)
    return content.getvalue()


def _import_pillow(module: str) -> Any:
    return import_optional(f"PIL.{module}", "drawing")


def _require(fulfilled: bool, expected: str, found: object) -> None:
    if not fulfilled:
        raise OptionError(f"expected {expected}, found {found}")


def _check_records(layout: Layout, records: np.ndarray, dimensions: int, cell: int) -> np.ndarray:
    records, size = np.asarray(records), record_size(layout)
    fits = records.dtype == np.uint8 and records.ndim == dimensions and records.shape[-1] == size and records.size > 0
    expected = f"uint8 ({size},)" if dimensions == 1 else f"uint8 (T, {size})"
    _require(fits, f"{expected} for layout {layout.name}", f"{records.dtype} {records.shape}")
    wrong = faults(layout, records)
    _require(not wrong, f"possible states of layout {layout.name}", "; ".join(wrong))
    # Smaller cells lose details, and with larger cells an episode takes more than 400 MB of memory.
    _require(16 <= check_int("cell", cell, 0) <= 128, "cell from 16 to 128 pixels", cell)
    return records


def _shared_palette(frames: list[Image.Image]) -> Image.Image:
    """Return a palette for all frames, with the colours that cover the most pixels in any one frame."""
    most = Counter()
    for frame in frames:
        most |= Counter({colour: count for count, colour in frame.getcolors(frame.width * frame.height) or []})
    palette = _import_pillow("Image").new("P", (1, 1))
    palette.putpalette([value for colour, _ in most.most_common(_GIF_COLOURS) for value in colour])
    return palette


@lru_cache(maxsize=32)
def _load_font(pixels: int) -> Any:
    return _import_pillow("ImageFont").load_default(pixels)


class _Picture:
    """Draws the shapes of a `Canvas` in an enlarged Pillow image; each method draws one kind of shape."""

    def __init__(self, width: float, height: float, cell: int) -> None:
        self.unit = cell * _ENLARGE
        size = round(width * cell) * _ENLARGE, round(height * cell) * _ENLARGE
        self.image = _import_pillow("Image").new("RGB", size, PAPER)
        self.pen = _import_pillow("ImageDraw").Draw(self.image)

    def box(self, x: float, y: float, width: float, height: float, fill: tuple, radius: float) -> None:
        left, top, wide, high = (self.unit * v for v in (x - width / 2, y - height / 2, width, height))
        self.pen.rounded_rectangle((left, top, left + wide - 1, top + high - 1), self.unit * radius, fill)

    def disc(self, x: float, y: float, radius: float, fill: tuple, part: float = 1) -> None:
        """Draw a disc, or only the fraction `part` of the disc, clockwise from the top."""
        bounds = [self.unit * v for v in (x - radius, y - radius, x + radius, y + radius)]
        self.pen.pieslice(bounds, -90, 360 * part - 90, fill)

    def line(self, thickness: float, fill: tuple, *points: float) -> None:
        self.pen.line([self.unit * v for v in points], fill, round(self.unit * thickness))
        for x, y in zip(points[::2], points[1::2], strict=True):
            self.disc(x, y, thickness / 2, fill)

    def frame(self, left: float, top: float, right: float, bottom: float, thickness: float, fill: tuple) -> None:
        corners = [self.unit * v for v in (left, top, right, bottom)]
        self.pen.rectangle(corners, outline=fill, width=round(self.unit * thickness))

    def text(self, x: float, y: float, words: str, size: float, fill: tuple, anchor: str, max_width: float) -> None:
        """Draw text, shrunk if it is wider than `max_width`."""
        width = self.pen.textlength(words, _load_font(round(self.unit * size))) / self.unit
        font = _load_font(max(1, int(self.unit * size * max_width / max(max_width, width))))
        self.pen.text((self.unit * x, self.unit * y), words, fill, font, anchor, stroke_width=round(font.size / 40))


def _draw_state(layout: Layout, record: np.ndarray, size: int, caption: str, view: bool) -> Image.Image:
    canvas, picture = Canvas(), _Picture(layout.width, layout.height + FOOTER, size)
    for part in state_parts(layout):
        if view or part.name != VIEW:
            cell = int(record[part.anchor]) if part.moves else part.anchor
            part.draw(canvas, *cell_centre(layout, cell), *(int(record[column]) for column in part.columns))
    middle = layout.height + FOOTER / 2
    canvas.text(layout.width - 0.15, middle, caption, 0.34, INK, "rm", max_width=layout.width - 2.9)
    for kind, *values in canvas.shapes:
        getattr(picture, kind)(*values)
    return picture.image.reduce(_ENLARGE)
