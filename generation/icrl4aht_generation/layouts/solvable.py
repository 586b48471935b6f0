"""Search for a way in which the agents of a layout can cook and deliver every recipe.

Shapes: `H` rows, `W` columns, `P` pots.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from string import digits

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.layouts.grids import agent_rooms, grid_of, neighbours

_NEEDED = {"X": "a goal", "P": "a pot", "B": "a plate pile"}


def check_solvable(layout: Layout) -> None:
    """Check that the agents of a layout can deliver every recipe.

    Each ingredient has to reach a pot, and the soup of this pot, on a plate, a goal. Agents carry items in their rooms,
    and hand them over on counters that both can face.

    Raises:
        OptionError: if they cannot; says what is missing.
    """
    fault = _delivery_fault(grid_of(layout), faced_cells(agent_rooms(layout)), layout.recipes)
    if fault:
        raise OptionError(f"layout {layout.name}: {fault}; change the map or the recipes")


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


def _delivery_fault(grid: np.ndarray, reach: np.ndarray, recipes: Sequence[tuple[int, int, int]]) -> str | None:
    """Return why some recipe cannot be delivered, or None if each can; for the arguments see `is_easy`."""
    counters = bool((reach.all(axis=0) & (grid == "W")).any())

    def agents_with(letter: str) -> np.ndarray:
        """Return bool (2,), the agents that can face a fixture."""
        return np.logical_or.reduce(reach[:, grid == letter], axis=1)

    def agents_given(agents: np.ndarray) -> np.ndarray:
        """Return bool (2,), the agents that can have an item which some agents, bool (2,), can have."""
        return agents | (counters and agents.any())

    for letter, what in _NEEDED.items():
        if not agents_with(letter).any():
            return f"no agent can face {what}"
    pots = reach[:, grid == "P"]  # (2, P)
    plates, goals = agents_given(agents_with("B")), agents_with("X")
    served = [pot for pot in pots.T if (agents_given(pot & plates) & goals).any()]
    if not served:
        return "no soup can reach a goal on a plate"
    for recipe in recipes:
        available = {ingredient: agents_given(agents_with(str(ingredient))) for ingredient in sorted(set(recipe))}
        for ingredient, agents in available.items():
            if not any((pot & agents).any() for pot in served):
                return f"ingredient {ingredient} cannot reach a pot whose soup can be delivered"
        if not any(all((pot & agents).any() for agents in available.values()) for pot in served):
            return f"the ingredients of recipe {recipe} cannot reach the same pot"
    return None
