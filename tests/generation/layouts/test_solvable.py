"""Layouts in which a recipe cannot be delivered are refused with the reason, and others are not."""

from __future__ import annotations

import re

import pytest
from icrl4aht_generation.layouts import check_solvable
from icrl4aht_generation.layouts.fixtures import faced_cells, needs_no_handover, waiting_cells
from icrl4aht_generation.layouts.grids import agent_rooms, grid_of

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout

ZERO, MIXED = ((0, 0, 0),), ((0, 0, 0), (0, 1, 1))
HANDOVER = ("W01WPWWW", "WA W  XW", "W  W A W", "WBWWWWWW")
TWO_FILL = ("W0WPW1WW", "WA P AXW", "W  W  BW", "WWWWWWWW")


def made(rows: tuple[str, ...], recipes=ZERO) -> Layout:
    return Layout("mine", "mine", rows, recipes)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_published_layouts_are_solvable(layout):
    check_solvable(layout)


@pytest.mark.parametrize(
    ("rows", "recipes"),
    [
        (("W0WPW", "BA AX", "WWWWW"), ZERO),
        (HANDOVER, MIXED),  # onion and plate go over the counter between the rooms
        (TWO_FILL, MIXED),  # each agent has an ingredient, and the pot is between them
    ],
)
def test_solvable(rows, recipes):
    check_solvable(made(rows, recipes))


@pytest.mark.parametrize(
    ("rows", "recipes", "reason"),
    [
        (("W0WPW", "BA AW", "WWWWW"), ZERO, "no agent can face a goal"),
        (("W0WWW", "BA AX", "WWWWP"), ZERO, "no agent can face a pot"),
        (("W0WPW", "WA AX", "WWWWB"), ZERO, "no agent can face a plate pile"),
        (("0BWPW", "WA AX", "WWWWW"), ZERO, "ingredient 0 cannot reach a pot whose soup can be delivered"),
        (("W0B1WPWW", "WA L AXW", "WWWWWWWW"), ZERO, "no soup can reach a goal on a plate"),
        (("W0WWPBXW", "WA 1A  W", "WWWWWWWW"), ZERO, "ingredient 0 cannot reach a pot whose soup can be delivered"),
        (("W0PW1PW", "BA L AB", "WXWWWXW"), MIXED, "the ingredients of recipe (0, 1, 1) cannot reach the same pot"),
    ],
)
def test_unsolvable(rows, recipes, reason):
    with pytest.raises(OptionError, match=re.escape(f"layout mine: {reason}; change the map or the recipes")):
        check_solvable(made(rows, recipes))


@pytest.mark.parametrize(
    ("rows", "easy"),
    [
        (HANDOVER, False),
        (TWO_FILL, False),
        (("W0WPW", "1A AX", "WWBWW"), True),
        (("W01WWWW", "WA P AX", "W  W  B", "WWWWWWW"), True),  # one agent only cooks, the other only serves
        (("W01WWWW", "WA P AX", "W  W 0B", "WWWWWWW"), False),  # the one that serves would fill the pot as well
        (("W01PWWWW", "WA PW AX", "WPWP  BW", "WWWWWWWW"), False),  # the one that cooks has a pot of its own
    ],
)
def test_scripted_experts_can_deliver(rows, easy):
    layout = made(rows, MIXED)
    assert needs_no_handover(grid_of(layout), faced_cells(agent_rooms(layout)), MIXED) == easy


def test_cells_on_which_an_agent_can_wait():
    layout = made(("W00WW", "BA AX", "W   W", "WPPWW"))
    cells = waiting_cells(grid_of(layout), agent_rooms(layout)[0], ZERO)
    assert cells.tolist() == [7, 13], "not next to the only plates, the goal or a pot"
    full = made(("WR20W", "P  AW", "L A B", "W1XWW"), ((0, 1, 2),))
    assert len(waiting_cells(grid_of(full), agent_rooms(full)[0], full.recipes)) == 0
