"""Test layouts, observations of hand-drawn scenes, and columns and faults of state records.

Most scenes use the layout cramped_up:

      01234
    0 WWPWW
    1 0A A1
    2 W   R
    3 WBWXW
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import INTERACT, STAY
from icrl4aht_data.overcooked.channels import channel_names
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, get_layout
from icrl4aht_data.overcooked.observe import observe, observe_both
from icrl4aht_data.overcooked.state import columns, faults, initial_record, pack, record_size, unpack
from tests.helpers.states import random_records, state_record

CRAMPED, RING, SIMPLE, WIDE = (LAYOUTS[name] for name in ("cramped_up", "coord_ring", "test_simple", "test_wide"))

PLATE, COOKED, ZERO, ONE = 1, 2, 4, 16  # item bytes; ZERO: one piece of ingredient 0, ONE: one piece of ingredient 1
RECIPE_000, RECIPE_111 = 3 * ZERO, 3 * ONE

SPECIFIED = {  # name: (alias, width, height, ingredient types, channels), from the specification
    "coord_simple": ("grounded_coord_simple", 8, 5, 3, 40),
    "coord_ring": ("grounded_coord_ring", 9, 9, 3, 40),
    "test_simple": ("test_time_simple", 8, 5, 3, 41),
    "test_wide": ("test_time_wide", 6, 7, 4, 46),
    "demo_simple": ("demo_cook_simple", 11, 5, 3, 40),
    "demo_wide": ("demo_cook_wide", 11, 6, 4, 45),
    "asymm_both": ("asymm_advantages_recipes_both", 9, 5, 2, 35),
    "asymm_right": ("asymm_advantages_recipes_right", 9, 5, 2, 35),
    "cramped_up": ("cramped_room_up", 5, 4, 2, 35),
    "cramped_down": ("cramped_room_down", 5, 4, 2, 35),
}

each_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)

Cells = dict[tuple[int, int], int]


def nonzero_channels(layout: Layout, record: np.ndarray, agent: int) -> dict[str, Cells]:
    """Return all nonzero values of an agent's observation, as channel -> map cell (x, y) -> value."""
    names, view = channel_names(layout), observe(layout, record, agent)[0]
    assert view.shape == (5, 5, len(names))
    position = int(unpack(layout, record).positions[0, agent])
    left, top = position % layout.width - 2, position // layout.width - 2
    found: dict[str, Cells] = {}
    for row, column, channel in np.argwhere(view).tolist():
        found.setdefault(names[channel], {})[left + column, top + row] = int(view[row, column, channel])
    return found


def cell_values(value: int, *cells: tuple[int, int]) -> Cells:
    return dict.fromkeys(cells, value)


# Tests of layouts


@each_layout
def test_layouts_match_the_specification(layout):
    assert list(LAYOUTS) == list(SPECIFIED)
    found = (layout.alias, layout.width, layout.height, layout.ingredient_types, layout.channels)
    assert found == SPECIFIED[layout.name]
    assert get_layout(layout.name) is get_layout(layout.alias) is layout
    records = random_records(layout, 7, np.random.default_rng(0))
    for observed, shape in ((observe(layout, records, 1), (7,)), (observe_both(layout, records), (7, 2))):
        assert observed.shape == (*shape, 5, 5, SPECIFIED[layout.name][-1])
        assert observed.dtype == np.uint8


