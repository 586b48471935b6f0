"""Random new rooms: a room that both agents share, two rooms with counters between them, or a ring.

Shapes: `H` rows (at most 9), `W` columns (at most 11).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion, find_objects, label

from icrl4aht_generation.layouts.fixtures import LayoutDraw, furnish_rooms
from icrl4aht_generation.layouts.grids import canonical_floor, neighbours
from icrl4aht_generation.layouts.templates import published_rooms

MOST_ROWS, MOST_COLUMNS = 9, 11

_FEWEST_CELLS = 6  # minimum number of cells in the first rectangle of a shared room


def draw_rooms(seed: int) -> Iterator[LayoutDraw]:
    """Yield layouts with a shared room, two rooms and a ring in turn; no published layout has these rooms."""
    rng = np.random.default_rng([seed, *b"rooms"])
    published = published_rooms(test=False) | published_rooms(test=True)
    while True:
        for draw in (_shared_room, _two_rooms, _ring_room):
            drawn = None
            while drawn is None:
                rooms = np.stack(draw(rng))
                if canonical_floor(rooms[0] | rooms[1]) not in published:
                    drawn = furnish_rooms(rooms, rng)
            yield drawn


def _shared_room(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a shared room of one to three rectangles, perhaps with islands of one counter.

    Neither agent can block the other: rectangles are at least two cells wide and overlap in at least two cells,
    and islands are surrounded by floor.
    """
    floor = np.zeros((MOST_ROWS, MOST_COLUMNS), bool)
    for _ in range(rng.integers(1, 4)):
        while True:
            height, width = rng.integers(2, MOST_ROWS - 1), rng.integers(2, MOST_COLUMNS - 1)
            top, left = rng.integers(1, MOST_ROWS - height), rng.integers(1, MOST_COLUMNS - width)
            block = np.zeros_like(floor)
            block[top : top + height, left : left + width] = True
            if (not floor.any() and block.sum() >= _FEWEST_CELLS) or (floor & block).sum() >= 2:
                break
        floor |= block
    for _ in range(rng.integers(0, 3)):
        surrounded = np.argwhere(binary_erosion(floor, np.ones((3, 3), bool)))
        if len(surrounded):
            floor[tuple(rng.choice(surrounded))] = False
    floor = np.pad(floor[find_objects(floor.astype(int))[0]], 1)  # cropped to the room and a border of walls
    return floor, floor


def _two_rooms(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return two rooms, separated by a line of counters that is straight or bends once by one cell.

    Each room may have a rectangle cut from a corner.
    """
    upright = bool(rng.integers(2))
    rows, columns = (MOST_ROWS, MOST_COLUMNS) if upright else (MOST_COLUMNS, MOST_ROWS)
    while True:
        height, width = rng.integers(2, rows - 1), rng.integers(4, columns - 1)
        border = np.full(height, rng.integers(1, width - 1))
        border[rng.integers(1, height) :] += rng.integers(-1, 2)
        column = np.arange(width)
        left, right = column < border[:, None], column > border[:, None]
        for room in (left, right[:, ::-1]):
            if rng.integers(2):
                deep, wide = rng.integers(1, height // 2 + 1), rng.integers(1, max(2, room[0].sum()))
                room[:: rng.choice((-1, 1))][:deep, :wide] = False
        left, right = np.pad(left, 1), np.pad(right, 1)
        if _is_room(left) and _is_room(right) and (neighbours(left) & neighbours(right)).any():
            return (left, right) if upright else (left.T, right.T)


def _is_room(floor: np.ndarray) -> bool:
    """Return whether a floor has at least two cells, and all of them are connected."""
    connected: Any = label(floor)  # array of component numbers, and number of components
    return floor.sum() > 1 and connected[1] == 1


def _ring_room(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a room around an island of at least two counters; the paths around the island may be one cell wide."""
    while True:
        height, width = rng.integers(3, MOST_ROWS - 1), rng.integers(3, MOST_COLUMNS - 1)
        tall, wide = rng.integers(1, height - 1), rng.integers(1, width - 1)
        if tall * wide > 1:
            break
    floor = np.pad(np.ones((height, width), bool), 1)
    top, left = rng.integers(2, height - tall + 1), rng.integers(2, width - wide + 1)
    floor[top : top + tall, left : left + wide] = False
    return floor, floor
