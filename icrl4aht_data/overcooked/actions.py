"""TODO."""

from __future__ import annotations

ACTIONS = ("up", "down", "left", "right", "stay", "interact")
"""Action names in id order (paper, App. D, table of dataset fields)."""


UP, DOWN, LEFT, RIGHT, STAY, INTERACT = range(6)


PUBLISHED_ACTIONS = ("right", "down", "left", "up", "stay", "interact")
"""Action names in the id order of the published code's files; they are remapped on reading."""


EGO, TEAMMATE = 0, 1
"""Seats. The ego learns or is evaluated (drawn blue); the teammate is fixed and unknown (drawn red)."""