@pytest.mark.parametrize(
    ("wrong", "nearest"),
    [("cramped_upp", "cramped_up"), ("test_time_wid", "test_time_wide"), ("coordring", "coord_ring"), ("7", None)],
)
def test_unknown_layout_raises_error_with_valid_and_nearest_names(wrong, nearest):
    hint = f" Did you mean '{nearest}'?" if nearest else ""
    with pytest.raises(UnknownNameError, match=rf"unknown layout '{wrong}'.*\.{re.escape(hint)}$") as error:
        get_layout(wrong)
    listed = str(error.value).split("valid: ")[1].split(".")[0].split(", ")
    # Other tests may have opened releases with more layouts.
    assert set(listed) >= {*SPECIFIED, *(alias for alias, *_ in SPECIFIED.values())}


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        (("WWWWW", "0AA1", "WWWWW"), {}, "widths \\[5, 4, 5\\]"),
        (("WWZWW", "0AAz1", "WWWWW"), {}, "letters \\['Z', 'z'\\]"),
        (("WWWWW", "0A  1", "WWWWW"), {}, "1 agents"),
        (("W2W3W", "0A A1", "WWWWW"), {}, "piles of 4 ingredient types"),
        (("W" * 32, "0A A1" + "W" * 27, *["W" * 32] * 6), {}, "256 cells"),
        (("WWWWW", "0A A0", "WWWWW"), {}, "ingredients \\[1\\] that have no pile"),
        (("WWWWW", "0A A1", "WWWWW"), {"recipes": ((0, 1, 2), (0, 3, 1))}, "ingredients \\[2, 3\\]"),
        (("WW WW", "0A A1", "WWWWW"), {}, "edge at \\(2, 0\\)"),
        ((), {}, "widths \\[\\]"),
        ("WWWWW", {}, "rows = "),
        (("WWWWW", "WA AW", "WWWWW"), {"recipes": ()}, "at least one"),
        (("W0W1W", "WA AW", "WWWWW"), {"recipes": ((0, 0, 1), (0, 1, 0))}, "no recipe twice"),
        (("W0W1W", "WA AW", "WWWWW"), {"recipes": ((0, 1),)}, "recipes = "),
        (("W0W1W", "WA AW", "WWWWW"), {"recipes": ((0, 0, True),)}, "recipes = "),
        (("W0W1W", "WA AW", "WWWWW"), {"indicates_delivery": 1}, "indicates_delivery = "),
    ],
)
def test_impossible_maps_are_refused(rows, options, message):
    with pytest.raises(OptionError, match=f"layout mine: .*{message}"):
        Layout("mine", "mine_too", rows, **options)


def test_a_possible_map_is_accepted():
    layout = Layout("mine", "mine_too", ("W5W2W", "0A AW", "WWXWW"), recipes=((0, 2, 5),), indicates_delivery=True)
    assert layout.obs_shape == (5, 5, 25 + 5 * 6 + 1)
    assert [room.tolist() for room in layout.rooms] == [[6, 7, 8]] * 2


# Tests of observations


def test_observation_of_a_scene_has_the_expected_nonzero_channels():
    """Check all nonzero channels. The agent at (1, 1) observes cells x = -1..3, y = -1..3."""
    record = state_record(
        CRAMPED,
        (1, 1, "left"),
        (3, 2, "down"),
        hands=[ZERO, PLATE + COOKED + 2 * ZERO + ONE],
        recipe=RECIPE_111,
        pot_items=[2 * ZERO + ONE],
        pot_timers=[13],
        counters={(1, 0): ONE, (0, 2): PLATE, (2, 3): PLATE + COOKED + 3 * ONE},
    )
    assert nonzero_channels(CRAMPED, record, 0) == {
        "self_position": cell_values(1, (1, 1)),
        "self_facing_left": cell_values(1, (1, 1)),
        "self_ingredient_0": cell_values(1, (1, 1)),
        "other_position": cell_values(1, (3, 2)),
        "other_facing_down": cell_values(1, (3, 2)),
        "other_plate": cell_values(1, (3, 2)),
        "other_cooked": cell_values(1, (3, 2)),
        "other_ingredient_0": cell_values(2, (3, 2)),
        "other_ingredient_1": cell_values(1, (3, 2)),
        "wall": cell_values(1, (0, 0), (1, 0), (3, 0), (0, 2), (0, 3), (2, 3)),
        "goal": cell_values(1, (3, 3)),
        "pot": cell_values(1, (2, 0)),
        "plate_pile": cell_values(1, (1, 3)),
        "pile_0": cell_values(1, (0, 1)),
        "item_plate": cell_values(1, (0, 2), (2, 3)),
        "item_cooked": cell_values(1, (2, 3)),
        "item_ingredient_0": cell_values(2, (2, 0)),
        "item_ingredient_1": {(1, 0): 1, (2, 0): 1, (2, 3): 3},
        "pot_timer": cell_values(13, (2, 0)),
    }


@pytest.mark.parametrize(
    ("layout", "goal", "poses", "deliverer"),
    [(SIMPLE, (7, 2), [(1, 1, "up"), (6, 2, "right")], 1), (WIDE, (2, 0), [(2, 1, "up"), (2, 4, "up")], 0)],
)
def test_delivery_channel_marks_the_goal_for_one_step(layout, goal, poses, deliverer):
    hands, actions = [0, 0], [STAY, STAY]
    hands[deliverer], actions[deliverer] = RECIPE_000 + PLATE + COOKED, INTERACT
    record = state_record(layout, *poses, hands=hands)
    next_recipe = np.array([RECIPE_111], np.uint8)
    assert "delivery" not in nonzero_channels(layout, record, deliverer)
    after = rules.step(layout, record, np.array([actions]), next_recipe)
    assert after.reward == 20
    assert nonzero_channels(layout, after.state, deliverer)["delivery"] == cell_values(1, goal)
    # The goal is outside the other agent's window.
    assert "delivery" not in nonzero_channels(layout, after.state, 1 - deliverer)
    later = rules.step(layout, after.state, np.array([[STAY, STAY]]), next_recipe)
    assert "delivery" not in nonzero_channels(layout, later.state, deliverer)


