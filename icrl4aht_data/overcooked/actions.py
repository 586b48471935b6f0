"""Ids of the six actions and of the two agents."""

from __future__ import annotations

ACTIONS = ("up", "down", "left", "right", "stay", "interact")
"""Action names by id (paper, App. D, table of dataset fields)."""

UP, DOWN, LEFT, RIGHT, STAY, INTERACT = range(6)

PUBLISHED_ACTIONS = ("right", "down", "left", "up", "stay", "interact")
"""Action names in the order of the published code's ids, which are remapped on reading."""

EGO, TEAMMATE = 0, 1
"""Agent slots. The ego (blue) learns or is evaluated; the teammate (red) has a fixed policy unknown to the ego."""
