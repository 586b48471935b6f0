"""Families, names and splits of generated layouts."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from icrl4aht_data.benchmark.facts import LAYOUT_NAMES
from icrl4aht_data.errors import OptionError, check_choice, unknown_name
from icrl4aht_data.format.layouts_file import is_generated
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.options import check_int
from icrl4aht_generation.layouts.fixtures import LayoutDraw
from icrl4aht_generation.layouts.grids import canonical_map
from icrl4aht_generation.layouts.rearranged import MOST_REPEATS, draw_rearranged
from icrl4aht_generation.layouts.rooms import draw_rooms
from icrl4aht_generation.layouts.templates import draw_templates, has_test_rooms

LAYOUT_FAMILIES: dict[str, Callable[[int], Iterator[LayoutDraw]]] = {
    "rearranged": draw_rearranged,
    "templates": draw_templates,
    "rooms": draw_rooms,
}
"""Function of each family that yields the layouts of a seed, without names."""

LAYOUT_SPLITS = {"train": 0.8, "validation": 0.1, "test": 0.1}
"""Share of each split among layouts allowed in training; other layouts are divided between validation and test."""


MOST_LAYOUTS = 100_000
"""Maximum number of layouts of one family and seed."""


def generate_layouts(family: str, seed: int, count: int, *, split: str | None = None) -> list[Layout]:
    """Return the first layouts of a family.

    All layouts differ from each other and from the published layouts, even if mirrored or rotated, and `check_solvable`
    accepts each layout. A layout such as templates-0-17 depends only on its family, seed and number, so a smaller count
    returns the first layouts of a larger count.

    Args:
        family: "rearranged", "templates" or "rooms".
        seed: number of the sequence of layouts, at least 0.
        count: number of layouts, at most `MOST_LAYOUTS`.
        split: "train", "validation" or "test": only layouts of this split, see `split_of`.

    Raises:
        UnknownNameError: if the family or the split does not exist.
        OptionError: if the family has fewer layouts, or seed or count is not an integer of at least 0.
    """
    check_choice("family of layouts", family, LAYOUT_FAMILIES)
    if split not in (None, *LAYOUT_SPLITS):
        raise unknown_name("split of layouts", split, LAYOUT_SPLITS)
    seed, count = check_int("seed", seed, 0), check_int("count", count, 0)
    if count > MOST_LAYOUTS:
        raise OptionError(f"count = {count}: a family has at most {MOST_LAYOUTS} layouts of one seed; ask for fewer")
    numbered = islice(_named_layouts(family, seed), MOST_LAYOUTS)  # the limit counts layouts of all splits
    of_split = (layout for layout in numbered if split is None or split_of(layout) == split)
    found = list(islice(of_split, count))
    if len(found) < count:
        kept = "" if split is None else f" of split {split}"
        raise OptionError(
            f"family {family}, seed {seed}: found only {len(found)} layouts{kept}, expected {count}; ask for fewer, or "
            f"give another seed or family"
        )
    return found


def find_generated(name: str) -> Layout:
    """Return the generated layout with a name such as templates-0-17, after generating all layouts before it.

    Raises:
        OptionError: if the name is not family-seed-number, or the family has no layout of this number.
        UnknownNameError: if the family does not exist.
    """
    if not is_generated(name):
        raise OptionError(
            f"{name}: expected the name of a generated layout, family-seed-number, such as templates-0-17"
        )
    family, seed, number = name.split("-")
    return generate_layouts(family, int(seed), int(number) + 1)[int(number)]


def _named_layouts(family: str, seed: int) -> Iterator[Layout]:
    """Yield distinct named layouts of a family, until `MOST_REPEATS` draws in a row repeat earlier layouts."""
    known = {canonical_map(get_layout(name)) for name in LAYOUT_NAMES}
    number = repeats = 0
    for drawn in LAYOUT_FAMILIES[family](seed):
        name = f"{family}-{seed}-{number}"
        layout = Layout(name, name, *drawn)
        canonical = canonical_map(layout)
        repeats += 1
        if canonical not in known:
            known.add(canonical)
            yield layout
            number, repeats = number + 1, 0
        elif repeats == MOST_REPEATS:
            return


def split_of(layout: Layout) -> str:
    """Return the split of a layout, "train", "validation" or "test", from a hash of its `canonical_map`.

    Layouts with the rooms of a published test layout, see `published_rooms`, are never in the split `train`.
    """
    splits = [split for split in LAYOUT_SPLITS if split != "train" or not has_test_rooms(layout)]
    digest = hashlib.sha256("\n".join(canonical_map(layout)).encode()).digest()
    ends = np.cumsum([LAYOUT_SPLITS[split] for split in splits])
    position = int.from_bytes(digest[:6], "big") / 2**48  # below 1, because a float stores six bytes exactly
    return splits[int(np.searchsorted(ends, position * ends[-1], side="right"))]
