"""Constants of cells, items and windows, shared by layouts, rules and observations.

A cell (x, y) has column x and row y, from the top left corner; the cell's number is y * width + x.
"""

from __future__ import annotations

import numpy as np

from icrl4aht_data.overcooked.actions import ACTIONS

EMPTY, WALL, GOAL, POT, INDICATOR, BUTTON, PLATES, PILE = range(8)
"""Kinds of cells. A wall that an agent can face is a counter for one item; PLATES and PILE never run out."""

FACINGS = ("up", "down", "right", "left")
"""Names of the facings; the position is the facing's number and the order of the observation's channels."""

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
"""Position of the observing agent's cell in the window, in reading order."""

NOWHERE = 255
"""Value in lookup tables for a missing cell, such as one outside the window; the largest byte."""

CANONICAL_TYPES = 4
"""Number of ingredient types with canonical channels: ids 0 to 3, which the published layouts use."""
