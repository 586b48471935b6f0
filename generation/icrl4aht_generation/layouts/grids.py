"""Maps as arrays: rooms, mirror images and rotations, and the form that symmetric maps share.

Shapes: `H` rows, `W` columns. A grid is an array (H, W) of map letters, see `icrl4aht_data.overcooked.layouts`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icrl4aht_data.overcooked.layouts import Layout


def grid_of(layout: Layout) -> np.ndarray:
    """Return the map of a layout, str (H, W)."""
    return np.array([list(row) for row in layout.rows])


def rows_of(grid: np.ndarray) -> tuple[str, ...]:
    """Return a grid's rows as texts, as a layout has them."""
    return tuple("".join(row) for row in grid.tolist())


def neighbours(mask: np.ndarray) -> np.ndarray:
    """Return a mask of the cells next to the cells in `mask`, in four directions; both are bool (H, W)."""
    found = np.zeros_like(mask)
    found[1:] |= mask[:-1]
    found[:-1] |= mask[1:]
    found[:, 1:] |= mask[:, :-1]
    found[:, :-1] |= mask[:, 1:]
    return found


def agent_rooms(layout: Layout) -> np.ndarray:
    """Return the floor that each agent can reach, bool (2, H, W)."""
    rooms = np.zeros((2, layout.cells), bool)
    for room, cells in zip(rooms, layout.rooms, strict=True):
        room[cells] = True
    return rooms.reshape(2, layout.height, layout.width)


def symmetric_images(grid: np.ndarray) -> list[np.ndarray]:
    """Return a grid, its rotations and their mirror images, eight arrays; some may be equal."""
    return [image for turns in range(4) for image in (np.rot90(grid, turns), np.rot90(grid, turns)[:, ::-1])]


@lru_cache(maxsize=64)
def _wide_images(height: int, width: int) -> tuple[np.ndarray, int]:
    """Return the cells of each symmetric image of a map that is not taller than wide, int (images, cells); its width.

    A map that is not square has four such images, and a square one eight.
    """
    images = symmetric_images(np.arange(height * width).reshape(height, width))
    wide = [image for image in images if image.shape[0] <= image.shape[1]]
    return np.stack([image.ravel() for image in wide]), wide[0].shape[1]


def canonical_map(layout: Layout) -> tuple[str, ...]:
    """Return the map of a layout in the form that it shares with all layouts that differ by symmetry only.

    It is the least of the map's mirror images and rotations that are not taller than wide, with starts in the first
    cells of the agents' rooms: an episode starts anywhere in them. Recipes and the delivery indicator do not matter.
    """
    images, width = _wide_images(layout.height, layout.width)
    letters = np.frombuffer("".join(layout.rows).replace("A", " ").encode("ascii"), np.uint8)[images]
    first, second = agent_rooms(layout).reshape(2, -1)[:, images]
    every = np.arange(len(images))
    start = first.argmax(axis=1)
    letters[every, start] = ord("A")
    second[every, start] = False
    letters[every, second.argmax(axis=1)] = ord("A")
    return _least_rows(letters, width)


def canonical_floor(floor: np.ndarray) -> tuple[str, ...]:
    """Return the least of the mirror images and rotations of a floor, bool (H, W), that are not taller than wide."""
    images, width = _wide_images(*floor.shape)
    return _least_rows(np.where(floor.ravel()[images], ord(" "), ord("W")).astype(np.uint8), width)


def _least_rows(images: np.ndarray, width: int) -> tuple[str, ...]:
    """Return the rows of the least of some maps of one width, uint8 (maps, cells)."""
    text = min(image.tobytes() for image in images).decode("ascii")
    return tuple(text[start : start + width] for start in range(0, len(text), width))
