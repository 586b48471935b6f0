"""Test the check that all recipes of a layout can be cooked and delivered."""

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


def make_layout(rows: tuple[str, ...], recipes=ZERO) -> Layout:
    return Layout("mine", "mine", rows, recipes)


@pytest.mark.parametrize(
    "layout",
    [
        *LAYOUTS.values(),
        make_layout(("W0WPW", "BA AX", "WWWWW")),
        make_layout(HANDOVER, MIXED),  # agents hand items over the counter between them
        make_layout(TWO_FILL, MIXED),  # each agent reaches one ingredient, and both reach the pot
    ],
    ids=lambda layout: layout.name,
)
def test_published_layouts_and_layouts_that_need_cooperation_are_solvable(layout):
    check_solvable(layout)


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
def test_unsolvable_layout_raises_error_with_the_reason(rows, recipes, reason):
    with pytest.raises(OptionError, match=re.escape(f"layout mine: {reason}; change the map or the recipes")):
        check_solvable(make_layout(rows, recipes))


@pytest.mark.parametrize(
    ("rows", "easy"),
    [
        (HANDOVER, False),
        (TWO_FILL, False),
        (("W0WPW", "1A AX", "WWBWW"), True),
        (("W01WWWW", "WA P AX", "W  W  B", "WWWWWWW"), True),  # one agent cooks and the other serves
        (("W01WWWW", "WA P AX", "W  W 0B", "WWWWWWW"), False),  # the serving agent reaches an ingredient too
        (("W01PWWWW", "WA PW AX", "WPWP  BW", "WWWWWWWW"), False),  # only the cooking agent reaches one of the pots
    ],
)
def test_needs_no_handover_tells_whether_scripted_experts_can_deliver(rows, easy):
    layout = make_layout(rows, MIXED)
    assert needs_no_handover(grid_of(layout), faced_cells(agent_rooms(layout)), MIXED) == easy


def test_waiting_cells_are_not_next_to_needed_fixtures():
    layout = make_layout(("W00WW", "BA AX", "W   W", "WPPWW"))
    cells = waiting_cells(grid_of(layout), agent_rooms(layout)[0], ZERO)
    assert cells.tolist() == [7, 13], "cells next to the only plates, the goal and the pots are excluded"
    full = make_layout(("WR20W", "P  AW", "L A B", "W1XWW"), ((0, 1, 2),))
    assert len(waiting_cells(grid_of(full), agent_rooms(full)[0], full.recipes)) == 0
