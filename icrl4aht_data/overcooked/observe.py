"""Converts state records to 5 x 5 observations, for NumPy and JAX arrays with batch axes first (paper, App. A.2, D).

Channels, in order, for n ingredient types:

    self        7 + n   position 1, facing 4 (up, down, right, left), item in hand 2 + n (plate, cooked, counts)
    other       7 + n   position, facing and item in hand of the other agent
    static      6       wall, goal, pot, recipe indicator, button, plate pile
    piles       n       ingredient piles
    item        2 + n   the item on the cell, or the pot's content
    recipe      2 + n   the recipe, on recipe indicators and lit buttons; plate and cooked are always 0
    pot timer   1       steps until the pot is cooked, 0..19
    delivery    1       1 on goals in the step after a correct delivery; only on test_simple and test_wide

The module `channels` lists the channels' names. The canonical channels, shared by all layouts, have n = 4 and delivery.
Cells outside the map are zero in all channels. All values are integers in 0..19, which uint8 stores without loss.
"""

from __future__ import annotations

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.cells import NOWHERE, WINDOW
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS, channel_names
from icrl4aht_data.overcooked.layouts import Layout, tables_of
from icrl4aht_data.overcooked.rules import look_up
from icrl4aht_data.overcooked.state import State, unpack
from icrl4aht_data.overcooked.tables import (
    AGENT_BITS,
    CELL_BIT,
    DELIVERY_BIT,
    FIXED_BIT,
    RECIPE_BIT,
    TIMER_BIT,
    Array,
    Tables,
)


def observe(layout: Layout | Tables, record: Array, agent: int, canonical: bool = False) -> Array:
    """Return the observations of one agent, which show the 5 x 5 cells around the agent.

    Args:
        layout: the layout, or its lookup tables.
        record: uint8 (B, S), state records.
        agent: 0 (ego) or 1 (teammate).
        canonical: whether to return the canonical channels, see `channels`, instead of the layout's own.

    Returns:
        Observations uint8 (B, 5, 5, C); NumPy and JAX give equal bytes.

    Raises:
        OptionError: if the layout has an ingredient that has no canonical channel.
    """
    tables = tables_of(layout)
    return _expand(tables, *_packed_words(tables, record, agent), canonical)


def observe_both(layout: Layout | Tables, record: Array, canonical: bool = False) -> Array:
    """Return the observations of ego and teammate, uint8 (B, 2, 5, 5, C); see `observe`."""
    xp, tables = record.__array_namespace__(), tables_of(layout)
    ego, teammate = (_packed_words(tables, record, agent) for agent in (0, 1))
    agents, cells = (xp.stack(pair, axis=-2) for pair in zip(ego, teammate, strict=True))
    return _expand(tables, agents, cells, canonical)


def fixed_channels(layout: Layout, canonical: bool = False) -> slice:
    """Return the slice of channels that never change: a cell's kind and its ingredient pile."""
    names = CANONICAL_CHANNELS if canonical else channel_names(layout)
    return slice(names.index("wall"), names.index("item_plate"))


def _expand(tables: Tables, agents: Array, cells: Array, canonical: bool) -> Array:
    """Unpack the packed words of agents and cells, uint32 (B, 25) each, to observations uint8 (B, 5, 5, C)."""
    xp = agents.__array_namespace__()
    shift, mask, of_agents = (xp.asarray(one) for one in (tables.canonical if canonical else tables.own))
    if not len(shift):
        raise OptionError('an ingredient of the layout has no canonical channel; use channels="own"')
    word = xp.where(of_agents, agents[..., None], cells[..., None])
    values = xp.astype(word >> shift & mask, xp.uint8)
    return xp.reshape(values, (*agents.shape[:-1], WINDOW, WINDOW, len(shift)))


def _packed_words(tables: Tables, record: Array, agent: int) -> tuple[Array, Array]:
    """Return two packed words per visible cell, uint32 (B, 25) each: of the agent on the cell, and of the cell."""
    xp = record.__array_namespace__()
    state = unpack(tables, record)
    me, other = state.positions[..., agent], state.positions[..., 1 - agent]

    view = look_up(tables.view, me)
    changing = _packed_changing_cells(xp, state)
    cells = xp.take_along_axis(changing, view & NOWHERE, axis=-1) | xp.astype(view >> 8, xp.uint32) << FIXED_BIT

    bodies = 1 | xp.astype(1 << (xp.astype(state.facings, xp.uint32) + 1), xp.uint32)
    bodies = bodies | xp.astype(state.hands, xp.uint32) << 5
    # Every cell outside the map has the cell number NOWHERE, which no agent's cell has.
    cell, none = view >> CELL_BIT, xp.zeros_like(cells)
    agents = xp.where(cell == me[..., None], bodies[..., agent, None], none) | xp.where(
        cell == other[..., None], bodies[..., 1 - agent, None] << AGENT_BITS, none
    )
    return agents, cells


def _packed_changing_cells(xp, state: State) -> Array:
    """Return the packed words of the cells that can change, uint32 of shape (B, 3 + P + L + K).

    The words are, in this order: zero for all fixed cells, one word for all recipe indicators, one for all goals, and
    one for each of the P pots, L buttons and K counters.
    """
    # The shift by 2 removes the plate and cooked flags, which a recipe never has.
    recipe = xp.astype(state.recipe >> 2, xp.uint32)[..., None] << RECIPE_BIT
    delivered = xp.astype(state.delivered, xp.uint32)[..., None] << DELIVERY_BIT
    pots = xp.astype(state.pot_items, xp.uint32) | xp.astype(state.pot_timers, xp.uint32) << TIMER_BIT
    buttons = xp.astype(state.buttons > 0, xp.uint32) * recipe
    return xp.concat(
        [xp.zeros_like(recipe), recipe, delivered, pots, buttons, xp.astype(state.counters, xp.uint32)], axis=-1
    )
