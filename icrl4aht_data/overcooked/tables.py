"""Lookup tables of a layout as a pytree of arrays, which compiled programs take as an argument.

The rules, the observations and the scripted agents read a layout only from its tables, so one compiled program can run
all layouts whose tables have equal shapes. `stack_tables` pads the tables of several layouts to common shapes.

Shapes: `cells` cells of the map, row by row; `P` pots, `L` buttons, `K` counters, `R` recipes, `C` observation
channels, and `F` floor cells that one agent can reach, the larger number of both agents.
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
    CENTRE,
    FACINGS,
    GOAL,
    INDICATOR,
    NOWHERE,
    PILE,
    PLATES,
    POT,
    WALL,
    WINDOW,
)

if TYPE_CHECKING:
    from icrl4aht_data.overcooked.layouts import Layout

Array = Any
"""A NumPy or JAX array; functions find the library through `__array_namespace__`."""

SEARCH_ORDER = (RIGHT, DOWN, LEFT, UP)
"""Order in which the published teammates try moves; the order decides between paths of equal length."""

# Every visible cell is packed into two 32-bit words, so that only the last operation has to write C channels.
# Bits of the first word, the cell: item 0..7, pot timer 8..12, recipe 13..18, delivery 19, kind 20..25, piles 26..28.
# Bits of the second word, the agents: self 0..12 (position 1 bit, facing 4, hand 8), other agent 13..25.
TIMER_BIT, RECIPE_BIT, DELIVERY_BIT, FIXED_BIT, _PILES = 8, 13, 19, 20, 26
AGENT_BITS, CELL_BIT = 13, 20
_KINDS = {"wall": WALL, "goal": GOAL, "pot": POT, "recipe_indicator": INDICATOR, "button": BUTTON, "plate_pile": PLATES}


class ChannelBits(NamedTuple):
    """Bit position of each observation channel in the two packed words of a visible cell.

    Attributes:
        shift: uint32 (C,), lowest bit of each channel in the packed word.
        mask: uint32 (C,), bits of each channel; 0 for channels that the layout does not have, such as an ingredient
            type without a pile.
        of_agents: bool (C,), whether each channel comes from the word of the agents on the cell.
    """

    shift: Array
    mask: Array
    of_agents: Array


class Tables(NamedTuple):
    """Lookup tables of one layout, as NumPy arrays or as array arguments of a compiled program.

    Attributes:
        kinds: uint8 (cells,), the kind of each cell.
        piles: uint8 (cells,), item byte that an agent takes from a pile; 0 for cells without a pile.
        column: int32 (cells,), x of each cell.
        row: int32 (cells,), y of each cell.
        walkable: bool (cells,), floor cells that at least one agent can reach.
        ahead: uint8 (cells, 4), cell in front of an agent, by cell and facing; 0 if the agent's cell is not walkable.
        faced: int32 (cells, 4), properties of the cell in front of an agent: kind | pile << 8 | number << 16, where
            the number is the cell's position in `pots`, `counters` or `buttons`.
        moves: uint8 (cells, 6), an agent's next cell by its cell and action, unless the other agent blocks the move.
        view: int32 (cells, 25), for each agent position and window cell: number of the cell's changing word; from bit 8
            on, the fixed bits of its word, shifted down by FIXED_BIT; from CELL_BIT on, the cell's number, or NOWHERE
            outside the map.
        own: bits of the layout's own channels.
        canonical: bits of the canonical channels; empty if an ingredient of the layout has no canonical channel.
        pots: uint8 (P,), cells of the pots in reading order; padding is NOWHERE, as in `buttons` and `counters`.
        buttons: uint8 (L,), cells of the buttons.
        counters: uint8 (K,), wall cells that at least one agent can face.
        rooms: uint8 (2, F), floor cells that ego and teammate can reach, ascending; padding is 0.
        room_sizes: uint32 (2,), number of floor cells that ego and teammate can reach.
        recipes: uint8 (R,), item bytes of the recipes; padding repeats the last recipe.
        recipe_count: uint32 (), number of recipes without padding.
        ingredients: int32 (3,), ids of the ingredients that have a pile, ascending, filled up with -1.
        size: int32 (2,), width and height of the map.
        number: uint8 (cells,), position of a cell in `pots`, `buttons` or `counters`; NOWHERE for other cells.
        near: uint8 (cells,), bit k says whether a cell above, below, left or right is of kind k.
        goal_access: uint8 (A,), floor cells next to a goal; padding is NOWHERE.
        stations: float32 (cells,), distance to the mean cell of pots and piles minus distance to the mean cell of
            goals and plates; some teammates of family H2 divide the layout between the agents by this value.
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
    **dict.fromkeys(("pots", "buttons", "counters", "number", "goal_access", "distance", "target_distance"), NOWHERE),
    "kinds": WALL,
    "first_step": STAY,
    "ingredients": -1,
}
"""Padding values other than 0, by field. A padded cell is a wall that no agent can reach or face."""


