"""The benchmark's ten layouts (maps, recipes, aliases), their lookup tables, and layouts added by other packages.

A cell (x, y) has column x and row y, from the top left corner; the cell's number is y * width + x.
Map letters: W wall (= counter), A agent, X goal, B plate pile, P pot, R recipe indicator, L button,
a digit = ingredient pile, a space = floor. Source: paper, App. A.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from operator import attrgetter
from pathlib import Path
from string import digits
from typing import Annotated, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.errors import OptionError, unknown_name
from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.cells import (
    BUTTON,
    EMPTY,
    FACING_OF,
    FACINGS,
    GOAL,
    INDICATOR,
    NOWHERE,
    PILE,
    PLATE,
    PLATES,
    POT,
    STEP,
    VISIBLE,
    WALL,
    WINDOW,
)
from icrl4aht_data.overcooked.tables import Tables, make_tables
from icrl4aht_data.utils.options import convert_option
from icrl4aht_data.utils.plugins import Plugins

_LETTERS = {"W": WALL, "X": GOAL, "P": POT, "R": INDICATOR, "L": BUTTON, "B": PLATES, " ": EMPTY, "A": EMPTY}
_type_hints = cache(get_type_hints)  # cached, since resolving type hints takes as long as all checks of a layout


@dataclass(frozen=True, eq=False)
class Layout:
    """A map with its recipes; every property is derived from the arguments of this class.

    Args:
        name: the paper's short name, such as coord_simple.
        alias: the environment name in OvercookedV2 and in the published manifests, such as grounded_coord_simple.
        rows: the map, one string per row, all of the same length; docs/format.md explains the letters.
        recipes: at least one triple of ingredient ids; the current recipe is drawn uniformly from the recipes.
        indicates_delivery: whether the observation has the delivery channel.

    Raises:
        OptionError: if the map is not rectangular, has an unknown letter, does not have exactly two agents, has piles
            of more than three ingredient types (an item is one byte), or an agent can reach the map's edge; or if two
            recipes are equal, there is no recipe, or an ingredient has no pile.
    """

    name: str
    alias: str
    rows: tuple[str, ...]
    recipes: tuple[tuple[int, int, int], ...] = ((0, 0, 0), (1, 1, 1))
    indicates_delivery: bool = False

    def __post_init__(self) -> None:
        for name, kind in _type_hints(Layout).items():
            object.__setattr__(self, name, convert_option(f"layout {self.name}: {name}", getattr(self, name), kind))
        for fault in self._faults():
            raise OptionError(f"layout {self.name}: {fault}")

    def _faults(self) -> Iterator[str]:
        """Yield what is wrong with the map and the recipes; each check assumes that earlier checks found nothing."""
        if len({len(row) for row in self.rows}) != 1:
            yield f"the rows have widths {[len(row) for row in self.rows]}, expected equal widths"
        wrong = {c for row in self.rows for c in row if c not in _LETTERS and c not in digits}
        if wrong:
            yield f"unknown map letters {sorted(wrong)}"
        if len(self.agent_cells) != 2:
            yield f"the map has {len(self.agent_cells)} agents 'A', expected 2"
        if self.cells > NOWHERE - 1 or len(self.ingredients) > 3:
            yield (
                f"the map has {self.cells} cells and piles of {len(self.ingredients)} ingredient types; "
                f"a state record holds at most {NOWHERE - 1} cells and 3 types"
            )
        for cell in self.walkable.nonzero()[0]:
            x, y = cell % self.width, cell // self.width
            if x in (0, self.width - 1) or y in (0, self.height - 1):
                yield f"an agent can reach the map's edge at ({x}, {y})"
        missing = {i for recipe in self.recipes for i in recipe} - set(self.ingredients)
        if missing:
            yield f"recipes use ingredients {sorted(missing)} that have no pile"
        # A recipe listed in two orders of its ingredients would be drawn twice as often.
        if not self.recipes or len({tuple(sorted(recipe)) for recipe in self.recipes}) < len(self.recipes):
            yield f"expected at least one recipe, and no recipe twice, found {list(self.recipes)}"

    @property
    def width(self) -> int:
        """Number of the map's columns."""
        return len(self.rows[0])

    @property
    def height(self) -> int:
        """Number of the map's rows."""
        return len(self.rows)

    @property
    def cells(self) -> int:
        """Number of cells; a cell's number is y * width + x."""
        return self.width * self.height

    @cached_property
    def agent_cells(self) -> tuple[int, ...]:
        """Start cells of the agents, marked `A`, in reading order: the ego's, then the teammate's."""
        return tuple(i for i, c in enumerate("".join(self.rows)) if c == "A")

    @cached_property
    def kinds(self) -> np.ndarray:
        """uint8 (cells,): kind of each cell, such as `cells.WALL`."""
        return np.array([PILE if c in digits else _LETTERS[c] for c in "".join(self.rows)], np.uint8)

    @cached_property
    def ingredients(self) -> tuple[int, ...]:
        """Ids of the ingredients that have a pile, in ascending order.

        Bits 2 + 2k and 3 + 2k of an item byte are the number of pieces of `ingredients[k]`.
        """
        return tuple(sorted({int(c) for c in "".join(self.rows) if c in digits}))

    @cached_property
    def ingredient_types(self) -> int:
        """Number n of ingredient types in the channels: the highest id of an ingredient that has a pile, plus 1."""
        return max(self.ingredients) + 1

    @cached_property
    def piles(self) -> np.ndarray:
        """uint8 (cells,): item byte that an agent takes from the pile on a cell; 0 for cells without a pile."""
        items = [PLATE if c == "B" else self.ingredient_item(int(c)) if c in digits else 0 for c in "".join(self.rows)]
        return np.array(items, np.uint8)

    @cached_property
    def channels(self) -> int:
        """Number C of observation channels: 25 + 5 * `ingredient_types`, plus 1 with the delivery indicator."""
        return 25 + 5 * self.ingredient_types + int(self.indicates_delivery)

    @property
    def obs_shape(self) -> tuple[int, int, int]:
        """Shape of an observation, (5, 5, C)."""
        return (WINDOW, WINDOW, self.channels)

    def ingredient_item(self, ingredient: int) -> int:
        """Return the item byte of one piece of an ingredient."""
        return 4 << (2 * self.ingredients.index(ingredient))

    def recipe_item(self, recipe: tuple[int, int, int]) -> int:
        """Return the item byte of a recipe, which is the sum of its three ingredients' bytes, without flags."""
        return sum(self.ingredient_item(i) for i in recipe)

    @cached_property
    def recipe_items(self) -> np.ndarray:
        """uint8 (R,): item bytes of the layout's R recipes."""
        return np.array([self.recipe_item(recipe) for recipe in self.recipes], np.uint8)

    @cached_property
    def rooms(self) -> tuple[np.ndarray, np.ndarray]:
        """Pair of ascending uint8 arrays: floor cells that the ego can reach, and those that the teammate can reach."""
        first, second = (self._reachable(cell) for cell in self.agent_cells)
        return first, second

    def _reachable(self, start: int) -> np.ndarray:
        floor = set((self.kinds == EMPTY).nonzero()[0].tolist())
        room, edge = set(), {start}
        while edge:
            room |= edge
            # A step beyond the map's edge would wrap to another row, but `_faults` rejects maps with a reachable edge.
            edge = {cell + dy * self.width + dx for cell in edge for dx, dy in STEP.values()} & floor - room
        return np.array(sorted(room), np.uint8)

    @cached_property
    def shows_recipe(self) -> bool:
        """Whether the ego can see a recipe indicator or a button from at least one cell that it can reach."""
        seen = self.window[self.rooms[EGO]]
        return bool(np.isin(self.kinds[seen[seen >= 0]], (INDICATOR, BUTTON)).any())

    @cached_property
    def walkable(self) -> np.ndarray:
        """bool (cells,): True for floor cells that at least one agent can reach."""
        return np.isin(np.arange(self.cells), np.concatenate(self.rooms))

    @cached_property
    def ahead(self) -> np.ndarray:
        """uint8 (cells, 4): cell ahead, by the agent's cell and facing; 0 if the agent's cell is not walkable."""
        steps = [dy * self.width + dx for dx, dy in (STEP[name] for name in FACINGS)]
        return np.where(self.walkable[:, None], np.arange(self.cells)[:, None] + steps, 0).astype(np.uint8)

    @cached_property
    def moves(self) -> np.ndarray:
        """uint8 (cells, 6): an agent's next cell by its cell and action, unless the other agent blocks the move."""
        here = np.arange(self.cells, dtype=np.uint8)[:, None]
        target = self.ahead[:, FACING_OF]
        moved = np.where(self.walkable[:, None] & self.walkable[target], target, here)
        return np.concatenate([moved, here, here], axis=1)  # `stay` and `interact` do not move the agent

    @cached_property
    def pots(self) -> tuple[int, ...]:
        """Numbers of the cells with a pot, in reading order."""
        return tuple(int(c) for c in (self.kinds == POT).nonzero()[0])

    @cached_property
    def buttons(self) -> tuple[int, ...]:
        """Numbers of the cells with a button, in reading order."""
        return tuple(int(c) for c in (self.kinds == BUTTON).nonzero()[0])

    @cached_property
    def counters(self) -> tuple[int, ...]:
        """Numbers of the wall cells that an agent can face, in reading order; only these walls can hold an item."""
        reach = np.unique(self.ahead[self.walkable])
        return tuple(int(c) for c in reach if self.kinds[c] == WALL)

    @cached_property
    def window(self) -> np.ndarray:
        """int16 (cells, 25): cells of the 5 x 5 window around each cell, in reading order; -1 outside the map."""
        cell, position, reach = np.arange(self.cells)[:, None], np.arange(VISIBLE), WINDOW // 2
        x, y = cell % self.width + position % WINDOW - reach, cell // self.width + position // WINDOW - reach
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return np.where(inside, y * self.width + x, -1).astype(np.int16)

    @cached_property
    def window_position(self) -> np.ndarray:
        """uint8 (cells, cells): position of the second cell in the window of the first cell; NOWHERE if outside."""
        table = np.full((self.cells, self.cells), NOWHERE, np.uint8)
        cell, position = np.nonzero(self.window >= 0)
        table[cell, self.window[cell, position]] = position
        return table

    @cached_property
    def tables(self) -> Tables:
        """Lookup tables of this layout, which the functions for rules, observations and scripted agents read."""
        return make_tables(self)

    def __repr__(self) -> str:
        return f"Layout({self.name!r}, {self.width}x{self.height}, C={self.channels})"


