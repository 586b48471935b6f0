"""State records: the game's state as S bytes (uint8). S is 14 to 36, depending on the layout.

Columns of a record, in order (columns of the agents: first the ego, then the teammate):

    positions   2   flat cell number of each agent, y * width + x
    facings     2   facing of each agent: 0 up, 1 down, 2 right, 3 left
    hands       2   item byte in each agent's hand
    recipe      1   item byte of the current recipe (three ingredients, no flags)
    delivered   1   1 in the step after a correct delivery, else 0
    pot_items   P   item byte of each pot's content, pots in reading order
    pot_timers  P   steps until each pot's content is cooked, 0..20
    buttons     L   steps for which each button stays lit, 0..10
    counters    K   item byte on each wall that an agent can face, in reading order

An item byte has bit 0 for a plate, bit 1 for cooked, and two bits (a count 0..3) for each ingredient type that has a
pile, by ascending id. A recipe is the sum of three ingredients; a finished dish is recipe + plate + cooked.
The record does not contain the step number, since the rules do not depend on the step number.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrl4aht_data.overcooked.cells import COOKED, FACINGS, PLATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Array, Tables

POT_STEPS = 20
"""Steps until a full pot is cooked (paper, App. A.1)."""

BUTTON_STEPS = 10
"""Timer value set by pressing a button (paper, App. A.1)."""


class State(NamedTuple):
    """The columns of a state record, uint8. `B` denotes the batch dimensions, which come first.

    Args:
        positions: (B, 2), flat cell numbers of ego and teammate.
        facings: (B, 2), facings of ego and teammate, as positions in `FACINGS`.
        hands: (B, 2), item bytes in the hands of ego and teammate.
        recipe: (B,), item byte of the current recipe.
        delivered: (B,), 1 in the step after a correct delivery.
        pot_items: (B, P), item byte of each pot's content.
        pot_timers: (B, P), steps until the content is cooked.
        buttons: (B, L), steps for which each button stays lit.
        counters: (B, K), item byte on each counter.
    """

    positions: Array
    facings: Array
    hands: Array
    recipe: Array
    delivered: Array
    pot_items: Array
    pot_timers: Array
    buttons: Array
    counters: Array


def columns(layout: Layout | Tables) -> State:
    """Return the columns of each field in a layout's records: an int for `recipe` and `delivered`, slices otherwise."""
    pots, buttons, counters = _count_changing_cells(layout)
    ends = np.cumsum([8, pots, pots, buttons, counters]).tolist()
    rest = [slice(a, b) for a, b in pairwise(ends)]
    return State(slice(0, 2), slice(2, 4), slice(4, 6), 6, 7, *rest)


def record_size(*layouts: Layout | Tables) -> int:
    """Return the size in bytes of a state record that is padded to fit each of the given layouts or tables."""
    pots, buttons, counters = np.max([_count_changing_cells(layout) for layout in layouts], axis=0).tolist()
    return 8 + 2 * pots + buttons + counters


def _count_changing_cells(layout: Layout | Tables) -> tuple[int, int, int]:
    pots, buttons, counters = (np.shape(cells)[-1] for cells in (layout.pots, layout.buttons, layout.counters))
    return pots, buttons, counters


def padded_columns(layout: Layout, tables: Tables) -> np.ndarray:
    """Return the columns of padded state records that hold the bytes of one layout's state records.

    Args:
        layout: one of the layouts that the records are padded for; its own records have S bytes.
        tables: lookup tables of all these layouts, see `stack_tables`.

    Returns:
        Columns, int (S,); `padded[..., columns]` are the layout's records without padding.
    """
    own, padded = columns(layout), columns(tables)
    lengths = [one.stop - one.start for one in own[5:]]
    parts = [np.arange(one.start, one.start + length) for one, length in zip(padded[5:], lengths, strict=True)]
    return np.concatenate([np.arange(8), *parts])


def unpack(layout: Layout | Tables, record: Array) -> State:
    """Split state records uint8 (B, S) into fields."""
    return State(*(record[..., column] for column in columns(layout)))


