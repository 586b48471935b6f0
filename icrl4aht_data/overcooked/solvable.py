"""Checks that the two agents of a layout can cook and deliver every recipe.

Shapes: `N` cells, `P` pots.
"""

from __future__ import annotations

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.cells import GOAL, PILE, PLATES, POT, WALL
from icrl4aht_data.overcooked.layouts import Layout

_NEEDED = {GOAL: "a goal", POT: "a pot", PLATES: "a plate pile"}


def check_solvable(layout: Layout) -> None:
    """Check that the agents of a layout can deliver every recipe.

    Each ingredient has to reach a pot, and a plate with the soup of this pot has to reach a goal. Agents carry items on
    their reachable floor, and hand over items on counters that both agents can face.

    Raises:
        OptionError: if some recipe cannot be delivered; the message says what is missing.
    """
    if fault := _delivery_fault(layout):
        raise OptionError(f"layout {layout.name}: {fault}; change the map or the recipes")


def _delivery_fault(layout: Layout) -> str | None:
    """Return the reason why some recipe cannot be delivered, or None if all can."""
    reach = np.zeros((2, layout.cells), bool)  # (2, N), True for cells that each agent can face
    for faced, room in zip(reach, layout.rooms, strict=True):
        faced[layout.ahead[room]] = True
    counters = bool((reach.all(axis=0) & (layout.kinds == WALL)).any())

    def agents_facing(fixtures: np.ndarray) -> np.ndarray:
        """Return a mask, bool (2,), of the agents that can face at least one cell of the mask `fixtures`, bool (N,)."""
        return np.any(reach & fixtures, axis=1)

    def agents_that_can_get(agents: np.ndarray) -> np.ndarray:
        """Return a mask, bool (2,): `agents` that can take an item, or both agents if they share counters."""
        return agents | (counters and agents.any())

    for kind, what in _NEEDED.items():
        if not agents_facing(layout.kinds == kind).any():
            return f"no agent can face {what}"
    pots = reach[:, layout.kinds == POT]  # (2, P), True for pots that each agent can face
    plates, goals = agents_that_can_get(agents_facing(layout.kinds == PLATES)), agents_facing(layout.kinds == GOAL)
    served = [pot for pot in pots.T if (agents_that_can_get(pot & plates) & goals).any()]
    if not served:
        return "no soup can reach a goal on a plate"
    for recipe in layout.recipes:
        piles = {one: (layout.kinds == PILE) & (layout.piles == layout.ingredient_item(one)) for one in recipe}
        available = {ingredient: agents_that_can_get(agents_facing(piles[ingredient])) for ingredient in sorted(piles)}
        for ingredient, agents in available.items():
            if not any((pot & agents).any() for pot in served):
                return f"ingredient {ingredient} cannot reach a pot whose soup can be delivered"
        # The ingredients of a recipe may come from different agents, but must all go into the same pot.
        if not any(all((pot & agents).any() for agents in available.values()) for pot in served):
            return f"the ingredients of recipe {recipe} cannot reach the same pot"
    return None
