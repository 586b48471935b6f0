"""Maps as arrays: rooms, mirror images, rotations, and a canonical form of maps that differ only by symmetry.

Shapes: `H` rows, `W` columns. A grid is an array of shape (H, W) with the letters of a map, see
`icrl4aht_data.overcooked.layouts`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icrl4aht_data.overcooked.layouts import Layout


def grid_of(layout: Layout) -> np.ndarray:
    """Return the map of a layout as an array of letters, of shape (H, W)."""
    return np.array([list(row) for row in layout.rows])


def rows_of(grid: np.ndarray) -> tuple[str, ...]:
    """Return the rows of a grid as strings, in the form of `Layout.rows`."""
    return tuple("".join(row) for row in grid.tolist())


def neighbours(mask: np.ndarray) -> np.ndarray:
    """Return a mask of the cells above, below, left and right of cells in `mask`; both are bool of shape (H, W)."""
    found = np.zeros_like(mask)
    found[1:] |= mask[:-1]
    found[:-1] |= mask[1:]
    found[:, 1:] |= mask[:, :-1]
    found[:, :-1] |= mask[:, 1:]
    return found


def agent_rooms(layout: Layout) -> np.ndarray:
    """Return the floor cells that each agent can reach, bool of shape (2, H, W)."""
    rooms = np.zeros((2, layout.cells), bool)
    for room, cells in zip(rooms, layout.rooms, strict=True):
        room[cells] = True
    return rooms.reshape(2, layout.height, layout.width)


def symmetric_images(grid: np.ndarray) -> list[np.ndarray]:
    """Return eight arrays: a grid in its four rotations, and their mirror images. Some of them may be equal."""
    return [image for turns in range(4) for image in (np.rot90(grid, turns), np.rot90(grid, turns)[:, ::-1])]


@lru_cache(maxsize=64)
def _wide_images(height: int, width: int) -> tuple[np.ndarray, int]:
    """Return the cell numbers of a map's symmetric images that are not taller than wide, and the images' width.

    The cell numbers are int of shape (images, cells). A square map has eight such images, any other map four.
    """
    images = symmetric_images(np.arange(height * width).reshape(height, width))
    wide = [image for image in images if image.shape[0] <= image.shape[1]]
    return np.stack([image.ravel() for image in wide]), wide[0].shape[1]


def canonical_map(layout: Layout) -> tuple[str, ...]:
    """Return the canonical map of a layout, which is equal for all layouts that differ only by symmetry.

    The result is the alphabetically first mirror image or rotation that is not taller than wide. Start cells are moved
    to the first cells of the agents' rooms, because episodes start anywhere in a room. Recipes and the delivery
    indicator have no influence.
    """
    images, width = _wide_images(layout.height, layout.width)
    letters = np.frombuffer("".join(layout.rows).replace("A", " ").encode("ascii"), np.uint8)[images]
    first, second = agent_rooms(layout).reshape(2, -1)[:, images]
    every = np.arange(len(images))
    start = first.argmax(axis=1)
    letters[every, start] = ord("A")
    second[every, start] = False
    letters[every, second.argmax(axis=1)] = ord("A")
    return _first_map(letters, width)


def canonical_floor(floor: np.ndarray) -> tuple[str, ...]:
    """Return the rows of the alphabetically first symmetric image of a floor that is not taller than wide.

    Args:
        floor: bool of shape (H, W).
    """
    images, width = _wide_images(*floor.shape)
    return _first_map(np.where(floor.ravel()[images], ord(" "), ord("W")).astype(np.uint8), width)


def _first_map(images: np.ndarray, width: int) -> tuple[str, ...]:
    """Return the rows of the alphabetically first of several maps.

    Args:
        images: letters of the maps, uint8 of shape (maps, cells).
        width: width of all maps.
    """
    text = min(image.tobytes() for image in images).decode("ascii")
    return tuple(text[start : start + width] for start in range(0, len(text), width))
