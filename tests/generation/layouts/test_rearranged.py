"""Test rearranged layouts, which must not change because stored models were trained on them."""

from __future__ import annotations

import hashlib
from collections import Counter

import pytest
from icrl4aht_generation.layouts.grids import agent_rooms, neighbours
from icrl4aht_generation.layouts.rearranged import rearranged_layouts, with_four_recipes

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout

TRAINING = TRACKS["layout"]["train"]


def facing_counts(layout):
    """Return the number of map cells for each map letter and set of agents that can face the cell."""
    faced = [neighbours(room).ravel().tolist() for room in agent_rooms(layout)]
    return Counter(zip(*faced, "".join(layout.rows), strict=True))


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("asymm_both", "cb96ba14f211207ba6fa8fa32e32bf4c9d28efd5c5d05aa4f8c49379831ab6b1"),
        ("cramped_up", "2afd86e612a34b948b6af41ffae7694f335ba127016689acbab172dd55368299"),
    ],
)
def test_rearranged_layouts_have_the_stored_hash(name, digest):
    text = repr([(one.name, one.rows, one.recipes) for one in rearranged_layouts(get_layout(name), 320)])
    assert hashlib.sha256(text.encode()).hexdigest() == digest


@pytest.mark.parametrize("name", TRAINING)
def test_rearranged_fixtures_stay_reachable_for_the_same_agents(name):
    layout = get_layout(name)
    others = rearranged_layouts(layout, 6)
    assert len(others) == 6
    for other in others:
        assert facing_counts(other) == facing_counts(layout)
        assert [room.tolist() for room in other.rooms] == [room.tolist() for room in layout.rooms]
    assert [len(other.recipes) for other in others] == [2, 4, 2, 4, 2, 4]


def test_more_rearranged_layouts_than_exist_raise_error():
    layout = get_layout("test_wide")
    few = type(layout)("few", "few", ("W0WBW", "1AWAX", "WWWPW"))  # each room has 3! arrangements of its fixtures
    with pytest.raises(OptionError, match=r"few: found only (\d|[12]\d|3[0-5]) rearranged versions, expected 36"):
        rearranged_layouts(few, 36)


def test_layout_with_four_recipes_needs_two_ingredients():
    layout = with_four_recipes(get_layout("asymm_both"))
    assert layout.rows == get_layout("asymm_both").rows and len(layout.recipes) == 4
    one_ingredient = type(layout)("one", "one", ("WWWWW", "W0A0W", "WPBXW", "W0A W", "WWWWW"), recipes=((0, 0, 0),))
    with pytest.raises(OptionError, match="one: no pile of ingredient 1, which the four recipes need"):
        with_four_recipes(one_ingredient)
