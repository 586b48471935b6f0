"""Layouts outside the benchmark, on which a model learns the game rather than one map."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np

from icrl4aht_baselines.evaluate.protocols import FOUR_RECIPES
from icrl4aht_baselines.training.options import MOST_REARRANGED
from icrl4aht_data.benchmark.facts import LAYOUT_NAMES
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import EMPTY, STEP, Layout, get_layout


def with_four_recipes(layout: Layout) -> Layout:
    """Return a layout with the four recipes that the protocol `published` has on the layout track.

    Raises:
        OptionError: if the layout has no pile of one of their ingredients.
    """
    missing = {i for recipe in FOUR_RECIPES for i in recipe} - set(layout.ingredients)
    if missing:
        raise OptionError(f"{layout.name}: it has no pile of ingredient {min(missing)}, which the four recipes need")
    return replace(layout, name=f"{layout.name} four recipes", recipes=FOUR_RECIPES)


def unseen_layouts(layout: Layout, count: int) -> list[Layout]:
    """Return rearranged versions of a layout that no model is trained on, with the layout's own recipes.

    They have the layout's name: settings by layout, such as hidden recipe indicators, apply to them as well.

    Raises:
        OptionError: as `rearranged_layouts`.
    """
    found = rearranged_layouts(layout, MOST_REARRANGED + count)[MOST_REARRANGED:]
    return [replace(layout, rows=one.rows) for one in found]


def rearranged_layouts(layout: Layout, count: int) -> list[Layout]:
    """Return layouts with the same rooms, and with counters, piles, pots and other fixtures in other cells.

    A fixture moves only to cells that the same agents reach, since otherwise no soup might be possible. None of the
    layouts is one of the benchmark, mirrored or not. Every second one has the four recipes of `with_four_recipes`. With
    a smaller count the result is the beginning of a longer one.

    Args:
        layout: the layout.
        count: number of different layouts.

    Raises:
        OptionError: if there are not so many different ones, or if the layout has no pile of one of the ingredients of
            the four recipes.
    """
    recipes = with_four_recipes(layout).recipes
    rng = np.random.default_rng([0, *map(ord, layout.name)])
    known = {mirrored for name in LAYOUT_NAMES for mirrored in _mirrored(get_layout(name).rows)}
    found: list[Layout] = []
    for _ in range(100 * count):
        if len(found) == count:
            break
        rows = _rearranged(layout, rng)
        if rows not in known:
            known |= set(_mirrored(rows))
            one = replace(layout, name=f"{layout.name} rearranged {len(found)}", rows=rows)
            found.append(replace(one, recipes=recipes) if len(found) % 2 else one)
    if len(found) < count:
        raise OptionError(f"{layout.name}: its fixtures have {len(found)} other arrangements, expected {count}")
    return found


def _rearranged(layout: Layout, rng: np.random.Generator) -> tuple[str, ...]:
    letters = list("".join(layout.rows))
    reached_by: dict[frozenset[int], list[int]] = defaultdict(list)
    for cell in range(layout.cells):
        agents = frozenset(agent for agent, room in enumerate(layout.rooms) if _touches(layout, cell, room))
        if layout.kinds[cell] != EMPTY and agents:
            reached_by[agents].append(cell)
    for cells in reached_by.values():
        moved = [letters[cell] for cell in rng.permutation(cells)]
        for cell, letter in zip(cells, moved, strict=True):
            letters[cell] = letter
    text = "".join(letters)
    return tuple(text[start : start + layout.width] for start in range(0, layout.cells, layout.width))


def _touches(layout: Layout, cell: int, room: np.ndarray) -> bool:
    """Return whether an agent in a room can face a cell."""
    x, y = cell % layout.width, cell // layout.width
    neighbours = {(y + dy) * layout.width + x + dx for dx, dy in STEP.values() if 0 <= x + dx < layout.width}
    return not neighbours.isdisjoint(room.tolist())


def _mirrored(rows: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return a map and its mirror images."""
    flipped = [rows, rows[::-1]]
    return flipped + [tuple(row[::-1] for row in one) for one in flipped]
