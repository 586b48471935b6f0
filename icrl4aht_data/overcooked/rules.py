"""The rules: one step of the game as a pure function, for NumPy and JAX arrays, batch axes first.

Order of a step (paper, App. A.1; constants checked against OvercookedV2): 1. Agents turn and move. 2. Moves that
put both agents on one cell are undone. 3. Moves that swap the agents' cells are undone. 4. Agent 0 interacts, then
agent 1 in the resulting state. 5. Timers count down. 6. A correct delivery changes the recipe.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrl4aht_data.overcooked.actions import INTERACT
from icrl4aht_data.overcooked.cells import BUTTON, COOKED, FACINGS, GOAL, PLATE, POT, WALL
from icrl4aht_data.overcooked.layouts import Layout, tables_of
from icrl4aht_data.overcooked.state import BUTTON_STEPS, POT_STEPS, Array, State, ingredient_count, pack, unpack
from icrl4aht_data.overcooked.tables import Tables

DELIVERY_REWARD = 20.0
WRONG_DELIVERY_REWARD = -20.0
PRESS_REWARD = -5.0
SHAPED_PLACEMENT = 3.0
SHAPED_DISH_PICKUP = 5.0
SHAPED_PLATE_PICKUP = 3.0

CORRECT, WRONG, PRESSED, PLACED, USEFUL_PLACEMENT, TOOK_DISH, USEFUL_DISH, USEFUL_PLATE = (1 << i for i in range(8))
"""Event bits of one agent in one step.

    CORRECT, WRONG      delivered a dish of the current recipe, or another dish
    PRESSED             pressed a button
    PLACED              put an ingredient into a pot; USEFUL_PLACEMENT: an ingredient that the recipe still needs
    TOOK_DISH           took a dish out of a pot; USEFUL_DISH: a dish of the current recipe
    USEFUL_PLATE        took a plate while more pots are in use than plates in hands, and no plate is on a counter
"""


class StepResult(NamedTuple):
    """The result of one step of the game. `B` denotes the batch dimensions.

    Args:
        state: uint8 (B, S), the next state record.
        reward: float32 (B,), the team's reward.
        shaped: float32 (B, 2), each agent's shaped reward, which the team's reward does not include.
        events: uint8 (B, 2), event bits of each agent.
    """

    state: Array
    reward: Array
    shaped: Array
    events: Array


def step(layout: Layout | Tables, record: Array, actions: Array, next_recipe: Array) -> StepResult:
    """Return the result of one step of the game.

    Args:
        layout: the layout, or its lookup tables.
        record: uint8 (B, S), the state record.
        actions: integers (B, 2), action ids 0..5 of ego and teammate.
        next_recipe: uint8 (B,), item byte of the next recipe if the step has a correct delivery.

    Returns:
        The next state, the rewards and the events; NumPy and JAX give equal bytes.
    """
    xp = record.__array_namespace__()
    tables = tables_of(layout)
    state = unpack(tables, record)
    state = _move(tables, xp, state, actions)
    # The event USEFUL_PLATE depends on the number of plates in both agents' hands before agent 0 interacts.
    plates_in_hand = xp.sum(state.hands == PLATE, axis=-1, dtype=xp.uint8)
    events = []
    for agent in (0, 1):
        acting = actions[..., agent] == INTERACT
        state, event = _interact(tables, xp, state, agent, acting, plates_in_hand)
        events.append(event)
    happened = xp.stack(events, axis=-1)
    correct = xp.any((happened & CORRECT) > 0, axis=-1)

    # A timer set in this step already counts down in this step, so a press shows in BUTTON_STEPS - 1 observations.
    ticking = state.pot_timers > 0
    pot_timers = xp.astype(state.pot_timers - ticking, xp.uint8)
    pot_items = xp.astype(state.pot_items | ((ticking & (pot_timers == 0)) * np.uint8(COOKED)), xp.uint8)
    buttons = xp.astype(state.buttons - (state.buttons > 0), xp.uint8)
    state = state._replace(
        pot_timers=pot_timers,
        pot_items=pot_items,
        buttons=buttons,
        recipe=xp.where(correct, next_recipe, state.recipe),
        delivered=xp.astype(correct, xp.uint8),
    )
    return StepResult(pack(state), team_reward(happened), shaped_rewards(happened), happened)


def team_reward(events: Array) -> Array:
    """Return the team's reward, float32 (B,), for event bits uint8 (B, 2)."""
    return _score(events, {CORRECT: DELIVERY_REWARD, WRONG: WRONG_DELIVERY_REWARD, PRESSED: PRESS_REWARD}).sum(axis=-1)


def shaped_rewards(events: Array) -> Array:
    """Return the shaped reward of each agent, float32 (B, 2), for event bits uint8 (B, 2)."""
    values = {USEFUL_PLACEMENT: SHAPED_PLACEMENT, USEFUL_DISH: SHAPED_DISH_PICKUP, USEFUL_PLATE: SHAPED_PLATE_PICKUP}
    return _score(events, values)


def _score(events: Array, values: dict[int, float]) -> Array:
    xp = events.__array_namespace__()
    return sum(xp.astype((events & bit) > 0, xp.float32) * np.float32(value) for bit, value in values.items())


def look_up(table: Array, index: Array) -> Array:
    """Return `table[index]` with the index's array library; the table may be a NumPy array for a JAX index."""
    xp = index.__array_namespace__()
    return xp.take(xp.asarray(table), xp.astype(index, xp.int32), axis=0)