def stack_tables(layouts: Sequence[Layout]) -> Tables:
    """Return the tables of several layouts, padded to the largest and stacked on a new first axis.

    Cells are padded at the end, so the flat cell numbers of each layout do not change. The columns of state records
    follow the padded numbers of pots, buttons and counters, see `state.columns`. Own channels are padded at the end
    too, so the channels of two layouts have the same meaning only if the channel names are equal.

    Raises:
        OptionError: if there is no layout, or if only some of the layouts have ingredients without canonical channels.
    """
    if not layouts:
        raise OptionError("no layouts to stack, expected at least one layout")
    pots, buttons = max(len(one.pots) for one in layouts), max(len(one.buttons) for one in layouts)
    each = [make_tables(layout, pots, buttons) for layout in layouts]
    without = [layout.name for layout in layouts if layout.ingredient_types > CANONICAL_TYPES]
    if 0 < len(without) < len(layouts):
        raise OptionError(
            f"layouts {without} have ingredients without a canonical channel: evaluate or stack these layouts "
            f"separately from the others"
        )

    return stack_padded(each, _PADDING)


def stack_padded(parts: Sequence[Any], padding: Mapping[str, int]) -> Any:
    """Stack named tuples of arrays on a new first axis; arrays are padded at the end of each axis to equal shapes.

    Args:
        parts: named tuples of arrays, possibly nested; the arrays of one field may have different lengths.
        padding: padding values other than 0, by field. The field "recipes" is padded with its last entry, since a
            repeated recipe changes no decision of a scripted agent.
    """

    def stack_field(name: str, values: Sequence[Any]) -> Any:
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
    return type(parts[0])(*(stack_field(name, values) for name, values in fields))