def tables_of(layout: Layout | Tables) -> Tables:
    """Return the lookup tables of a layout; an argument that is already `Tables` is returned unchanged."""
    return layout.tables if isinstance(layout, Layout) else layout


_ALL = (
    Layout("coord_simple", "grounded_coord_simple", ("WW2WWWWW", "W  WB  0", "R ALPA X", "W  WB  1", "WW2WWWWW")),
    Layout(
        "coord_ring",
        "grounded_coord_ring",
        (
            "WWW2R2WWW",
            "W       W",
            "W WWLWW W",
            "2 0   B 2",
            "RAXAP X R",
            "2 1   B 2",
            "W WWLWW W",
            "W       W",
            "WWW2R2WWW",
        ),
    ),
    Layout(
        "test_simple",
        "test_time_simple",
        ("WW2WWWWW", "W  WB  0", "R AWPA X", "W  WB  1", "WW2WWWWW"),
        indicates_delivery=True,
    ),
    Layout(
        "test_wide",
        "test_time_wide",
        ("WWXBWW", "0 A  0", "1    1", "WPWPWW", "3 A  3", "W    W", "WWRWWW"),
        indicates_delivery=True,
    ),
    Layout(
        "demo_simple",
        "demo_cook_simple",
        ("WWWWWR2W0WW", "0      W  B", "W     APA X", "1      W  B", "WWWWWR2W1WW"),
    ),
    Layout(
        "demo_wide",
        "demo_cook_wide",
        ("WWWWBXBWWWW", "WWW0 A 1WWW", "WWWWWPWWWWW", "W    A    W", "0  W3R3W  0", "W1WWWWWWW1W"),
    ),
    Layout(
        "asymm_both",
        "asymm_advantages_recipes_both",
        ("WWWWWWWWW", "0 WXW01 X", "1   P   R", "R A PA  W", "WWWBWBWWW"),
    ),
    Layout(
        "asymm_right",
        "asymm_advantages_recipes_right",
        ("WWWWWWWWW", "0 WXW01 X", "1   P   R", "W A PA  W", "WWWBWBWWW"),
    ),
    Layout("cramped_up", "cramped_room_up", ("WWPWW", "0A A1", "W   R", "WBWXW")),
    Layout("cramped_down", "cramped_room_down", ("WBWXW", "0A A1", "W   R", "WWPWW")),
)

