"""Rearranged versions of a layout: the same rooms, with the fixtures in other cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from icrl4aht_data.benchmark.facts import FOUR_RECIPES, LAYOUT_NAMES, TRACKS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.groups import grouped
from icrl4aht_generation.layouts.fixtures import LayoutDraw
from icrl4aht_generation.layouts.grids import agent_rooms, grid_of, neighbours, rows_of

MOST_REPEATS = 1000
"""Number of draws in a row without a new layout after which a family counts as exhausted."""


def with_four_recipes(layout: Layout) -> Layout:
    """Return a layout with the four recipes that the protocol `published` uses on the layout track.

    Raises:
        OptionError: if the layout has no pile of an ingredient that the recipes need.
    """
    missing = {i for recipe in FOUR_RECIPES for i in recipe} - set(layout.ingredients)
    if missing:
        raise OptionError(f"{layout.name}: no pile of ingredient {min(missing)}, which the four recipes need")
    return replace(layout, name=f"{layout.name} four recipes", recipes=FOUR_RECIPES)


def rearranged_layouts(layout: Layout, count: int) -> list[Layout]:
    """Return layouts with the same rooms, and with counters, piles, pots and other fixtures in other cells.

    A fixture moves only to cells that the same agents reach, because otherwise a recipe might be impossible. No result
    is a published layout or its mirror image. Every second layout has the four recipes of `with_four_recipes`. A
    smaller count returns the first layouts of a larger count.

    Args:
        layout: layout to rearrange.
        count: number of different layouts.

    Raises:
        OptionError: if fewer different layouts exist, or the layout has no pile of an ingredient of the four recipes.
    """
    found = list(islice(_arrangements(layout, 0), count))
    if len(found) < count:
        raise OptionError(f"{layout.name}: found only {len(found)} rearranged versions, expected {count}")
    return found


def draw_rearranged(seed: int) -> Iterator[LayoutDraw]:
    """Yield rearranged versions of the layout track's training layouts, one version of each layout in turn.

    With seed 0, the versions of each layout are those that `rearranged_layouts` returns.
    """
    for versions in zip(*(_arrangements(get_layout(name), seed) for name in TRACKS["layout"]["train"]), strict=False):
        yield from ((one.rows, one.recipes, one.indicates_delivery) for one in versions)


def _arrangements(layout: Layout, seed: int) -> Iterator[Layout]:
    """Yield distinct rearranged versions of a layout, until `MOST_REPEATS` draws in a row give no new version."""
    recipes = with_four_recipes(layout).recipes
    rng = np.random.default_rng([seed, *map(ord, layout.name)])
    known = {mirrored for name in LAYOUT_NAMES for mirrored in _mirror_images(get_layout(name).rows)}
    grid = grid_of(layout)
    reach = [neighbours(room) for room in agent_rooms(layout)]
    fixtures = np.flatnonzero((grid != " ") & (grid != "A") & np.any(reach, axis=0)).tolist()
    reached_by = grouped(fixtures, lambda cell: tuple(bool(one.flat[cell]) for one in reach))
    found = repeats = 0
    while repeats < MOST_REPEATS:
        new = grid.copy()
        for cells in reached_by.values():
            new.flat[cells] = grid.flat[rng.permutation(cells)]
        rows = rows_of(new)
        repeats += 1
        if rows not in known:
            known |= set(_mirror_images(rows))
            one = replace(layout, name=f"{layout.name} rearranged {found}", rows=rows)
            yield replace(one, recipes=recipes) if found % 2 else one
            found, repeats = found + 1, 0


def _mirror_images(rows: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return a map and its mirror images."""
    flipped = [rows, rows[::-1]]
    return flipped + [tuple(row[::-1] for row in one) for one in flipped]
