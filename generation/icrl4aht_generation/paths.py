"""Features of a state for scripted agents: shortest paths of the layout, masks over cells, and moves made of them.

`cells` denotes the cells of the layout, row by row. Scripted agents see the complete state. The partner never blocks a
path; ties resolve in the order right, down, left, up (first steps) and above, below, left, right (access cells),
scanning targets row by row. Source: paper, App. B.2.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from icrl4aht_data.overcooked.actions import DOWN, INTERACT, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.cells import BUTTON, COOKED, FACING_OF, GOAL, INDICATOR, PLATE, PLATES, POT, STEP, WALL
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import ingredient_count, unpack

UNREACHABLE = 10_000
"""Distance of a cell that cannot be reached."""

_SEARCH_ORDER = (RIGHT, DOWN, LEFT, UP)
_ACCESS_ORDER = ("up", "down", "left", "right")
_ACTION_OF_FACING = np.argsort(FACING_OF)


@dataclass(frozen=True, eq=False)
class Paths:
    """Distances and first steps of one layout, as NumPy lookup tables that are compiled into the policies."""

    layout: Layout

    @cached_property
    def neighbours(self) -> np.ndarray:
        """int32 (cells, 4): the cell above, below, left and right of each cell, -1 outside the map."""
        layout = self.layout
        # Walls, too, have neighbours: a counter's are the cells that it can be used from.
        found = np.full((layout.cells, 4), -1, np.int32)
        for cell in range(layout.cells):
            for k, name in enumerate(_ACCESS_ORDER):
                x, y = cell % layout.width + STEP[name][0], cell // layout.width + STEP[name][1]
                if 0 <= x < layout.width and 0 <= y < layout.height:
                    found[cell, k] = y * layout.width + x
        return found

    @cached_property
    def _search(self) -> tuple[np.ndarray, np.ndarray]:
        """Breadth-first search from every floor cell: distances, and the first action on the way."""
        cells = self.layout.cells
        distance = np.full((cells, cells), UNREACHABLE, np.int32)
        first = np.full((cells, cells), STAY, np.int32)
        # Python loops are fast enough: layouts have fewer than 100 cells, and each is searched once.
        for origin in self.layout.walkable.nonzero()[0]:
            distance[origin, origin] = 0
            queue = deque([int(origin)])
            while queue:
                cell = queue.popleft()
                for action in _SEARCH_ORDER:
                    target = int(self.layout.moves[cell, action])
                    # Only the first visit counts, so the order of the actions decides between equal paths. The
                    # published teammates search in this order, and their actions depend on it.
                    if distance[origin, target] == UNREACHABLE:
                        distance[origin, target] = distance[origin, cell] + 1
                        first[origin, target] = action if cell == origin else first[origin, cell]
                        queue.append(target)
        return distance, first

    @property
    def distance(self) -> np.ndarray:
        """int32 (cells, cells): shortest distance between floor cells; UNREACHABLE if there is no path."""
        return self._search[0]

    @property
    def first_step(self) -> np.ndarray:
        """int32 (cells, cells): the action of the first step from one floor cell towards another."""
        return self._search[1]

    @cached_property
    def access(self) -> np.ndarray:
        """int32 (cells, 4): the floor cells above, below, left and right of a cell; -1 for other cells."""
        floor = (self.neighbours >= 0) & self.layout.walkable[self.neighbours]
        return np.where(floor, self.neighbours, -1)

    @cached_property
    def access_distance(self) -> np.ndarray:
        """int32 (cells, cells, 4): distance from a floor cell to each access cell of a target."""
        # An index of -1 reads the last cell, which `where` then replaces.
        return np.where(self.access >= 0, self.distance[:, self.access], UNREACHABLE)

    @cached_property
    def target_distance(self) -> np.ndarray:
        """int32 (cells, cells): distance from a floor cell to the nearest access cell of a target."""
        return self.access_distance.min(axis=-1)

    @cached_property
    def only_access(self) -> np.ndarray:
        """int32 (cells,): the access cell of a target that has exactly one, else -1."""
        return np.where((self.access >= 0).sum(axis=1) == 1, self.access.max(axis=1), -1)

    @cached_property
    def manhattan(self) -> np.ndarray:
        """int32 (cells, cells): Manhattan distance."""
        cell = np.arange(self.layout.cells)
        x, y = cell % self.layout.width, cell // self.layout.width
        return np.abs(x[:, None] - x) + np.abs(y[:, None] - y)

    @cached_property
    def near_pot(self) -> np.ndarray:
        """bool (cells,): cells adjacent to a pot."""
        return (self.manhattan[:, list(self.layout.pots)] == 1).any(axis=1)

    def static(self, kind: int) -> np.ndarray:
        """Return the mask of cells of a kind, bool (cells,)."""
        return self.layout.kinds == kind


def is_dish(item: UInt8[Array, "*B"]) -> Bool[Array, "*B"]:
    """Return whether an item is a plate with a cooked soup."""
    return (item & (PLATE | COOKED)) == (PLATE | COOKED)


def is_ingredient(item: UInt8[Array, "*B"]) -> Bool[Array, "*B"]:
    """Return whether an item has ingredients and no plate."""
    return (item >> 2 > 0) & ((item & PLATE) == 0)


class Rule(NamedTuple):
    """Rule of a teammate: if a condition holds and a target can be reached, go to the nearest one.

    Attributes:
        when: bool scalar, the condition.
        targets: bool (cells,), cells to go to.
        waits: Python bool, whether to face the target and wait, instead of interacting with it.
    """

    when: Bool[Array, ""]
    targets: Bool[Array, " cells"]
    waits: bool = False


class Chosen(NamedTuple):
    """The first rule that applies. If none does, only `found` is defined.

    Attributes:
        found: bool scalar, whether a rule applies.
        number: int32 scalar, the rule's position in the list.
        target: int32 scalar, the nearest of its targets.
        waits: bool scalar, the rule's `waits`.
    """

    found: Bool[Array, ""]
    number: Int[Array, ""]
    target: Int[Array, ""]
    waits: Bool[Array, ""]


@dataclass(frozen=True, eq=False)
class Scene:
    """One state as a heuristic reads it. All masks are bool (cells,); everything is traced and computed on first use.

    Attributes:
        paths: lookup tables of the layout.
        record: uint8 (S,), the state record.
        slot: 0 or 1, the agent that reads it, "own" below; the other one is the partner.
    """

    paths: Paths
    record: UInt8[Array, " S"]
    slot: int

    @cached_property
    def state(self):
        """The record's fields."""
        return unpack(self.paths.layout, self.record)

    @cached_property
    def me(self) -> Int[Array, ""]:
        """The own cell."""
        return self.state.positions[self.slot].astype(jnp.int32)

    @cached_property
    def partner(self) -> Int[Array, ""]:
        """The partner's cell."""
        return self.state.positions[1 - self.slot].astype(jnp.int32)

    @cached_property
    def facing_action(self) -> Int[Array, ""]:
        """The move action of the own facing."""
        return jnp.asarray(_ACTION_OF_FACING)[self.state.facings[self.slot].astype(jnp.int32)]

    # Items in the agents' hands

    @cached_property
    def hand(self) -> UInt8[Array, ""]:
        """The item byte in the own hand."""
        return self.state.hands[self.slot]

    @cached_property
    def holds_nothing(self) -> Bool[Array, ""]:
        return self.hand == 0

    @cached_property
    def holds_plate(self) -> Bool[Array, ""]:
        return self.hand == PLATE

    @cached_property
    def holds_dish(self) -> Bool[Array, ""]:
        return is_dish(self.hand)

    @cached_property
    def holds_ingredient(self) -> Bool[Array, ""]:
        return is_ingredient(self.hand)

    @cached_property
    def partner_hand(self) -> UInt8[Array, ""]:
        """The item byte in the partner's hand."""
        return self.state.hands[1 - self.slot]

    # Masks over cells

    def _at(self, cells: tuple[int, ...], values: Array) -> Bool[Array, " cells"]:
        """Return a mask with one value for each of some cells, False elsewhere."""
        # A gather by a constant table, since a scatter by traced values is slow under vmap.
        number = np.zeros(self.paths.layout.cells, np.int32)
        number[list(cells)] = range(len(cells))
        listed = np.isin(np.arange(self.paths.layout.cells), cells)
        return values[number] & listed if cells else jnp.asarray(listed)

    @cached_property
    def _raw_and_idle(self) -> Bool[Array, " P"]:
        # A pot with three ingredients cooks by itself, so a full one is cooking or cooked.
        items = self.state.pot_items
        return (self.state.pot_timers == 0) & ((items & COOKED) == 0) & (ingredient_count(items) < 3)

    @cached_property
    def nonfull(self) -> Bool[Array, " cells"]:
        """Mask of pots that take another ingredient."""
        return self._at(self.paths.layout.pots, self._raw_and_idle)

    @cached_property
    def cooking(self) -> Bool[Array, " cells"]:
        return self._at(self.paths.layout.pots, self.state.pot_timers > 0)

    @cached_property
    def cooked(self) -> Bool[Array, " cells"]:
        return self._at(self.paths.layout.pots, (self.state.pot_items & COOKED) > 0)

    @cached_property
    def pots(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.paths.static(POT))

    @cached_property
    def pots_in_use(self) -> Bool[Array, " cells"]:
        """Pots with something in them, raw, cooking or cooked."""
        return self._at(self.paths.layout.pots, self.state.pot_items > 0)

    @cached_property
    def staged(self) -> Bool[Array, " cells"]:
        """Mask of counters with an ingredient."""
        return self._at(self.paths.layout.counters, is_ingredient(self.state.counters))

    @cached_property
    def empty_counters(self) -> Bool[Array, " cells"]:
        """Walls without an item, also unreachable ones."""
        # The published teammates also aim at walls that nobody reaches; `first` then skips the rule.
        taken = self._at(self.paths.layout.counters, self.state.counters > 0)
        return jnp.asarray(self.paths.static(WALL)) & ~taken

    @cached_property
    def button_lit(self) -> Bool[Array, ""]:
        return jnp.any(self.state.buttons > 0)

    @cached_property
    def needed(self) -> Int[Array, " types"]:
        """Missing pieces of each piled ingredient, over all pots together."""
        # Over all pots together, as published: two half-filled pots count as one.
        return jnp.maximum(self.counts(self.state.recipe) - self.counts(self.state.pot_items).sum(axis=0), 0)

    def counts(self, item: UInt8[Array, "*B"]) -> Int[Array, "*B types"]:
        """Return the number of pieces of each piled ingredient in an item, by ascending id."""
        # Two bits for each ingredient, above the bits of plate and cooked.
        shift = 2 + 2 * jnp.arange(len(self.paths.layout.ingredients), dtype=jnp.uint8)
        return (item[..., None] >> shift & 3).astype(jnp.int32)

    def piles_of(self, wanted: Bool[Array, " types"]) -> Bool[Array, " cells"]:
        """Return the piles of the wanted ingredient types."""
        layout = self.paths.layout
        mask = jnp.zeros(layout.cells, bool)
        for k, ingredient in enumerate(layout.ingredients):
            mask |= jnp.asarray(layout.piles == layout.ingredient_item(ingredient)) & wanted[k]
        return mask

    @cached_property
    def needed_piles(self) -> Bool[Array, " cells"]:
        return self.piles_of(self.needed > 0)

    @cached_property
    def recipe_piles(self) -> Bool[Array, " cells"]:
        return self.piles_of(self.counts(self.state.recipe) > 0)

    @cached_property
    def goals(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.paths.static(GOAL))

    @cached_property
    def plate_piles(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.paths.static(PLATES))

    @cached_property
    def buttons(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.paths.static(BUTTON))

    @cached_property
    def indicators(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.paths.static(INDICATOR))

    # Distances and moves

    @cached_property
    def _target_distance(self) -> Int[Array, " cells"]:
        return jnp.asarray(self.paths.target_distance)[self.me]

    def reach(self, mask: Bool[Array, " cells"]) -> Bool[Array, " cells"]:
        """Return the cells of the mask that are adjacent to a cell that can be walked to."""
        return mask & (self._target_distance < UNREACHABLE)

    def nearest_distance(self, mask: Bool[Array, " cells"]) -> Int[Array, ""]:
        """Return the distance to the nearest access cell of the mask; UNREACHABLE if there is none."""
        return jnp.min(jnp.where(mask, self._target_distance, UNREACHABLE))

    def closest(self, mask: Bool[Array, " cells"]) -> Int[Array, ""]:
        """Return the nearest cell of the mask, ties in reading order. Undefined if none is reachable."""
        return jnp.argmin(jnp.where(mask, self._target_distance, UNREACHABLE))

    def _turn_or(self, target: Int[Array, ""], when_facing: Int[Array, ""]) -> tuple[Bool[Array, ""], Int[Array, ""]]:
        """Return whether the target is adjacent, and the action in that case: turn to it, or `when_facing`."""
        # A move into a wall only turns the agent, which is how it comes to face an adjacent target.
        adjacent = jnp.asarray(self.paths.manhattan)[self.me, target] == 1
        direction = jnp.argmax(jnp.asarray(self.paths.neighbours)[self.me] == target)  # up, down, left, right
        return adjacent, jnp.where(self.facing_action == direction, when_facing, direction)

    def first(self, rules: Sequence[Rule]) -> Chosen:
        """Return the first rule that applies, with the nearest of its targets."""
        # All rules are evaluated and one is selected: under vmap a branch would run both sides anyway.
        targets = jnp.stack([rule.targets for rule in rules])
        possible = jnp.stack([rule.when for rule in rules]) & jnp.any(self.reach(targets), axis=-1)
        number = jnp.argmax(possible)
        waits = jnp.asarray(np.array([rule.waits for rule in rules]))[number]
        return Chosen(jnp.any(possible), number, self.closest(targets[number]), waits)

    def approach(
        self, target: Int[Array, ""], extra: np.ndarray | None = None
    ) -> tuple[Int[Array, ""], Int[Array, ""] | Float[Array, ""]]:
        """Return the step towards the target's nearest access cell, and that cell's cost: its distance, plus 100 if the
        partner is on it, plus `extra` (cells,)."""
        access = jnp.asarray(self.paths.access)[target]
        # 100 is more than any path: an occupied access cell is chosen only if there is no other.
        cost = jnp.asarray(self.paths.access_distance)[self.me, target] + 100 * (access == self.partner)
        if extra is not None:
            cost = cost + jnp.asarray(extra)[access]
        best = jnp.argmin(cost)
        step = jnp.asarray(self.paths.first_step)[self.me, access[best]]
        return jnp.where(cost[best] < UNREACHABLE, step, STAY), cost[best]

    def go_to(
        self,
        target: Int[Array, ""],
        waits: Bool[Array, ""] | bool = False,
        step: Int[Array, ""] | None = None,
    ) -> Int[Array, ""]:
        """Walk to the target; next to it, turn, then interact or wait. `step` replaces the step of `approach`."""
        adjacent, action = self._turn_or(target, jnp.where(waits, STAY, INTERACT))
        return jnp.where(adjacent, action, self.approach(target)[0] if step is None else step)

    def hover(self, target: Int[Array, ""]) -> Int[Array, ""]:
        """Walk to the target; next to it, turn and wait."""
        return self.go_to(target, waits=True)

    @cached_property
    def ways(self) -> Int[Array, " 4"]:
        """The cells to the right, below, left and above; the own cell where the way is blocked."""
        return jnp.asarray(self.paths.layout.moves[:, list(_SEARCH_ORDER)].astype(np.int32))[self.me]

    @cached_property
    def free(self) -> Bool[Array, " 4"]:
        """Mask of the `ways` that lead onto a floor cell without the partner."""
        return (self.ways != self.me) & (self.ways != self.partner)

    def sidestep(self, otherwise: Int[Array, ""] | int) -> Int[Array, ""]:
        """Return the first free move in search order."""
        return self.best_way(self.free, jnp.zeros(4), otherwise)

    def best_way(
        self,
        allowed: Bool[Array, " 4"],
        score: Int[Array, " 4"] | Float[Array, " 4"],
        otherwise: Int[Array, ""] | int = STAY,
    ) -> Int[Array, ""]:
        """Return the allowed way with the highest score, ties in search order."""
        best = jnp.argmax(jnp.where(allowed, score, -jnp.inf))
        return jnp.where(jnp.any(allowed), jnp.asarray(_SEARCH_ORDER)[best], otherwise)

    def wander(self, stay_score: int = 50) -> Int[Array, ""]:
        """Return a step onto a free neighbour, in search order; else stay, or (150) walk into the partner."""
        target = jnp.asarray(self.paths.layout.moves).astype(jnp.int32)[self.me]
        # Costs as published; `stay_score` between them decides whether it is better to stay than to push.
        scores = [jnp.where(target[a] == self.me, 1000, 100 * (target[a] == self.partner)) for a in _SEARCH_ORDER]
        best = jnp.argmin(jnp.stack([*scores, jnp.asarray(stay_score)]))
        return jnp.asarray((*_SEARCH_ORDER, STAY))[best]

    def destination(self, action: Int[Array, ""]) -> Int[Array, ""]:
        """Return the cell that a move action points at, walls ignored; the own cell for other actions."""
        ahead = jnp.asarray(self.paths.neighbours)[self.me, jnp.minimum(action, 3)]
        return jnp.where(action < 4, ahead, self.me)
