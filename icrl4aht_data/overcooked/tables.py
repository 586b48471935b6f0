"""Lookup tables of a layout as a pytree of arrays, which compiled programs take as an argument.

The rules, the observations and the scripted agents read a layout from its tables alone, so one compiled program plays
every layout whose tables have equal shapes. `stack_tables` pads the tables of several layouts to common shapes.

Shapes: `cells` cells of the map, row by row; `P` pots, `L` buttons, `K` counters, `F` floor cells of the larger room,
`R` recipes, `C` own observation channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.cells import (
    BUTTON,
    CANONICAL_TYPES,
    GOAL,
    INDICATOR,
    NOWHERE,
    PILE,
    PLATES,
    POT,
    WALL,
)

if TYPE_CHECKING:
    from icrl4aht_data.overcooked.layouts import Layout

Array = Any
"""A NumPy or JAX array; functions find the library through `__array_namespace__`."""

SEARCH_ORDER = (RIGHT, DOWN, LEFT, UP)
"""Moves in the order in which the published teammates try them: it decides between paths of equal length."""

# Every visible cell is packed into two 32-bit words: lookups move words, and only the last operation writes C
# channels. Bits of the word of the cell: item 0..7, pot timer 8..12, recipe 13..18, delivery 19, static 20..25, and one
# per piled type 26..28. Bits of the word of the agents on it: self 0..12 (position 1, facing 4, hand 8), other 13..25.
TIMER_BIT, RECIPE_BIT, DELIVERY_BIT, FIXED_BIT, _PILES = 8, 13, 19, 20, 26
AGENT_BITS = 13
_STATIC = (WALL, GOAL, POT, INDICATOR, BUTTON, PLATES)


class ChannelBits(NamedTuple):
    """Bits of a visible cell's words that each observation channel shows.

    Attributes:
        shift: uint32 (C,), lowest bit of each channel in its word.
        mask: uint32 (C,), bits of each channel; 0 for channels that the layout does not have, such as an ingredient
            type without a pile.
        of_agents: bool (C,), whether the channel comes from the word of the agents.
    """

    shift: Array
    mask: Array
    of_agents: Array


class Tables(NamedTuple):
    """Lookup tables of one layout, NumPy arrays until a program makes them its argument.

    Attributes:
        kinds: uint8 (cells,), the kind of each cell.
        piles: uint8 (cells,), the item byte taken from a pile, 0 elsewhere.
        column: int32 (cells,), x of each cell.
        row: int32 (cells,), y of each cell.
        walkable: bool (cells,), floor cells that some agent can reach.
        ahead: uint8 (cells, 4), the cell that an agent on a walkable cell faces, by facing; 0 elsewhere.
        faced: int32 (cells, 4), what it faces: kind | pile << 8 | number << 16, where the number counts the cells of
            the same kind: pots, counters or buttons.
        moves: uint8 (cells, 6), the cell after an action if the other agent is not in the way.
        view: int32 (cells, 25), for each agent position and window cell: number of the cell's changing word; from bit 8
            on, the fixed bits of its word, shifted down by FIXED_BIT.
        own: bits of the layout's own channels.
        canonical: bits of the canonical channels; of length 0 if the layout has an ingredient that none of them shows.
        pots: uint8 (P,), cells of the pots in reading order; NOWHERE for a padded one, as in `buttons` and `counters`.
        buttons: uint8 (L,), cells of the buttons.
        counters: uint8 (K,), cells of the walls that some agent can face.
        rooms: uint8 (2, F), ascending: the floor cells that each agent can reach from its start, repeated from the
            first on.
        room_sizes: uint32 (2,), number of cells of each room.
        recipes: uint8 (R,), item bytes of the recipes, repeated from the first on.
        recipe_count: uint32 (), number of recipes.
        ingredients: int32 (3,), ids of the ingredients that have a pile, ascending; -1 for a type without one.
        size: int32 (2,), width and height of the map.
        number: uint8 (cells,), position of a cell in `pots`, `buttons` or `counters`; NOWHERE for other cells.
        near: uint8 (cells,), bit k says whether a cell above, below, left or right is of kind k.
        goal_access: uint8 (A,), floor cells next to a goal; NOWHERE for a padded one.
        stations: float32 (cells,), distance to the mean cell of pots and piles, minus that to the mean cell of goals
            and plates: what the teammates H2 may divide a layout by.
        distance: uint8 (cells, cells), shortest distance between floor cells; NOWHERE if there is no path.
        target_distance: uint8 (cells, cells), distance from a floor cell to the nearest floor cell next to a target;
            NOWHERE if there is no path.
        first_step: uint8 (cells, cells), the action of the first step from one floor cell towards another.
    """

    kinds: Array
    piles: Array
    column: Array
    row: Array
    walkable: Array
    ahead: Array
    faced: Array
    moves: Array
    view: Array
    own: ChannelBits
    canonical: ChannelBits
    pots: Array
    buttons: Array
    counters: Array
    rooms: Array
    room_sizes: Array
    recipes: Array
    recipe_count: Array
    ingredients: Array
    size: Array
    number: Array
    near: Array
    goal_access: Array
    stations: Array
    distance: Array
    target_distance: Array
    first_step: Array


_PADDING = {
    "kinds": WALL,
    "pots": NOWHERE,
    "buttons": NOWHERE,
    "counters": NOWHERE,
    "number": NOWHERE,
    "goal_access": NOWHERE,
    "distance": NOWHERE,
    "target_distance": NOWHERE,
    "first_step": STAY,
    "ingredients": -1,
}
"""Values of padded entries, where they are not 0. A padded cell is a wall that no agent can reach or face."""


def stack_tables(layouts: Sequence[Layout]) -> Tables:
    """Return the tables of several layouts, padded to the largest and stacked on a new first axis.

    Flat cell numbers remain those of each layout, whose map keeps its own width: cells are padded at the end. The
    columns of state records follow the padded numbers of pots, buttons and counters, see `state.columns`. Own channels
    are padded at the end as well, so only layouts with equal channel names give own observations of one meaning.

    Raises:
        OptionError: if there is no layout, or if only some of the layouts have all canonical channels.
    """
    if not layouts:
        raise OptionError("no layouts to stack, expected at least one")
    pots, buttons = max(len(one.pots) for one in layouts), max(len(one.buttons) for one in layouts)
    each = [make_tables(layout, pots, buttons) for layout in layouts]
    without = [layout.name for layout in layouts if layout.ingredient_types > CANONICAL_TYPES]
    if 0 < len(without) < len(layouts):
        raise OptionError(f"layouts {without} have ingredients without a canonical channel, the others do not")

    return stack_padded(each, _PADDING)


def stack_padded(parts: Sequence[Any], padding: Mapping[str, int]) -> Any:
    """Return one named tuple of arrays: those of all parts, padded at the end of each axis, on a new first axis.

    Args:
        parts: named tuples of arrays that differ in the lengths of their axes, or of such named tuples.
        padding: field -> value of padded entries, where it is not 0. An axis "recipes" repeats its last entry, since a
            repeated recipe changes no decision of a scripted agent.
    """

    def stacked(name: str, values: Sequence[Any]) -> Any:
        if isinstance(values[0], tuple):
            return stack_padded(values, padding)
        shape = np.max([value.shape for value in values], axis=0).astype(int)
        if name == "recipes":
            return np.stack([np.pad(value, (0, shape[0] - len(value)), "edge") for value in values])
        found = np.full((len(values), *shape), padding.get(name, 0), values[0].dtype)
        for number, value in enumerate(values):
            found[number, *map(slice, value.shape)] = value
        return found

    fields = zip(type(parts[0])._fields, zip(*parts, strict=True), strict=True)
    return type(parts[0])(*(stacked(name, values) for name, values in fields))


def make_tables(layout: Layout, pots: int | None = None, buttons: int | None = None) -> Tables:
    """Return the tables of a layout; use `Layout.tables`, which caches them.

    Args:
        layout: the layout.
        pots: number of pots of the state records that the tables are for, at least the layout's own.
        buttons: number of buttons of these records.
    """
    ahead, kinds, walkable = layout.ahead, layout.kinds, layout.walkable
    pots, buttons = max(pots or 0, len(layout.pots)), max(buttons or 0, len(layout.buttons))
    number = np.full(layout.cells, NOWHERE, np.uint8)
    for cells in (layout.pots, layout.counters, layout.buttons):
        number[list(cells)] = range(len(cells))
    row, column = np.divmod(np.arange(layout.cells, dtype=np.int32), layout.width)
    beside = _neighbours(layout)
    near = np.bitwise_or.reduce(np.where(beside >= 0, 1 << kinds.astype(int)[beside], 0), axis=1).astype(np.uint8)
    distance, first_step = _search(layout)
    # An index of -1 reads the last cell, which `where` then replaces.
    to_access = np.where((beside >= 0) & walkable[beside], distance[:, beside], NOWHERE).min(axis=-1)
    canonical = CANONICAL_TYPES if layout.ingredient_types <= CANONICAL_TYPES else 0
    rooms = np.zeros((2, max(map(len, layout.rooms))), np.uint8)
    for cells, room in zip(rooms, layout.rooms, strict=True):
        cells[: len(room)] = room
    return Tables(
        kinds=kinds,
        piles=layout.piles,
        column=column,
        row=row,
        walkable=walkable,
        ahead=ahead,
        faced=kinds[ahead] | layout.piles[ahead].astype(np.int32) << 8 | number[ahead].astype(np.int32) << 16,
        moves=layout.moves,
        view=_view(layout, number.astype(int), pots, buttons),
        own=_channel_bits(layout, layout.ingredient_types, layout.indicates_delivery),
        canonical=_channel_bits(layout, canonical, True),
        pots=np.array(layout.pots, np.uint8),
        buttons=np.array(layout.buttons, np.uint8),
        counters=np.array(layout.counters, np.uint8),
        rooms=rooms,
        room_sizes=np.array([len(room) for room in layout.rooms], np.uint32),
        recipes=layout.recipe_items,
        recipe_count=np.array(len(layout.recipes), np.uint32),
        ingredients=np.array((*layout.ingredients, -1, -1, -1)[:3], np.int32),
        size=np.array([layout.width, layout.height], np.int32),
        number=number,
        near=near,
        goal_access=np.flatnonzero(walkable & (near >> GOAL & 1 > 0)).astype(np.uint8),
        stations=_stations(layout, column, row),
        distance=distance,
        target_distance=to_access,
        first_step=first_step,
    )


def _neighbours(layout: Layout) -> np.ndarray:
    """Return int (cells, 4): the cell above, below, left and right of each cell, -1 outside the map."""
    row, column = np.divmod(np.arange(layout.cells)[:, None], layout.width)
    x, y = column + np.array([0, 0, -1, 1]), row + np.array([-1, 1, 0, 0])
    inside = (x >= 0) & (x < layout.width) & (y >= 0) & (y < layout.height)
    return np.where(inside, y * layout.width + x, -1)


def _stations(layout: Layout, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    def distance_to(*kinds: int) -> np.ndarray:
        of = np.isin(layout.kinds, kinds)
        if not of.any():
            return np.zeros(layout.cells)
        return np.abs(column - column[of].mean()) + np.abs(row - row[of].mean())

    return (distance_to(POT, PILE) - distance_to(GOAL, PLATES)).astype(np.float32)


def _search(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return `Tables.distance` and `Tables.first_step`."""
    far, here = np.int32(NOWHERE), np.arange(layout.cells)
    distance = np.where((here[:, None] == here) & layout.walkable, 0, far)
    ends = layout.moves[:, SEARCH_ORDER]  # (cells, 4)
    while True:
        after = distance[ends] + 1  # (cells, 4, cells)
        shorter = np.minimum(distance, after.min(axis=1))
        if np.array_equal(shorter, distance):
            break
        distance = shorter
    # Of the moves that shorten the way the first counts, which is the one that a breadth-first search would find.
    step = np.array(SEARCH_ORDER)[(after == distance[:, None]).argmax(axis=1)]
    return distance.astype(np.uint8), np.where((distance > 0) & (distance < far), step, STAY).astype(np.uint8)


