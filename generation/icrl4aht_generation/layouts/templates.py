"""Generated layouts with the rooms of published layouts, mirrored and rotated, and with other fixtures."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from icrl4aht_data.benchmark.facts import LAYOUT_NAMES, TESTED_ON
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_generation.layouts.fixtures import LayoutDraw, furnish_rooms
from icrl4aht_generation.layouts.grids import agent_rooms, canonical_floor, symmetric_images


@cache
def published_rooms(test: bool) -> dict[tuple[str, ...], list[np.ndarray]]:
    """Return the rooms of published layouts that are reserved for tests, or those that are not, without repeats.

    Args:
        test: False for the rooms of asymm_both and cramped_up, the layouts that are only used in training, although
            test layouts have these rooms too; True for all other rooms, which are reserved for tests.

    Returns:
        Symmetric images of the agents' rooms, each bool (2, H, W), by the `canonical_floor` of the rooms.
    """
    trained = {_layout_floor(get_layout(name)) for name in TESTED_ON if name not in TESTED_ON.values()}
    found: dict[tuple[str, ...], list[np.ndarray]] = {}
    for layout in map(get_layout, LAYOUT_NAMES):
        floor = _layout_floor(layout)
        if (floor not in trained) == test:
            pairs = zip(*map(symmetric_images, agent_rooms(layout)), strict=True)
            found.setdefault(floor, [np.stack(pair) for pair in pairs])
    return found


def _layout_floor(layout: Layout) -> tuple[str, ...]:
    return canonical_floor(layout.walkable.reshape(layout.height, layout.width))


def has_test_rooms(layout: Layout) -> bool:
    """Return whether a layout has rooms that are reserved for tests, see `published_rooms`."""
    return _layout_floor(layout) in published_rooms(test=True)


def draw_templates(seed: int) -> Iterator[LayoutDraw]:
    """Yield layouts with published rooms; every second layout has rooms allowed in training, see `published_rooms`."""
    rng = np.random.default_rng([seed, *b"templates"])
    groups = [list(published_rooms(test).values()) for test in (False, True)]
    while True:
        for group in groups:
            drawn = None
            while drawn is None:
                images = group[rng.integers(len(group))]
                drawn = furnish_rooms(images[rng.integers(len(images))], rng)
            yield drawn