def _move(tables: Tables, xp, state: State, actions: Array) -> State:
    """Turn and move both agents; undo moves that put both agents on one cell or swap the agents' cells."""
    moved = look_up(tables.moves.reshape(-1), xp.astype(state.positions, xp.int32) * 6 + actions)
    old0, old1 = state.positions[..., 0], state.positions[..., 1]
    new0, new1 = moved[..., 0], moved[..., 1]
    # OvercookedV2 undoes moves until no conflict remains. For two agents one condition is enough: both go back if they
    # want the same cell or exchange cells, and then no conflict remains.
    undo = (new0 == new1) | ((new0 == old1) & (new1 == old0))
    facing = xp.astype(actions ^ (actions >> 1), xp.uint8)  # equals FACING_OF[actions] but is faster
    return state._replace(
        positions=xp.where(undo[..., None], state.positions, moved),
        facings=xp.where(actions < len(FACINGS), facing, state.facings),
    )


def _interact(
    tables: Tables, xp, state: State, agent: int, acting: Array, plates_in_hand: Array
) -> tuple[State, Array]:
    """Apply one agent's interaction where `acting`, bool (B,), is True; return the state and event bits uint8 (B,)."""
    hand = state.hands[..., agent]
    pose = xp.astype(state.positions[..., agent], xp.int32) * 4 + state.facings[..., agent]
    faced = look_up(tables.faced.reshape(-1), pose)
    kind, pile, number = faced & 255, xp.astype(faced >> 8 & 255, xp.uint8), faced >> 16
    facing_pot, facing_counter = acting & (kind == POT), acting & (kind == WALL)
    # One-hot masks over pots, counters and buttons select the faced cell, so gather and scatter are not needed.
    at_pot = (number[..., None] == _indices(xp, len(tables.pots))) & facing_pot[..., None]
    at_counter = (number[..., None] == _indices(xp, len(tables.counters))) & facing_counter[..., None]
    at_button = (number[..., None] == _indices(xp, len(tables.buttons))) & (acting & (kind == BUTTON))[..., None]
    content = _read(xp, at_pot, state.pot_items) | _read(xp, at_counter, state.counters)
    timer = _read(xp, at_pot, state.pot_timers)

    empty_hand = hand == 0
    takes_pile = acting & (pile > 0) & empty_hand
    takes_item = facing_counter & (content > 0) & empty_hand
    puts_down = facing_counter & (content == 0) & ~empty_hand
    cooked = facing_pot & ((content & COOKED) > 0)
    is_ingredient = (hand >> 2 > 0) & ((hand & PLATE) == 0)
    adds = facing_pot & (timer == 0) & ~cooked & is_ingredient & (ingredient_count(content) < 3)
    takes_dish = cooked & (hand == PLATE)
    delivers = acting & (kind == GOAL) & ((hand & COOKED) > 0)
    presses = acting & (kind == BUTTON) & empty_hand

    dish = state.recipe | np.uint8(PLATE | COOKED)
    correct = delivers & (hand == dish)
    # A held ingredient sets only the lower of its type's two count bits; `same_type` masks both bits.
    same_type = hand | hand << 1
    useful_placement = adds & ((content & same_type) < (state.recipe & same_type))
    useful_dish = takes_dish & ((content | PLATE) == dish)
    pots_in_use = xp.sum(state.pot_items > 0, axis=-1, dtype=xp.uint8)
    plate_on_counter = xp.any(state.counters == PLATE, axis=-1)
    useful_plate = takes_pile & (pile == PLATE) & (plates_in_hand < pots_in_use) & ~plate_on_counter

    nothing = xp.zeros_like(hand)
    new_content = xp.where(adds, content + hand, xp.where(puts_down, hand, content))
    new_content = xp.where(takes_item | takes_dish, nothing, new_content)
    new_hand = xp.where(takes_pile, pile, xp.where(takes_item, content, hand))
    new_hand = xp.where(takes_dish, content | np.uint8(PLATE), new_hand)
    new_hand = xp.where(adds | puts_down | delivers, nothing, new_hand)
    new_timer = xp.where(adds & (ingredient_count(new_content) == 3), nothing + np.uint8(POT_STEPS), timer)

    other = state.hands[..., 1 - agent]
    state = state._replace(
        hands=xp.stack([new_hand, other] if agent == 0 else [other, new_hand], axis=-1),
        pot_items=xp.where(at_pot, new_content[..., None], state.pot_items),
        pot_timers=xp.where(at_pot, new_timer[..., None], state.pot_timers),
        counters=xp.where(at_counter, new_content[..., None], state.counters),
        buttons=xp.where(at_button & presses[..., None], np.uint8(BUTTON_STEPS), state.buttons),
    )
    bits = {
        CORRECT: correct,
        WRONG: delivers & ~correct,
        PRESSED: presses,
        PLACED: adds,
        USEFUL_PLACEMENT: useful_placement,
        TOOK_DISH: takes_dish,
        USEFUL_DISH: useful_dish,
        USEFUL_PLATE: useful_plate,
    }
    return state, sum(xp.astype(happened, xp.uint8) * np.uint8(bit) for bit, happened in bits.items())


def _indices(xp, n: int) -> Array:
    return xp.arange(n, dtype=xp.int32)


def _read(xp, at: Array, values: Array) -> Array:
    """Return the element of `values` (B, K) that the one-hot mask `at` (B, K) selects, uint8 (B,); 0 if none."""
    return xp.sum(xp.where(at, values, xp.zeros_like(values)), axis=-1, dtype=xp.uint8)