def _view(layout: Layout, number: np.ndarray, pots: int, buttons: int) -> np.ndarray:
    """Return `Tables.view`; `number` int (cells,) counts the pots, the buttons and the counters."""
    words = {INDICATOR: 1, GOAL: 2, POT: 3 + number, BUTTON: 3 + pots + number}
    changing = np.select([layout.kinds == kind for kind in words], list(words.values()), 0)
    changing[list(layout.counters)] = 3 + pots + buttons + np.arange(len(layout.counters))
    fixed = np.zeros(layout.cells, np.int32)
    for bit, kind in enumerate(_STATIC):
        fixed |= (layout.kinds == kind) << bit
    for bit, ingredient in enumerate(layout.ingredients):
        pile = (layout.kinds == PILE) & (layout.piles == layout.ingredient_item(ingredient))
        fixed |= pile.astype(np.int32) << (_PILES - FIXED_BIT + bit)
    # Outside the map both parts are 0: word number 0 is always zero.
    return np.where(layout.window >= 0, (changing | fixed << 8)[layout.window], 0).astype(np.int32)


def _channel_bits(layout: Layout, types: int, delivery: bool) -> ChannelBits:
    """Return the bits of channels for a number of ingredient types, with or without delivery; none for 0 types."""
    order = {ingredient: number for number, ingredient in enumerate(layout.ingredients)}

    def by_type(first: int, width: int, mask: int) -> list[tuple[int, int]]:
        return [(first + width * order[i], mask) if i in order else (0, 0) for i in range(types)]

    def item(first: int) -> list[tuple[int, int]]:
        return [(first, 1), (first + 1, 1), *by_type(first + 2, 2, 3)]

    agent = [(0, 1), *((1 + facing, 1) for facing in range(4)), *item(5)]
    bits = [
        *agent,
        *((AGENT_BITS + shift if mask else 0, mask) for shift, mask in agent),
        *((FIXED_BIT + bit, 1) for bit in range(len(_STATIC))),
        *by_type(_PILES, 1, 1),
        *item(0),
        (0, 0),  # a recipe is neither on a plate nor cooked
        (0, 0),
        *by_type(RECIPE_BIT, 2, 3),
        (TIMER_BIT, 31),
        *([(DELIVERY_BIT, int(layout.indicates_delivery))] if delivery else []),
    ]
    shift, mask = np.array(bits if types else bits[:0], np.uint32).reshape(-1, 2).T
    return ChannelBits(shift, mask, np.arange(len(shift)) < 2 * len(agent))
