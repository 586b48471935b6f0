"""Numbers of actions and of the two agents."""

from __future__ import annotations

ACTIONS = ("up", "down", "left", "right", "stay", "interact")
"""Action names by id (paper, App. D, table of dataset fields)."""

UP, DOWN, LEFT, RIGHT, STAY, INTERACT = range(6)

PUBLISHED_ACTIONS = ("right", "down", "left", "up", "stay", "interact")
"""Action names by their id in the published code's files, which are remapped on reading."""

EGO, TEAMMATE = 0, 1
"""Agent slots. The ego learns or is evaluated (drawn blue); the teammate is fixed and unknown to it (drawn red)."""
