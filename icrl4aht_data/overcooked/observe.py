"""State records -> 5 x 5 observations, batch first, for NumPy and JAX alike (paper, App. A.2 and App. D).

Channels, in order, for n ingredient types:

    self        7 + n   position 1, facing 4 (up, down, right, left), item in hand 2 + n (plate, cooked, counts)
    other       7 + n   the same for the other agent
    static      6       wall, goal, pot, recipe indicator, button, plate pile
    piles       n       ingredient piles
    item        2 + n   the item on the cell, or the pot's content
    recipe      2 + n   on recipe indicators always, on buttons while lit; plate and cooked are always 0
    pot timer   1       0..19
    delivery    1       on goal cells in the step after a correct delivery; only test_simple and test_wide

`channels` lists their names. The canonical channels, shared by all layouts, have n = 4 and delivery.
Cells outside the map are all zero. Every value is an integer in 0..19: uint8 holds it without loss.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from icrl4aht_data.overcooked.channels import (
    CANONICAL_CHANNELS,
    canonical_positions,
    channel_names,
    observation_shape,
)
from icrl4aht_data.overcooked.layouts import (
    BUTTON,
    CENTRE,
    GOAL,
    INDICATOR,
    NOWHERE,
    PILE,
    PLATES,
    POT,
    VISIBLE,
    WALL,
    Layout,
)
from icrl4aht_data.overcooked.rules import look_up
from icrl4aht_data.overcooked.state import Array, unpack

_STATIC = (WALL, GOAL, POT, INDICATOR, BUTTON, PLATES)

# Every visible cell is packed into two 32-bit words: lookups move words, and only the last operation writes C
# channels. Bits of the word of the cell: item 0..7, pot timer 8..12, recipe 13..18, delivery 19, static 20..25, and one
# per piled type 26..28. Bits of the word of the agents on it: self 0..12 (position 1, facing 4, hand 8), other 13..25.
_TIMER, _RECIPE, _DELIVERY, _FIXED, _PILES = 8, 13, 19, 20, 26
_AGENT_BITS = 13


class _Lookup(NamedTuple):
    """Constants of one layout, with its own or the canonical channels.

    Args:
        view: int32 (cells, 25), for each agent position and window cell: number of the cell's changing word; from bit
            8 on, the fixed bits of its word, shifted down by _FIXED.
        shift: uint32 (C,), lowest bit of each channel in its word.
        mask: uint32 (C,), bits of each channel; 0 for channels that the layout does not have, such as an ingredient
            type without a pile.
        agent_channels: number of channels, from the first, that come from the word of the agents.
    """

    view: np.ndarray
    shift: np.ndarray
    mask: np.ndarray
    agent_channels: int


def observe(layout: Layout, record: Array, agent: int, canonical: bool = False) -> Array:
    """Return the observations of one agent: the 5 x 5 cells around it.

    Args:
        layout: the layout.
        record: uint8 (B, S), state records.
        agent: 0 (ego) or 1 (teammate).
        canonical: whether to return the canonical channels, see `channels`, instead of the layout's own.

    Returns:
        uint8 (B, 5, 5, C). NumPy and JAX give equal bytes.
    """
    return _expand(layout, *_words(layout, record, agent), canonical)


def observe_both(layout: Layout, record: Array, canonical: bool = False) -> Array:
    """Return the observations of ego and teammate, uint8 (B, 2, 5, 5, C); see `observe`."""
    xp = record.__array_namespace__()
    ego, teammate = (_words(layout, record, agent) for agent in (0, 1))
    agents, cells = (xp.stack(pair, axis=-2) for pair in zip(ego, teammate, strict=True))
    return _expand(layout, agents, cells, canonical)


def fixed_channels(layout: Layout, canonical: bool = False) -> slice:
    """Return the slice of channels that are constant for a cell: its kind and its ingredient pile."""
    names = CANONICAL_CHANNELS if canonical else channel_names(layout)
    return slice(names.index("wall"), names.index("item_plate"))


def _expand(layout: Layout, agents: Array, cells: Array, canonical: bool) -> Array:
    """Unpack words uint32 (B, 25) of agents and of cells to uint8 (B, 5, 5, C)."""
    xp = agents.__array_namespace__()
    lookup = _lookup(layout, canonical)
    of_agents = xp.asarray(np.arange(len(lookup.shift)) < lookup.agent_channels)
    word = xp.where(of_agents, agents[..., None], cells[..., None])
    values = xp.astype(word >> xp.asarray(lookup.shift) & xp.asarray(lookup.mask), xp.uint8)
    return xp.reshape(values, (*agents.shape[:-1], *observation_shape(layout, canonical)))


def _words(layout: Layout, record: Array, agent: int) -> tuple[Array, Array]:
    """Return two uint32 (B, 25): for each visible cell the word of the agents on it, and its own word."""
    xp = record.__array_namespace__()
    lookup = _lookup(layout)
    state = unpack(layout, record)
    me, other = state.positions[..., agent], state.positions[..., 1 - agent]

    view = look_up(lookup.view, me)
    changing = _changing_words(xp, state)
    cells = xp.take_along_axis(changing, view & NOWHERE, axis=-1) | xp.astype(view >> 8, xp.uint32) << _FIXED

    bodies = 1 | xp.astype(1 << (xp.astype(state.facings, xp.uint32) + 1), xp.uint32)
    bodies = bodies | xp.astype(state.hands, xp.uint32) << 5
    relative = look_up(layout.window_position.reshape(-1), xp.astype(me, xp.int32) * layout.cells + other)
    # The observer is always in the centre. An agent out of view is at NOWHERE, which equals no position in the window.
    position = xp.arange(VISIBLE, dtype=xp.uint8)
    none = xp.zeros_like(cells)
    agents = xp.where(position == CENTRE, bodies[..., agent, None], none) | xp.where(
        position == relative[..., None], bodies[..., 1 - agent, None] << _AGENT_BITS, none
    )
    return agents, cells


def _changing_words(xp, state) -> Array:
    """Return the changing words, uint32 (B, 3 + P + L + K): nothing, indicator, goal, pots, buttons, counters."""
    # The plate and cooked flags are dropped: a recipe has neither.
    recipe = xp.astype(state.recipe >> 2, xp.uint32)[..., None] << _RECIPE
    delivered = xp.astype(state.delivered, xp.uint32)[..., None] << _DELIVERY
    pots = xp.astype(state.pot_items, xp.uint32) | xp.astype(state.pot_timers, xp.uint32) << _TIMER
    buttons = xp.astype(state.buttons > 0, xp.uint32) * recipe
    return xp.concat(
        [xp.zeros_like(recipe), recipe, delivered, pots, buttons, xp.astype(state.counters, xp.uint32)], axis=-1
    )


@lru_cache(maxsize=64)
def _lookup(layout: Layout, canonical: bool = False) -> _Lookup:
    if canonical:
        own, places = _lookup(layout), canonical_positions(layout)
        shift, mask = np.zeros((2, len(CANONICAL_CHANNELS)), np.uint32)  # mask 0: the layout does not have this channel
        shift[places], mask[places] = own.shift, own.mask
        return own._replace(shift=shift, mask=mask, agent_channels=CANONICAL_CHANNELS.index("wall"))
    column = np.zeros(layout.cells, np.int32)
    column[layout.kinds == INDICATOR] = 1
    column[layout.kinds == GOAL] = 2
    for number, cell in enumerate((*layout.pots, *layout.buttons, *layout.counters)):
        column[cell] = 3 + number
    fixed = np.zeros(layout.cells, np.int32)
    for bit, kind in enumerate(_STATIC):
        fixed |= (layout.kinds == kind) << bit
    for bit, ingredient in enumerate(layout.ingredients):
        pile = (layout.kinds == PILE) & (layout.piles == layout.ingredient_item(ingredient))
        fixed |= pile.astype(np.int32) << (_PILES - _FIXED + bit)
    # Outside the map both parts are 0: word number 0 is always zero.
    view = np.where(layout.window >= 0, (column | fixed << 8)[layout.window], 0)

    agent = [(0, 1), *((1 + facing, 1) for facing in range(4)), *_item_bits(layout, 5)]
    shifts = [
        *agent,
        *((_AGENT_BITS + shift, mask) for shift, mask in agent),
        *((_FIXED + bit, 1) for bit in range(len(_STATIC))),
        *_ingredient_bits(layout, _PILES, 1, 1),
        *_item_bits(layout, 0),
        (0, 0),
        (0, 0),
        *_ingredient_bits(layout, _RECIPE, 2, 3),
        (_TIMER, 31),
        *([(_DELIVERY, 1)] if layout.indicates_delivery else []),
    ]
    shift, mask = np.array(shifts, np.uint32).T
    return _Lookup(view.astype(np.int32), shift, mask, 2 * len(agent))


def _item_bits(layout: Layout, first: int) -> list[tuple[int, int]]:
    """Return (shift, mask) of the channels of an item byte that starts at bit `first`: plate, cooked, counts."""
    return [(first, 1), (first + 1, 1), *_ingredient_bits(layout, first + 2, 2, 3)]


def _ingredient_bits(layout: Layout, first: int, width: int, mask: int) -> list[tuple[int, int]]:
    """Return (shift, mask) of each ingredient channel; mask 0 for a type without a pile."""
    order = {ingredient: number for number, ingredient in enumerate(layout.ingredients)}
    return [(first + width * order[i], mask) if i in order else (0, 0) for i in range(layout.ingredient_types)]
