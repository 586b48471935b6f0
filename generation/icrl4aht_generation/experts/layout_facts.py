"""Properties of a layout that the oracle uses, precomputed with NumPy, such as reachable cells and travel times.

Shapes: `cells` cells, `P` pots, `O` obstacles. All times are in steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import FACING_OF, GOAL, NOWHERE, PILE, PLATES, POT, WALL
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Array, Tables, stack_padded

FAR = 1000
"""Steps to a cell that cannot be reached, or not while the teammate blocks the way; stored as NOWHERE."""

NEVER = 10_000
"""Cost of actions that are impossible or undesirable."""


class LayoutFacts(NamedTuple):
    """Precomputed properties of a layout: NumPy arrays, or traced arrays in a compiled function.

    Attributes:
        matters: bool (), whether the ego can serve, or reaches a pot or a counter that the teammate also reaches.
        serves: bool (), whether the ego can plate and deliver soups.
        mate_serves: bool (), whether the teammate can plate and deliver the ego's soups.
        shares_room: bool (), whether both agents can walk on the same cells.
        mine: bool (cells,), cells that the ego can face.
        shared: bool (cells,), cells that both agents can face.
        pots: bool (P,), pots that the ego reaches, of all pots of the layout.
        recipes: uint8 (R,), item bytes of the layout's recipes.
        piles: bool (3, cells), piles of each ingredient that the ego can face.
        passed: bool (P,), pots that are farther from the teammate's piles than another pot of the ego.
        obstacle: uint8 (cells,), index in `ways` for each cell of the teammate; 0 (no obstacle) in separate rooms.
        ways: uint8 (O, cells, cells), steps from each cell until the ego faces each target cell, around an obstacle.
        leg: uint8 (cells, P), steps from facing a cell to facing a pot, without a teammate in the way.
        trip: int32 (P, 3), steps to carry a piece of each ingredient from its pile to a pot and to return.
        hindrance: int16 (3, cells, cells), how much an ego that waits hinders the teammate; see `_hindrance`.
    """

    matters: Array
    serves: Array
    mate_serves: Array
    shares_room: Array
    mine: Array
    shared: Array
    pots: Array
    recipes: Array
    piles: Array
    passed: Array
    obstacle: Array
    ways: Array
    leg: Array
    trip: Array
    hindrance: Array


def stack_facts(layouts: Sequence[Layout]) -> LayoutFacts:
    """Return the `LayoutFacts` of several layouts, padded to the largest and stacked on a new first axis."""
    return stack_padded(
        [compute_layout_facts(layout) for layout in layouts], {"ways": NOWHERE, "leg": NOWHERE, "trip": FAR}
    )


def compute_layout_facts(layout: Layout) -> LayoutFacts:
    """Compute the `LayoutFacts` of one layout."""
    kinds, tables = layout.kinds, layout.tables
    # An agent can use every cell that it can face, so both agents can use a counter between their rooms.
    mine, theirs = (np.isin(np.arange(layout.cells), layout.ahead[room]) for room in layout.rooms)
    shared = mine & theirs
    cells = np.array(layout.pots, int)
    pots = mine[cells]
    serves, mate_serves = (all((here & (kinds == k)).any() for k in (PLATES, GOAL)) for here in (mine, theirs))
    serves, mate_serves = serves and bool(pots.any()), mate_serves and bool(theirs[cells[pots]].any())
    piles = np.zeros((3, layout.cells), bool)
    for number, ingredient in enumerate(layout.ingredients):
        piles[number] = (layout.piles == layout.ingredient_item(ingredient)) & mine
    # A teammate carries ingredients to its nearest pot, so the ego can cook ahead in the other pots.
    their_steps = np.zeros(len(cells), int)
    for pile in np.flatnonzero((kinds == PILE) & theirs):
        for start in np.flatnonzero((layout.ahead == pile).any(axis=1) & layout.walkable):
            their_steps += _steps_or_far(tables.target_distance[start, cells], NEVER)
    passed = their_steps > their_steps[pots].min(initial=NEVER)

    # In separate rooms the teammate never blocks the ego, so one table of walks without an obstacle is enough.
    shares_room = np.array_equal(*layout.rooms)
    obstacles = np.array([-1, *(layout.rooms[EGO] if shares_room else [])], int)
    number = np.zeros(layout.cells, np.uint8)
    number[obstacles[1:]] = range(1, len(obstacles))
    ways = _shortest_walks(layout, obstacles)
    leg = np.full((layout.cells, layout.cells), FAR)
    room = layout.rooms[EGO]
    from_facing = np.where(
        layout.ahead[room][:, :, None] == np.arange(layout.cells), 0, _steps_or_far(ways[0, room], FAR)[:, None]
    )
    np.minimum.at(leg, layout.ahead[room], from_facing)
    trip = np.where(piles[:, :, None], leg + leg.T + 2, FAR).min(axis=1).T[cells]
    return LayoutFacts(
        matters=np.array(serves or np.isin(kinds[shared], [POT, WALL]).any()),
        serves=np.array(serves),
        mate_serves=np.array(mate_serves),
        shares_room=np.array(shares_room),
        mine=mine,
        shared=shared,
        pots=pots,
        recipes=layout.recipe_items,
        piles=piles,
        passed=passed,
        obstacle=number,
        ways=ways,
        leg=np.where(pots, leg[:, cells], NOWHERE).clip(0, NOWHERE).astype(np.uint8),
        trip=trip.astype(np.int32),
        hindrance=_hindrance(layout, tables),
    )


def _steps_or_far(steps: np.ndarray, far: int) -> np.ndarray:
    return np.where(steps == NOWHERE, far, steps.astype(int))


def _shortest_walks(layout: Layout, obstacles: np.ndarray) -> np.ndarray:
    """Return `LayoutFacts.ways`: the steps of the shortest walk from each cell until the ego faces each target cell."""
    room = layout.rooms[EGO].astype(int)
    position = np.zeros(layout.cells, int)  # index of each cell within the ego's room
    position[room] = range(len(room))
    moves = layout.moves[room, :4].astype(int)
    ends = np.where(moves == obstacles[:, None, None], room[:, None], moves)  # shape (O, room, actions)
    steps = _walking_steps(position[ends])
    ways = np.full((len(obstacles), layout.cells, layout.cells), NOWHERE - 1, np.uint8)
    for action in range(4):
        end = ends[..., action]
        faced = layout.ahead[end, FACING_OF[action]].astype(int)
        # Turns and moves are assigned separately: of two values for one entry of `ways`, NumPy would keep only one.
        for walks in (False, True):
            obstacle, start = np.nonzero((end != room) == walks)
            own = obstacle[:, None], room, faced[obstacle, start][:, None]
            ways[own] = np.minimum(ways[own], steps[obstacle, :, start] + 1)
    return np.where(ways == NOWHERE - 1, NOWHERE, ways)


def _walking_steps(ends: np.ndarray) -> np.ndarray:
    """Return the steps between all pairs of cells of a room, or NOWHERE - 2 for cells that cannot be reached.

    Args:
        ends: index within the room of the cell that each move leads to, int of shape (O, room, actions).

    Returns:
        uint8 array of shape (O, room, room).
    """
    steps = np.where(np.eye(ends.shape[1], dtype=bool), 0, np.uint8(NOWHERE - 2))
    steps = np.tile(steps.astype(np.uint8), (len(ends), 1, 1))
    each = np.arange(len(ends))[:, None]
    total = None
    while total != (total := int(steps.sum())):  # repeat until no walk becomes shorter
        for action in range(ends.shape[2]):  # updating in place between actions halves the number of passes
            after = np.minimum(steps[each, ends[..., action]], NOWHERE - 3)
            np.minimum(steps, after + 1, out=steps)
    return steps


def _hindrance(layout: Layout, tables: Tables) -> np.ndarray:
    """Return how much the ego would hinder the teammate by waiting on a cell, int16 of shape (3, cells, cells).

    The axes are what the teammate carries (0 a dish, 1 a plate or an ingredient, 2 nothing), the teammate's cell, and
    the ego's cell. The next cell of each route that the teammate may take counts 16, the neighbours of this cell 8, and
    cells in front of goals, pots, piles and plates 4.
    """
    # The teammate's target is unknown: any cell where the teammate could use what it carries may be the target.
    used = np.isin(layout.kinds, [GOAL, POT, PILE, PLATES])[layout.ahead].any(axis=1) & layout.walkable
    hindrance = np.tile(4 * used, (3, layout.cells, 1)).astype(np.int16)
    near = (8 * np.maximum(2 - tables.distance.astype(int), 0)).astype(np.int16)
    for carries, kinds in enumerate([[GOAL], [POT], [PILE, PLATES]]):
        ends = np.flatnonzero(np.isin(layout.kinds, kinds)[layout.ahead].any(axis=1) & layout.walkable)
        for mate in layout.rooms[TEAMMATE]:
            steps = tables.first_step[mate, ends[ends != mate]]
            hindrance[carries, mate] += near[layout.moves[mate, steps]].sum(axis=0, dtype=np.int16)
    return hindrance
