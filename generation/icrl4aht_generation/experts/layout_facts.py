"""What the oracle knows of a layout before it starts: reach, ways and their times, where it would be in the way. NumPy.

Shapes: `P` pots that the ego reaches, `O` obstacles. All times are in steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrl4aht_data.overcooked.actions import EGO, INTERACT, TEAMMATE
from icrl4aht_data.overcooked.cells import FACING_OF, GOAL, PILE, PLATES, POT
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.paths import Paths

FAR = 1000
"""Time to a cell that cannot be reached, or only when the teammate steps aside."""

NEVER = 10_000
"""Cost of what cannot or should not be done."""


class LayoutFacts(NamedTuple):
    """Knowledge of a layout, computed before the ego starts. NumPy.

    Attributes:
        paths: the layout's shortest paths.
        mine: bool (cells,), cells that the ego can face.
        shared: bool (cells,), cells that both agents can face.
        serves: whether the ego can plate and deliver.
        mate_serves: whether the teammate can plate and deliver the ego's soups.
        pots: int (P,), numbers of the pots.
        pot_cells: int (P,), their cells.
        piles: bool (types, cells), piles of each ingredient that the ego can face.
        passed: bool (P,), pots that the teammate, walking from its piles, leaves for a nearer one.
        obstacles: int (O,), cells where a teammate can be in the way; the first is -1, nowhere, and the only one if
            the agents' rooms are apart.
        time: int32 (O, cells, 4, cells), steps until the ego, on a cell with a facing, faces another cell.
        action: int32 (O, cells, 4, cells), first action of that way; INTERACT if it faces the cell already.
        leg: int32 (cells, cells), steps from facing one cell to facing another, without a teammate in the way.
        trip: int32 (P, types), steps to carry a piece from its pile to a pot and to return.
    """

    paths: Paths
    mine: np.ndarray
    shared: np.ndarray
    serves: bool
    mate_serves: bool
    pots: np.ndarray
    pot_cells: np.ndarray
    piles: np.ndarray
    passed: np.ndarray
    obstacles: np.ndarray
    time: np.ndarray
    action: np.ndarray
    leg: np.ndarray
    trip: np.ndarray


def study_layout(layout: Layout) -> LayoutFacts:
    paths, kinds = Paths(layout), layout.kinds
    # Reach is what the agents can face, not where they can stand: counters between two rooms belong to both.
    mine, theirs = (np.isin(np.arange(layout.cells), layout.ahead[room]) for room in layout.rooms)
    shared = mine & theirs
    pots = np.array([k for k, cell in enumerate(layout.pots) if mine[cell]], int)
    pot_cells = np.array(layout.pots, int)[pots]
    serves, mate_serves = (all((here & (kinds == k)).any() for k in (PLATES, GOAL)) for here in (mine, theirs))
    serves, mate_serves = serves and len(pots) > 0, mate_serves and bool(theirs[pot_cells].any())
    piles = (layout.piles == np.array([layout.ingredient_item(i) for i in layout.ingredients])[:, None]) & mine
    # A teammate that carries ingredients to its nearest pot leaves the others free for soups in advance.
    starts = paths.access[(kinds == PILE) & theirs].ravel()
    their_way = paths.target_distance[starts[starts >= 0]][:, pot_cells].sum(axis=0)
    passed = their_way > their_way.min(initial=NEVER)

    # In a room of its own the ego never meets the teammate, so one table of ways without an obstacle is enough.
    obstacles = np.array([-1, *(layout.rooms[EGO] if np.array_equal(*layout.rooms) else [])], int)
    time, action = _shortest_ways(layout, obstacles)
    leg = np.full((layout.cells, layout.cells), FAR, np.int32)
    np.minimum.at(leg, layout.ahead[layout.rooms[EGO]], time[0, layout.rooms[EGO]])
    trip = np.where(piles[:, :, None], leg + leg.T + 2, FAR).min(axis=1).T[pot_cells]
    return LayoutFacts(
        paths, mine, shared, serves, mate_serves, pots, pot_cells, piles, passed, obstacles, time, action, leg, trip
    )


def _shortest_ways(layout: Layout, obstacles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `LayoutFacts.time` and `LayoutFacts.action`, by relaxing all ways until none becomes shorter."""
    count, cells, room = len(obstacles), layout.cells, layout.rooms[EGO]
    time = np.full((count, cells, 4, cells), FAR, np.int32)
    for facing in range(4):  # ways end where a cell is faced, so turning counts as a step, like walking
        time[:, room, facing, layout.ahead[room, facing]] = 0
    ends = np.repeat(layout.moves[None, :, :4].astype(int), count, axis=0)  # (O, cells, actions)
    ends = np.where(ends == obstacles[:, None, None], np.arange(cells)[:, None], ends)
    while True:  # the tables are small, and are computed once per layout
        after = time[np.arange(count)[:, None, None], ends, FACING_OF]  # (O, cells, actions, cells)
        shorter = np.minimum(time, after.min(axis=2, keepdims=True) + 1)
        if np.array_equal(shorter, time):
            return time, np.where(time == 0, INTERACT, after.argmin(axis=2)[:, :, None]).astype(np.int32)
        time = shorter


def hindrance_table(paths: Paths) -> np.ndarray:
    """Return how much the ego would hinder the teammate by waiting on a cell, int32 (3, teammate's cell, ego's cell).

    The first axis is what the teammate carries: a dish, a plate or an ingredient, or nothing. The next cell of each way
    that the teammate may be taking counts 16, cells next to that one 8, and cells from which something other than a
    counter is used 4.
    """
    layout = paths.layout
    # The ego cannot know where the teammate goes: all cells where it can use what it carries count.
    used = np.isin(layout.kinds, [GOAL, POT, PILE, PLATES])[layout.ahead].any(axis=1) & layout.walkable
    hindrance = np.tile(4 * used, (3, layout.cells, 1)).astype(np.int32)
    for carries, kinds in enumerate([[GOAL], [POT], [PILE, PLATES]]):
        ends = {int(cell) for cell in paths.access[np.isin(layout.kinds, kinds)].ravel() if cell >= 0}
        for mate in layout.rooms[TEAMMATE]:
            for end in ends - {int(mate)}:
                ahead = layout.moves[mate, paths.first_step[mate, end]]
                hindrance[carries, mate] += 8 * np.maximum(2 - paths.distance[ahead], 0)
    return hindrance
