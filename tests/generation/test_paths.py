"""Test tables of shortest paths against the Floyd-Warshall algorithm."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.cells import NOWHERE
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout

SEARCH = (RIGHT, DOWN, LEFT, UP)
DELTA = {UP: (0, -1), DOWN: (0, 1), LEFT: (-1, 0), RIGHT: (1, 0)}


def neighbour(layout: Layout, cell: int, action: int) -> int:
    """Return the adjacent cell in the direction of an action, or -1 outside the map."""
    x, y = cell % layout.width + DELTA[action][0], cell // layout.width + DELTA[action][1]
    return y * layout.width + x if 0 <= x < layout.width and 0 <= y < layout.height else -1


def reference_move(layout: Layout, cell: int, action: int) -> int:
    """Return the cell to which a move leads if no other agent is in the way."""
    target = neighbour(layout, cell, action)
    return target if target >= 0 and "".join(layout.rows)[target] in " A" else cell


@lru_cache
def reference_distances(layout: Layout) -> np.ndarray:
    """Return the shortest-path lengths between floor cells, by Floyd-Warshall, int of shape (cells, cells)."""
    distance = np.full((layout.cells, layout.cells), NOWHERE)
    for cell, letter in enumerate("".join(layout.rows)):
        if letter in " A":
            for action in DELTA:
                distance[cell, reference_move(layout, cell, action)] = 1
            distance[cell, cell] = 0
    for via in range(layout.cells):
        distance = np.minimum(distance, distance[:, via, None] + distance[via])
    return np.minimum(distance, NOWHERE)


def reference_first_step(layout: Layout, origin: int, target: int) -> int:
    """Return the first of the actions right, down, left, up that starts a shortest path."""
    left = reference_distances(layout)[origin, target]
    if left in (0, NOWHERE):
        return STAY
    return next(a for a in SEARCH if reference_distances(layout)[reference_move(layout, origin, a), target] == left - 1)


@pytest.mark.parametrize("name", LAYOUTS)
def test_path_tables_equal_the_floyd_warshall_algorithm(name):
    layout = LAYOUTS[name]
    tables = layout.tables
    np.testing.assert_array_equal(tables.distance, reference_distances(layout))
    first = [[reference_first_step(layout, a, b) for b in range(layout.cells)] for a in range(layout.cells)]
    np.testing.assert_array_equal(tables.first_step, first)