def pack(state: State) -> Array:
    """Join fields into state records uint8 (B, S); the inverse of `unpack`."""
    xp = state.positions.__array_namespace__()
    single = (state.recipe[..., None], state.delivered[..., None])
    return xp.concat([*state[:3], *single, *state[5:]], axis=-1)


def swap_agents(record: Array) -> Array:
    """Exchange ego and teammate in state records uint8 (B, S); the ego then observes what the teammate observed."""
    order = np.arange(record.shape[-1])
    order[:6] = 1, 0, 3, 2, 5, 4  # the columns of positions, facings and hands
    return record[..., order]


def initial_record(layout: Layout | Tables, positions: Array, facings: Array, recipe: Array) -> Array:
    """Return the state record of an episode's first step, with empty hands, pots and counters (paper, App. A.1).

    Args:
        layout: the layout or its lookup tables.
        positions: uint8 (B, 2), flat cell numbers of the two agents.
        facings: uint8 (B, 2), positions in `FACINGS`.
        recipe: uint8 (B,), item byte of the first recipe.

    Returns:
        State records uint8 (B, S).
    """
    xp = positions.__array_namespace__()
    empty = xp.zeros((*recipe.shape, record_size(layout) - 7), dtype=xp.uint8)
    hands = xp.zeros_like(positions)
    return xp.concat([positions, facings, hands, recipe[..., None], empty], axis=-1)


def possible_recipes(layout: Layout) -> np.ndarray:
    """Return the item bytes of all recipes that the layout's piles allow, uint8, ascending; tasks use some of these."""
    items = np.arange(256)
    plain = (items & (PLATE | COOKED) == 0) & (ingredient_count(items) == 3)
    return np.flatnonzero(possible_items(layout) & plain).astype(np.uint8)


def faults(layout: Layout, record: np.ndarray) -> list[str]:
    """Return descriptions of impossible values in records uint8 (B, S), or an empty list if all values are possible.

    Agents must be on distinct reachable floor cells, item bytes and timers must be possible, a recipe must have three
    ingredients, and a pot must cook exactly while it contains three raw ingredients. Whether the rules can reach the
    state is not checked.
    """
    state = unpack(layout, record)
    items = possible_items(layout)
    in_hand = items & ((np.arange(256) & PLATE > 0) | (ingredient_count(np.arange(256)) <= 1))
    in_pot = items & (np.arange(256) & PLATE == 0)
    cooking = state.pot_timers > 0
    checks = {
        "a position that is not reachable floor": ~layout.walkable[np.minimum(state.positions, layout.cells - 1)]
        | (state.positions >= layout.cells),
        "two agents on one cell": state.positions[..., 0] == state.positions[..., 1],
        "an unknown facing": state.facings >= len(FACINGS),
        "an impossible item in hand": ~in_hand[state.hands],
        "an impossible item on a counter": ~in_hand[state.counters],
        "an impossible item in a pot": ~in_pot[state.pot_items],
        "an impossible recipe": ~np.isin(state.recipe, possible_recipes(layout)),
        "a delivery flag that is not 0 or 1": state.delivered > 1,
        "a pot timer above its limit": state.pot_timers > POT_STEPS,
        "a pot that does not cook exactly while it contains three raw ingredients": cooking
        != ((ingredient_count(state.pot_items) == 3) & (state.pot_items & COOKED == 0)),
        "a button timer above its limit": state.buttons > BUTTON_STEPS,
    }
    return [what for what, wrong in checks.items() if np.any(wrong)]


def ingredient_count(item: Array) -> Array:
    """Return the number of ingredients in an item byte."""
    return ((item >> 2) & 3) + ((item >> 4) & 3) + ((item >> 6) & 3)


def possible_items(layout: Layout) -> np.ndarray:
    """Return bool (256,), True for possible item bytes: nothing, a plate, 1 to 3 ingredients, a soup, or a dish."""
    item = np.arange(256)
    count = ingredient_count(item)
    known = item >> (2 + 2 * len(layout.ingredients)) == 0
    raw = (item & (PLATE | COOKED) == 0) & (count <= 3)
    soup = (item & COOKED > 0) & (count == 3)
    return known & (raw | soup | (item == PLATE))
