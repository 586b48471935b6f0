"""Draw fixtures, recipes and start cells for given rooms, and check that agents can deliver the recipes.

Shapes: `H` rows, `W` columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement, product
from string import digits

import numpy as np

from icrl4aht_generation.layouts.grids import neighbours, rows_of

MORE_FIXTURES = (4, 6)
"""Minimum and maximum number of additional fixtures, beyond those that a dish needs (piles, plates, pot and goal)."""

FREE_COUNTERS = 2
"""Minimum number of counters without a fixture; small rooms get fewer fixtures instead."""

LayoutDraw = tuple[tuple[str, ...], tuple[tuple[int, int, int], ...], bool]
"""Arguments of a `Layout` after its names: map, recipes, and whether the layout has a delivery indicator."""

_INGREDIENT_IDS = 4  # ingredients 0 to 3 have canonical channels
_MOST = {"P": 3, "L": 2}  # maximum numbers of pots and of buttons; other fixtures have no limit
_ARRANGEMENTS = 60  # maximum number of tries to place the chosen fixtures


def needs_no_handover(grid: np.ndarray, reach: np.ndarray, recipes: Sequence[tuple[int, int, int]]) -> bool:
    """Return whether two agents in separate rooms can deliver every recipe without handing items over on counters.

    The scripted experts require that one agent does everything, or that one agent only cooks, in pots that both agents
    reach, and the other agent only serves.

    Args:
        grid: the map, str (H, W).
        reach: bool (2, H, W), cells that each agent can face.
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

    A cell is left out if it is the only access to a pot, or to all fixtures of a kind that a recipe needs. Every pot
    counts, because the scripted expert may wait for a blocked pot. The room must stay connected if one cell is blocked.

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
    """Return the cells that each agent can face, given the floors of their rooms; both are bool of shape (2, H, W)."""
    return np.stack([neighbours(room) & ~room for room in rooms])


def furnish_rooms(rooms: np.ndarray, rng: np.random.Generator) -> LayoutDraw | None:
    """Return a layout with the given rooms and random fixtures, recipes and start cells.

    The scripted experts can deliver soups on the layout, see `needs_no_handover` and `waiting_cells`. In a shared room,
    one agent starts on one of the `waiting_cells`.

    Args:
        rooms: bool (2, H, W), the floor of each agent; equal floors if the agents share a room.
        rng: random number generator.

    Returns:
        The layout, or None if the rooms have too few walls, or no arrangement was found.
    """
    reach = faced_cells(rooms)
    walls = np.flatnonzero(reach.any(axis=0))
    fixtures, recipes = _draw_fixtures(len(walls), rng)
    if len(fixtures) + FREE_COUNTERS > len(walls):
        return None
    grid, shared = np.where(rooms.any(axis=0), " ", "W"), np.array_equal(*rooms)
    for _ in range(_ARRANGEMENTS):
        grid.flat[walls] = "W"
        grid.flat[rng.permutation(walls)[: len(fixtures)]] = fixtures
        first = waiting_cells(grid, rooms[0], recipes) if shared else np.flatnonzero(rooms[0])
        if len(first) and (shared or needs_no_handover(grid, reach, recipes)):
            start = rng.choice(first)
            second = np.flatnonzero(rooms[1])
            grid.flat[[start, rng.choice(second[second != start])]] = "A"
            return rows_of(grid), recipes, bool(rng.integers(2))
    return None


def _draw_fixtures(walls: int, rng: np.random.Generator) -> tuple[list[str], tuple[tuple[int, int, int], ...]]:
    """Return letters of random fixtures, and random recipes: 2 to 4 for two ingredients, or 2 to 10 for three."""
    types = sorted(rng.choice(_INGREDIENT_IDS, rng.integers(2, 4), replace=False).tolist())
    dishes = list(combinations_with_replacement(types, 3))
    chosen = rng.choice(len(dishes), rng.integers(2, len(dishes) + 1), replace=False)
    needed = [*map(str, types), "B", "P", "X"]
    shown = [letter for letter, chance in (("R", 0.6), ("L", 0.3)) if rng.random() < chance]
    more = rng.integers(MORE_FIXTURES[0], MORE_FIXTURES[1] + 1)
    count = max(len(needed), min(len(needed) + more, walls - FREE_COUNTERS))
    fixtures = [*needed, *shown][:count]
    while len(fixtures) < count:
        letter = str(rng.choice([*needed, *shown]))
        if fixtures.count(letter) < _MOST.get(letter, count):
            fixtures.append(letter)
    return fixtures, tuple(dishes[number] for number in sorted(chosen))