def make_tables(layout: Layout, pots: int | None = None, buttons: int | None = None) -> Tables:
    """Return new lookup tables of a layout; `Layout.tables` caches the tables.

    Args:
        layout: the layout.
        pots: number of pots in the padded state records; None for the layout's number.
        buttons: number of buttons in the padded state records; None for the layout's number.
    """
    ahead, kinds, walkable = layout.ahead, layout.kinds, layout.walkable
    pots, buttons = max(pots or 0, len(layout.pots)), max(buttons or 0, len(layout.buttons))
    number = np.full(layout.cells, NOWHERE, np.uint8)
    for cells in (layout.pots, layout.counters, layout.buttons):
        number[list(cells)] = range(len(cells))
    row, column = np.divmod(np.arange(layout.cells, dtype=np.int32), layout.width)
    # Numbers of the cells above, below, left and right of each cell; -1 outside the map.
    neighbours = layout.window[:, [CENTRE - WINDOW, CENTRE + WINDOW, CENTRE - 1, CENTRE + 1]]
    bits = np.where(neighbours >= 0, 1 << kinds.astype(int)[neighbours], 0)
    near = np.bitwise_or.reduce(bits, axis=1).astype(np.uint8)
    distance, first_step = _shortest_paths(layout)
    # A neighbour of -1 indexes the last cell, but `where` replaces this value.
    to_access = np.where((neighbours >= 0) & walkable[neighbours], distance[:, neighbours], NOWHERE).min(axis=-1)
    canonical = CANONICAL_TYPES if layout.ingredient_types <= CANONICAL_TYPES else 0
    sizes = [len(room) for room in layout.rooms]
    return Tables(
        kinds=kinds,
        piles=layout.piles,
        column=column,
        row=row,
        walkable=walkable,
        ahead=ahead,
        faced=kinds[ahead] | layout.piles[ahead].astype(np.int32) << 8 | number[ahead].astype(np.int32) << 16,
        moves=layout.moves,
        view=_make_view(layout, number.astype(int), pots, buttons),
        own=_channel_bits(layout, layout.ingredient_types, layout.indicates_delivery),
        canonical=_channel_bits(layout, canonical, True),
        pots=np.array(layout.pots, np.uint8),
        buttons=np.array(layout.buttons, np.uint8),
        counters=np.array(layout.counters, np.uint8),
        rooms=np.stack([np.pad(room, (0, max(sizes) - len(room))) for room in layout.rooms]),
        room_sizes=np.array(sizes, np.uint32),
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


def _stations(layout: Layout, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    def distance_to(*kinds: int) -> np.ndarray:
        of = np.isin(layout.kinds, kinds)
        if not of.any():
            return np.zeros(layout.cells)
        return np.abs(column - column[of].mean()) + np.abs(row - row[of].mean())

    return (distance_to(POT, PILE) - distance_to(GOAL, PLATES)).astype(np.float32)


def _shortest_paths(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return the tables `Tables.distance` and `Tables.first_step`."""
    far, here = np.int32(NOWHERE), np.arange(layout.cells)
    distance = np.where((here[:, None] == here) & layout.walkable, 0, far)
    ends = layout.moves[:, SEARCH_ORDER]  # shape (cells, 4)
    while True:
        after = distance[ends] + 1  # shape (cells, 4, cells)
        shorter = np.minimum(distance, after.min(axis=1))
        if np.array_equal(shorter, distance):
            break
        distance = shorter
    # If several moves shorten the path, the first in `SEARCH_ORDER` is taken, as in a breadth-first search.
    step = np.array(SEARCH_ORDER)[(after == distance[:, None]).argmax(axis=1)]
    return distance.astype(np.uint8), np.where((distance > 0) & (distance < far), step, STAY).astype(np.uint8)


def _make_view(layout: Layout, number: np.ndarray, pots: int, buttons: int) -> np.ndarray:
    """Return the table `Tables.view`; `number`, int (cells,), is `Tables.number`."""
    words = {INDICATOR: 1, GOAL: 2, POT: 3 + number, BUTTON: 3 + pots + number}
    changing = np.select([layout.kinds == kind for kind in words], list(words.values()), 0)
    changing[list(layout.counters)] = 3 + pots + buttons + np.arange(len(layout.counters))
    fixed = np.zeros(layout.cells, np.int32)
    for bit, kind in enumerate(_KINDS.values()):
        fixed |= (layout.kinds == kind) << bit
    for bit, ingredient in enumerate(layout.ingredients):
        pile = (layout.kinds == PILE) & (layout.piles == layout.ingredient_item(ingredient))
        fixed |= pile.astype(np.int32) << (_PILES - FIXED_BIT + bit)
    # A position outside the map gets the cell number NOWHERE, and 0 in all other bits.
    packed = changing | fixed << 8 | np.arange(layout.cells) << CELL_BIT
    return np.where(layout.window >= 0, packed[layout.window], NOWHERE << CELL_BIT).astype(np.int32)


def packed_channels(types: int, delivery: bool, layout: Layout | None = None) -> dict[str, tuple[int, int]]:
    """Return the lowest bit and the bit mask of each observation channel in the two packed words of a visible cell.

    Args:
        types: number of ingredient types.
        delivery: whether there is a delivery channel.
        layout: the layout; None if only the names of the channels are needed.

    Returns:
        (lowest bit, mask) by channel name, in the order of the channels; mask 0 for channels that are always 0.
    """
    order = {ingredient: number for number, ingredient in enumerate(layout.ingredients if layout else ())}

    def ingredient_channels(name: str, first: int, width: int, mask: int) -> dict[str, tuple[int, int]]:
        return {f"{name}_{i}": (first + width * order[i], mask) if i in order else (0, 0) for i in range(types)}

    def item_channels(owner: str, first: int) -> dict[str, tuple[int, int]]:
        flags = {f"{owner}_plate": (first, 1), f"{owner}_cooked": (first + 1, 1)}
        return flags | ingredient_channels(f"{owner}_ingredient", first + 2, 2, 3)

    def agent_channels(owner: str, first: int) -> dict[str, tuple[int, int]]:
        facings = {f"{owner}_facing_{facing}": (first + 1 + number, 1) for number, facing in enumerate(FACINGS)}
        return {f"{owner}_position": (first, 1)} | facings | item_channels(owner, first + 5)

    return {
        **agent_channels("self", 0),
        **agent_channels("other", AGENT_BITS),
        **{name: (FIXED_BIT + bit, 1) for bit, name in enumerate(_KINDS)},
        **ingredient_channels("pile", _PILES, 1, 1),
        **item_channels("item", 0),
        **dict.fromkeys(("recipe_plate", "recipe_cooked"), (0, 0)),
        **ingredient_channels("recipe_ingredient", RECIPE_BIT, 2, 3),
        "pot_timer": (TIMER_BIT, 31),
        **({"delivery": (DELIVERY_BIT, int(layout is not None and layout.indicates_delivery))} if delivery else {}),
    }


def _channel_bits(layout: Layout, types: int, delivery: bool) -> ChannelBits:
    """Return the `ChannelBits` of a layout with `types` types of ingredients; there are none if `types` is 0."""
    channels = packed_channels(types, delivery, layout) if types else {}
    shift, mask = np.array(list(channels.values()), np.uint32).reshape(-1, 2).T
    return ChannelBits(shift, mask, np.array([name.startswith(("self", "other")) for name in channels], bool))
