"""Layouts padded to common sizes, so that programs which take a layout as an argument are compiled once for all."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np

from icrl4aht_data.overcooked.cells import GOAL
from icrl4aht_data.overcooked.layouts import Layout, known_layouts
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


_SIZE_CLASSES = (45, 66)
"""Cells of the largest layouts of the first size classes; all larger layouts are the last class. The oracle decides
2.4 times as often a second on a layout of 42 cells in the first class as padded to 99 cells, 1.8 times on one of 66."""


def padded_layout(layout: Layout, by_size: bool = False) -> PaddedLayout:
    """Return a layout padded to the largest layout that this process knows, see `known_layouts`.

    Args:
        layout: the layout.
        by_size: pad it only to the largest known layout of its size class; for long runs, where faster steps make up
            for one more compilation for each class.
    """
    group = known_layouts()
    if by_size:
        own = _size_class(layout)
        group = [one for one in group if _size_class(one) == own]
    return _padded(layout, tuple(group))


def _size_class(layout: Layout) -> int:
    return bisect_left(_SIZE_CLASSES, layout.cells)


def own_layout(layout: Layout) -> PaddedLayout:
    """Return a layout without padding, for policies that see its own observation channels."""
    return _padded(layout, ())


@lru_cache(maxsize=1024)
def _padded(layout: Layout, others: tuple[Layout, ...]) -> PaddedLayout:
    group = [layout, *_largest_of(others)]
    tables = jax.tree.map(lambda leaf: leaf[0], stack_tables(group))
    facts, blank = oracle_params(group)
    oracle = jax.tree.map(lambda leaf: leaf[:1], facts), blank
    return PaddedLayout(tables, oracle, padded_positions(layout, tables))


@lru_cache(maxsize=8)
def _largest_of(layouts: tuple[Layout, ...]) -> list[Layout]:
    return largest_layouts(layouts) if layouts else []


def largest_layouts(layouts: Sequence[Layout]) -> list[Layout]:
    """Return layouts that together have the largest size of every axis of the tables and of the oracle's facts."""
    sizes = np.array([_sizes(layout) for layout in layouts])
    return [layouts[number] for number in dict.fromkeys(sizes.argmax(axis=0).tolist())]


def _sizes(layout: Layout) -> tuple[int, ...]:
    by_goal = (layout.kinds[layout.ahead] == GOAL).any(axis=1) & layout.walkable
    lists = (layout.pots, layout.buttons, layout.counters, layout.recipes, *layout.rooms)
    one_room = np.array_equal(*layout.rooms)
    return layout.cells, layout.channels, *map(len, lists), int(by_goal.sum()), one_room * len(layout.rooms[0])