LAYOUTS: dict[str, Layout] = {layout.name: layout for layout in _ALL}
"""The ten layouts of the benchmark by short name."""

_BY_ALIAS = {layout.alias: layout for layout in _ALL}

LAYOUT_PLUGINS = Plugins("icrl4aht.layouts", (*LAYOUTS, *_BY_ALIAS))
"""Layouts registered by other installed packages; no published task uses them."""

_content = attrgetter("rows", "recipes", "indicates_delivery")
_RELEASE_LAYOUTS: dict[str, Layout] = {}  # layouts from releases opened in this process, and generated layouts


def get_layout(name: str) -> Layout:
    """Return the layout with the given short name (coord_simple) or environment name (grounded_coord_simple).

    A layout registered by another package has only one name, see docs/extending.md.

    Raises:
        UnknownNameError: for an unknown layout; the message lists the valid names and suggests the nearest.
        PluginError: if a registered layout cannot be used.
    """
    if not isinstance(name, str):
        raise unknown_name("layout", name, all_layout_names())
    layout = LAYOUTS.get(name) or _BY_ALIAS.get(name) or _RELEASE_LAYOUTS.get(name) or _manifest_layouts().get(name)
    if layout is not None:
        return layout
    if name not in LAYOUT_PLUGINS.names:
        raise unknown_name("layout", name, all_layout_names())
    layout = LAYOUT_PLUGINS.load(name, Layout)
    if {layout.name, layout.alias} != {name}:
        raise LAYOUT_PLUGINS.error(
            name, f"expected name and alias {name!r}, found name {layout.name!r} and alias {layout.alias!r}"
        )
    return layout