# Tests of state records


@each_layout
def test_unpack_then_pack_returns_the_same_records(layout):
    records = np.random.default_rng(6).integers(0, 256, (2, 64, record_size(layout)), dtype=np.uint8)
    state = unpack(layout, records)
    again = pack(state)
    assert again.dtype == np.uint8
    np.testing.assert_array_equal(again, records)
    pots, buttons = ("".join(layout.rows).count(letter) for letter in "PL")
    assert [np.shape(field)[2:] for field in state[:8]] == [(2,), (2,), (2,), (), (), (pots,), (pots,), (buttons,)]


def test_start_state_has_empty_hands_pots_and_counters():
    positions, facings = np.array([[10, 13]], np.uint8), np.array([[3, 2]], np.uint8)
    record = initial_record(RING, positions, facings, np.array([RECIPE_111], np.uint8))
    np.testing.assert_array_equal(record[0, :7], [10, 13, 3, 2, 0, 0, RECIPE_111])
    assert record.shape == (1, record_size(RING))
    assert not record[:, 7:].any()


@each_layout
def test_possible_states_have_no_faults(layout):
    rng = np.random.default_rng(7)
    records = random_records(layout, 1024, rng)
    assert faults(layout, records) == []
    for _ in range(20):
        actions = np.where(rng.random((1024, 2)) < 0.5, INTERACT, rng.integers(0, 6, (1024, 2)))
        records = rules.step(layout, records, actions, rng.choice(layout.recipe_items, 1024)).state
    assert faults(layout, records) == []


IMPOSSIBLE = {
    "a position that is not reachable floor": [
        {"positions": [0, 13]},  # cell 0 is a wall
        {"positions": [11, 20]},  # cell 20 is outside the map
    ],
    "two agents on one cell": [{"positions": [11, 11]}],
    "an unknown facing": [{"facings": [0, 4]}],
    "an impossible item in hand": [
        {"hands": hands}
        for hands in (
            [2 * ZERO, 0],
            [COOKED + RECIPE_000, 0],
            [PLATE + COOKED + 2 * ZERO, 0],
            [0, 64],  # 64 is an ingredient that the layout does not have
        )
    ],
    "an impossible item on a counter": [{"counters": {(1, 0): 2 * ONE}}, {"counters": {(2, 3): COOKED + RECIPE_111}}],
    "an impossible item in a pot": [
        {"pot_items": [item]} for item in (PLATE, PLATE + COOKED + RECIPE_000, 3 * ZERO + ONE, COOKED + ZERO)
    ],
    "an impossible recipe": [{"recipe": item} for item in (0, 2 * ZERO, COOKED + RECIPE_000, 64 * 3)],
    "a delivery flag that is not 0 or 1": [{"delivered": 2}],
    "a pot timer above its limit": [{"pot_items": [RECIPE_000], "pot_timers": [21]}],
    "a pot that does not cook exactly while it contains three raw ingredients": [
        {"pot_items": [RECIPE_000]},
        {"pot_items": [8], "pot_timers": [5]},
        {"pot_items": [COOKED + RECIPE_000], "pot_timers": [5]},
    ],
}


@pytest.mark.parametrize(("kind", "change"), [(kind, change) for kind in IMPOSSIBLE for change in IMPOSSIBLE[kind]])
def test_each_impossible_value_is_found(kind, change):
    record = state_record(CRAMPED, (1, 1, "up"), (3, 2, "up"), **change)
    assert faults(CRAMPED, record) == [kind]
    good = state_record(CRAMPED, (1, 1, "up"), (3, 2, "up"))
    assert faults(CRAMPED, np.concatenate([good, record, good])) == [kind]


def test_faults_lists_several_faults_of_one_state():
    record = state_record(RING, (1, 1, "up"), (3, 3, "up"), buttons=[10, 11])
    assert faults(RING, record) == ["a button timer above its limit"]
    record[:, columns(RING).facings] = 7
    assert faults(RING, record) == ["an unknown facing", "a button timer above its limit"]


@each_layout
def test_shows_recipe_tells_whether_observations_contain_the_recipe(layout):
    views = observe(layout, random_records(layout, 500, np.random.default_rng(0)), 0)
    shown = [number for number, name in enumerate(channel_names(layout)) if name.startswith("recipe_ingredient")]
    assert layout.shows_recipe == bool(views[..., shown].any())
