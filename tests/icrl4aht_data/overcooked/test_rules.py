"""Test the game's rules in hand-drawn scenes; `test_rules_against_jaxmarl.py` compares random states.

Most scenes use the layout cramped_up, in which both agents can reach everything:

      01234
    0 WWPWW
    1 0A A1
    2 W   R
    3 WBWXW
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS, DOWN, INTERACT, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.cells import FACINGS
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import columns, unpack
from tests.helpers.states import state_record

CRAMPED, ASYMM, RING = (LAYOUTS[name] for name in ("cramped_up", "asymm_both", "coord_ring"))

PLATE, COOKED, ZERO, ONE = 1, 2, 4, 16  # bytes of items; ZERO is one piece of ingredient 0
RECIPE_000, RECIPE_001, RECIPE_111 = 3 * ZERO, 2 * ZERO + ONE, 3 * ONE
SOUP_000, SOUP_001, SOUP_111 = (recipe + COOKED for recipe in (RECIPE_000, RECIPE_001, RECIPE_111))
DISH_000, DISH_001, DISH_111 = (soup + PLATE for soup in (SOUP_000, SOUP_001, SOUP_111))

Pose = tuple[int, int, str]
ASIDE: Pose = (2, 2, "down")
AT_POT, AT_GOAL = (2, 1, "up"), (3, 2, "down")

DELTA = {UP: (0, -1), DOWN: (0, 1), LEFT: (-1, 0), RIGHT: (1, 0)}


class Outcome(NamedTuple):
    """State record after a step, its fields as plain Python values, and the rewards of the step."""

    record: np.ndarray
    hands: list[int]
    recipe: int
    delivered: int
    pots: list[tuple[int, int]]  # content and timer of each pot
    buttons: list[int]
    reward: float
    shaped: list[float]


def act(layout: Layout, record: np.ndarray, ego: int, teammate: int = STAY, next_recipe: int = RECIPE_111) -> Outcome:
    """Return the state and the rewards after one step; a correct delivery changes the recipe to `next_recipe`."""
    after = rules.step(layout, record, np.array([[ego, teammate]]), np.array([next_recipe], np.uint8))
    state = unpack(layout, after.state)
    return Outcome(
        record=after.state,
        hands=state.hands[0].tolist(),
        recipe=int(state.recipe[0]),
        delivered=int(state.delivered[0]),
        pots=list(zip(state.pot_items[0].tolist(), state.pot_timers[0].tolist(), strict=True)),
        buttons=state.buttons[0].tolist(),
        reward=float(after.reward[0]),
        shaped=after.shaped[0].tolist(),
    )


@pytest.fixture(params=[0, 1], ids=["ego", "teammate"])
def slot(request: pytest.FixtureRequest) -> int:
    return request.param


def state_at(slot: int, at: Pose, hand: int = 0, layout: Layout = CRAMPED, aside: Pose = ASIDE, **fields) -> np.ndarray:
    """Return a state record with agent `slot` at pose `at` with item `hand`, and the other agent at pose `aside`."""
    if slot == 0:
        return state_record(layout, at, aside, hands=[hand, 0], **fields)
    return state_record(layout, aside, at, hands=[0, hand], **fields)


def interact(slot: int, record: np.ndarray, layout: Layout = CRAMPED, next_recipe: int = RECIPE_111) -> Outcome:
    """Return the state and the rewards after a step in which agent `slot` interacts and the other agent stays."""
    ego, teammate = (INTERACT, STAY) if slot == 0 else (STAY, INTERACT)
    return act(layout, record, ego, teammate, next_recipe)


# Tests of movement


def test_action_ids_follow_the_order_of_the_paper():
    assert ACTIONS == ("up", "down", "left", "right", "stay", "interact")
    assert (UP, DOWN, LEFT, RIGHT, STAY, INTERACT) == (0, 1, 2, 3, 4, 5)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_agents_move_as_specified_from_every_pair_of_cells(layout):
    """Compare with the movement rules of the specification, which this test repeats in plain Python."""
    cells, wanted_cells, actions = [], [], []
    starts = [pair for pair in product(*layout.rooms) if pair[0] != pair[1]]
    for old, pair in product(starts, product(range(6), repeat=2)):
        before = [(int(cell) % layout.width, int(cell) // layout.width) for cell in old]
        wanted = []
        for (x, y), action in zip(before, pair, strict=True):
            dx, dy = DELTA.get(action, (0, 0))
            wanted.append((x + dx, y + dy) if layout.rows[y + dy][x + dx] in " A" else (x, y))
        if wanted[0] == wanted[1] or wanted == before[::-1]:
            wanted = before
        cells.append(before)
        wanted_cells.append([y * layout.width + x for x, y in wanted])
        actions.append(pair)
    records = np.repeat(state_record(layout, (1, 1, "up"), (1, 1, "up")), len(cells), axis=0)
    where = columns(layout)
    records[:, where.positions] = [[y * layout.width + x for x, y in pair] for pair in cells]
    records[:, where.facings] = facings = np.random.default_rng(0).integers(0, 4, (len(cells), 2))
    after = unpack(layout, rules.step(layout, records, np.array(actions), records[:, where.recipe]).state)
    np.testing.assert_array_equal(after.positions, wanted_cells)
    turned = np.array([FACINGS.index(name) if name in FACINGS else -1 for name in ACTIONS])[np.array(actions)]
    np.testing.assert_array_equal(after.facings, np.where(turned >= 0, turned, facings))


# Tests of pots


def test_pot_with_three_ingredients_cooks_for_20_steps(slot):
    record = state_at(slot, AT_POT, ZERO)
    for content in (ZERO, 2 * ZERO):
        after = interact(slot, record)
        assert (after.pots, after.hands) == ([(content, 0)], [0, 0])
        assert act(CRAMPED, after.record, STAY).pots == [(content, 0)]  # one or two do not start cooking
        record = after.record.copy()
        record[:, columns(CRAMPED).hands.start + slot] = ZERO
    after = interact(slot, record)
    timeline = []
    for _ in range(21):
        timeline.append((*after.pots[0], int(observe(CRAMPED, after.record, slot)[0, 1, 2, -1])))
        after = act(CRAMPED, after.record, STAY)
    cooking = [(RECIPE_000, timer, timer) for timer in range(19, 0, -1)]
    assert timeline == [*cooking, (SOUP_000, 0, 0), (SOUP_000, 0, 0)]


# Tests of deliveries


@pytest.mark.parametrize("next_recipe", [RECIPE_000, RECIPE_111])
def test_a_correct_delivery_pays_20_and_changes_the_recipe(slot, next_recipe):
    after = interact(slot, state_at(slot, AT_GOAL, DISH_000, recipe=RECIPE_000), next_recipe=next_recipe)
    assert (after.reward, after.shaped, after.hands) == (20, [0, 0], [0, 0])
    assert (after.recipe, after.delivered) == (next_recipe, 1)  # the next recipe may equal the delivered recipe
    later = act(CRAMPED, after.record, STAY, next_recipe=RECIPE_001)
    assert (later.delivered, later.recipe, later.reward) == (0, next_recipe, 0)


@pytest.mark.parametrize(("recipe", "dish"), [(RECIPE_000, DISH_111), (RECIPE_111, DISH_000), (RECIPE_000, DISH_001)])
def test_a_wrong_delivery_costs_20_and_keeps_the_recipe(slot, recipe, dish):
    after = interact(slot, state_at(slot, AT_GOAL, dish, recipe=recipe), next_recipe=RECIPE_001)
    assert (after.reward, after.shaped, after.hands) == (-20, [0, 0], [0, 0])
    assert (after.recipe, after.delivered) == (recipe, 0)


# Tests of buttons: in coord_ring, both agents can reach the first button, at (4, 2)

AT_BUTTON = ((4, 1, "down"), (4, 3, "up"))
FAR = ((1, 4, "up"), (3, 5, "up"))


def ring_state(slot: int, hand: int = 0, **fields) -> np.ndarray:
    return state_at(slot, AT_BUTTON[slot], hand, layout=RING, aside=FAR[1 - slot], **fields)


def test_button_press_costs_5_and_shows_the_recipe_for_9_observations(slot):
    record = ring_state(slot, recipe=RECIPE_000)
    row = 3 if slot == 0 else 1
    recipe_channel = 2 * 10 + 6 + 3 + 5 + 2  # recipe channel of ingredient type 0, if there are three types
    after = interact(slot, record, RING)
    assert (after.reward, after.shaped, after.hands) == (-5, [0, 0], [0, 0])
    timers, visible = [], []
    for _ in range(11):
        timers.append(after.buttons)
        visible.append(int(observe(RING, after.record, slot)[0, row, 2, recipe_channel]))
        after = act(RING, after.record, STAY)
        assert after.reward == 0
    assert timers == [[timer, 0] for timer in (9, 8, 7, 6, 5, 4, 3, 2, 1, 0, 0)]
    assert visible == [3] * 9 + [0, 0]


# Tests of the order in which agents interact: both agents face the pot at (4, 2) of asymm_both


@pytest.mark.parametrize(
    ("hands", "pot", "hands_after", "pot_after"),
    [
        ([ZERO, ONE], ZERO, [0, 0], (RECIPE_001, 19)),  # the teammate adds the third ingredient
        ([ZERO, ONE], 2 * ZERO, [0, ONE], (RECIPE_000, 19)),  # the pot is full when the teammate interacts
        ([PLATE, PLATE], SOUP_000, [DISH_000, PLATE], (0, 0)),
        # the ego empties the pot, then the teammate adds an ingredient
        ([PLATE, ONE], SOUP_000, [DISH_000, 0], (ONE, 0)),
        ([ONE, PLATE], SOUP_000, [ONE, DISH_000], (0, 0)),
        ([ZERO, PLATE], 2 * ZERO, [0, PLATE], (RECIPE_000, 19)),
    ],
)
def test_ego_interacts_before_the_teammate_at_a_shared_pot(hands, pot, hands_after, pot_after):
    record = state_record(ASYMM, (3, 2, "right"), (5, 2, "left"), hands=hands, pot_items=[pot, 0])
    after = act(ASYMM, record, INTERACT, INTERACT)
    assert (after.hands, after.pots) == (hands_after, [pot_after, (0, 0)])


# Tests of shaped rewards, which each agent gets in addition to the team reward


# asymm_both has pots at (4, 2) and (4, 3), and piles of plates at (3, 4) and (5, 4)

AT_PLATES_ASYMM = ((3, 3, "down"), (5, 3, "down"))
AWAY = ((2, 3, "down"), (6, 3, "down"))  # the agents face the counters (2, 4) and (6, 4)


@pytest.mark.parametrize(
    ("pots", "other_hand", "counters", "reward"),
    [
        ([0, 0], 0, {}, 0),  # no pot in use
        ([ZERO, 0], 0, {}, 3),
        ([0, SOUP_111], 0, {}, 3),
        ([ZERO, 0], PLATE, {}, 0),  # the other agent holds a plate for the only pot in use
        ([ZERO, ONE], PLATE, {}, 3),
        ([ZERO, 0], DISH_000, {}, 3),  # a plate with soup does not count as an empty plate
        ([ZERO, 0], 0, {(1, 4): PLATE}, 0),
        ([ZERO, ONE], 0, {(6, 4): PLATE}, 0),
        ([ZERO, 0], 0, {(1, 4): ZERO, (6, 4): DISH_000}, 3),  # other items do not count as plates
    ],
)
def test_taking_a_plate_earns_a_shaped_reward_of_3_if_a_pot_needs_a_plate(slot, pots, other_hand, counters, reward):
    poses, hands = list(AWAY), [other_hand, other_hand]
    poses[slot], hands[slot] = AT_PLATES_ASYMM[slot], 0
    record = state_record(ASYMM, poses[0], poses[1], hands=hands, pot_items=pots, counters=counters)
    after = interact(slot, record, ASYMM)
    assert (after.hands[slot], after.reward) == (PLATE, 0)
    assert after.shaped == ([reward, 0] if slot == 0 else [0, reward])