class LayoutLine(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One line of a file of layouts, see `format.layouts_file`.

    Args:
        name: the layout's name, which is also its environment name.
        map: rows of the map, as strings.
        recipes: triples of ingredient ids.
        indicates_delivery: whether observations have the delivery channel.
        family: family of the generated layout, or `layouts_file.OTHER`.
        seed: seed of the sequence of generated layouts; None for a layout that was not generated.
        number: position of the layout in the sequence of generated layouts, or None.
    """

    name: str
    map: tuple[str, ...]
    recipes: Annotated[tuple[tuple[int, int, int], ...], Meta(min_length=1)]
    indicates_delivery: bool
    family: str
    seed: int | None = None
    number: int | None = None

    def layout(self) -> Layout:
        """Return the layout that the line describes; see `Layout` for the errors."""
        return Layout(self.name, self.name, self.map, self.recipes, self.indicates_delivery)


@cache
def _manifest_layouts() -> dict[str, Layout]:
    """Return the layouts of this package's tasks that are not among the benchmark's ten layouts, by name."""
    path = Path(__file__).parent.parent / "manifests" / "layouts.jsonl"
    lines = msgspec.json.Decoder(LayoutLine).decode_lines(path.read_bytes())
    return {line.name: line.layout() for line in lines}


@lru_cache(maxsize=1024)
def with_recipes(layout: Layout, recipes: tuple[tuple[int, int, int], ...]) -> Layout:
    """Return a copy of a layout with other recipes, cached by the arguments.

    Raises:
        OptionError: if there is no recipe, two recipes are equal, or an ingredient has no pile.
    """
    return replace(layout, recipes=recipes)


def add_layouts(layouts: Iterable[Layout]) -> list[Layout]:
    """Make layouts, such as those stored in an opened release, available to `get_layout` in this process.

    Returns:
        The layouts; for a layout that was already available, the existing object.

    Raises:
        OptionError: if a layout has the name of a different available layout.
    """
    found = []
    for layout in layouts:
        is_known = layout.name in all_layout_names() or layout.name in _manifest_layouts()
        known = get_layout(layout.name) if is_known else layout
        if _content(known) != _content(layout):
            raise OptionError(
                f"layout {layout.name!r}: differs from the known layout of this name; expected "
                f"{'/'.join(known.rows)} with recipes {known.recipes}, found {'/'.join(layout.rows)} with recipes "
                f"{layout.recipes}: give the new layout another name"
            )
        found.append(_RELEASE_LAYOUTS.setdefault(layout.name, known))
    return found


def added_layout_names() -> tuple[str, ...]:
    """Return the names of layouts registered by other packages, stored in opened releases, or generated."""
    return (*LAYOUT_PLUGINS.names, *(name for name in _RELEASE_LAYOUTS if name not in LAYOUTS))


def known_layouts() -> list[Layout]:
    """Return all layouts: those of the benchmark, of this package's tasks, of other packages and opened releases."""
    return list({name: get_layout(name) for name in (*LAYOUTS, *_manifest_layouts(), *added_layout_names())}.values())


def all_layout_names() -> list[str]:
    """Return the short and environment names of the benchmark's layouts, and the names of added layouts."""
    return [*LAYOUTS, *_BY_ALIAS, *added_layout_names()]
