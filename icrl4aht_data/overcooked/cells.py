"""Constants of cells, items and windows, which layouts, rules and observations share.

A cell is (x, y), x = column, y = row, origin top-left; its flat number is y * width + x.
"""

from __future__ import annotations

import numpy as np

from icrl4aht_data.overcooked.actions import ACTIONS

EMPTY, WALL, GOAL, POT, INDICATOR, BUTTON, PLATES, PILE = range(8)
"""Kinds of cells. A wall is a counter for one item; PLATES and PILE never run out."""

FACINGS = ("up", "down", "right", "left")
"""Facing names by number, the order of the observation's facing channels."""

STEP = {"up": (0, -1), "down": (0, 1), "right": (1, 0), "left": (-1, 0)}
"""Facing name -> (dx, dy) to the cell ahead."""

FACING_OF = np.array([FACINGS.index(name) for name in ACTIONS if name in FACINGS])
"""int64 (4,): the facing after a directional action (up, down, left, right)."""

PLATE, COOKED = 1, 2
"""Flag bits of an item byte. The higher bits count the ingredients, two bits each."""

WINDOW = 5
"""Side of the square observation window."""

VISIBLE = WINDOW * WINDOW
"""Number of cells in the window."""

CENTRE = VISIBLE // 2
"""Position in the window, in reading order, of the observing agent's own cell."""

NOWHERE = 255
"""Entry of lookup tables for a cell that is outside the window; also the largest byte."""

CANONICAL_TYPES = 4
"""Number of ingredient types that have canonical channels: ids 0..3, those of the published layouts."""
