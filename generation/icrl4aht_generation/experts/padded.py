"""Layouts padded to common sizes, so that programs which take a layout as an argument are compiled once for all."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np

from icrl4aht_data.overcooked.cells import GOAL
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, further_layout_names, get_layout
from icrl4aht_data.overcooked.state import padded_positions
from icrl4aht_data.overcooked.tables import Tables, stack_tables
from icrl4aht_generation.experts.oracle import oracle_params


class PaddedLayout(NamedTuple):
    """What a program needs of one layout.

    Attributes:
        tables: tables of the layout.
        oracle: parameters of the policy `SITUATION_ORACLE` on it.
        positions: int (S,), where the bytes of the layout's own state records are in the program's.
    """

    tables: Tables
    oracle: Any
    positions: np.ndarray


def padded_layout(layout: Layout) -> PaddedLayout:
    """Return a layout padded to the largest layout that this process knows: published, registered or of a release."""
    return _padded(layout, (*LAYOUTS, *further_layout_names()))


def own_layout(layout: Layout) -> PaddedLayout:
    """Return a layout without padding, for policies that see its own observation channels."""
    return _padded(layout, ())


@lru_cache(maxsize=1024)
def _padded(layout: Layout, names: tuple[str, ...]) -> PaddedLayout:
    group = [layout, *_largest_of(names)]
    tables = jax.tree.map(lambda leaf: leaf[0], stack_tables(group))
    facts, blank = oracle_params(group)
    oracle = jax.tree.map(lambda leaf: leaf[:1], facts), blank
    return PaddedLayout(tables, oracle, padded_positions(layout, tables))


@lru_cache(maxsize=8)
def _largest_of(names: tuple[str, ...]) -> list[Layout]:
    return largest_layouts([get_layout(name) for name in names]) if names else []


def largest_layouts(layouts: Sequence[Layout]) -> list[Layout]:
    """Return layouts that together have the largest size of every axis of the tables and of the oracle's facts."""
    sizes = np.array([_sizes(layout) for layout in layouts])
    return [layouts[number] for number in dict.fromkeys(sizes.argmax(axis=0).tolist())]


def _sizes(layout: Layout) -> tuple[int, ...]:
    by_goal = (layout.kinds[layout.ahead] == GOAL).any(axis=1) & layout.walkable
    lists = (layout.pots, layout.buttons, layout.counters, layout.recipes, *layout.rooms)
    one_room = np.array_equal(*layout.rooms)
    return layout.cells, layout.channels, *map(len, lists), int(by_goal.sum()), one_room * len(layout.rooms[0])
