"""Checks of a map: whether the scripted oracle can deliver its recipes, and where an agent can wait without blocking.

Shapes: `H` rows, `W` columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from string import digits

import numpy as np

from icrl4aht_generation.layouts.grids import neighbours


def is_easy(grid: np.ndarray, reach: np.ndarray, recipes: Sequence[tuple[int, int, int]]) -> bool:
    """Return whether in two rooms one agent can deliver every recipe, or one can only cook and the other only serve.

    The scripted experts need that: they hand nothing over on counters, and cook in each pot that they reach.

    Args:
        grid: the map, str (H, W).
        reach: bool (2, H, W), the cells that each agent can face.
        recipes: triples of ingredient ids.
    """
    ingredients = _ingredient_letters(recipes)
    letters = [set(grid[faced].tolist()) for faced in reach]
    for cook, server in product((0, 1), repeat=2):
        can = letters[cook] >= {"P", *ingredients} and letters[server] >= {"P", "B", "X"}
        pots_shared = not (reach[cook] & ~reach[server] & (grid == "P")).any()
        if can and pots_shared and (cook == server or not letters[server] & set(digits)):
            return True
    return False


def waiting_cells(grid: np.ndarray, room: np.ndarray, recipes: Sequence[tuple[int, int, int]]) -> np.ndarray:
    """Return the cells of a shared room on which one agent can wait while the other delivers every recipe alone.

    Others are the only cell from which a pot, or something else that a recipe needs, can be reached. If there is
    another pot, the scripted expert may still wait for this one. No cell may cut the room in two.

    Args:
        grid: the map, str (H, W).
        room: bool (H, W), the floor of both agents.
        recipes: triples of ingredient ids.

    Returns:
        Flat cell numbers, int (cells,), ascending.
    """
    free = room.copy()
    needed = [grid == letter for letter in ("X", "B", *_ingredient_letters(recipes))]
    for pot in np.flatnonzero(grid == "P"):
        needed.append(np.zeros_like(room))
        needed[-1].flat[pot] = True
    for fixtures in needed:
        access = neighbours(fixtures) & room
        if access.sum() == 1:
            free &= ~access
    return np.flatnonzero(free)


def _ingredient_letters(recipes: Sequence[tuple[int, int, int]]) -> set[str]:
    return {str(ingredient) for recipe in recipes for ingredient in recipe}


def faced_cells(rooms: np.ndarray) -> np.ndarray:
    """Return the cells that each agent can face, bool (2, H, W), from the floors of their rooms, bool (2, H, W)."""
    return np.stack([neighbours(room) & ~room for room in rooms])
