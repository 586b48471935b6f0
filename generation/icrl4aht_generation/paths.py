"""Features of a state for scripted agents: masks over cells, shortest paths, and moves along these paths.

`cells` denotes the cells of the layout, row by row. Scripted agents see the complete state. Paths ignore the partner.
Ties between first steps are resolved in the order right, down, left, up, ties between access cells in the order above,
below, left, right, and ties between targets row by row. Source: paper, App. B.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from icrl4aht_data.overcooked.actions import INTERACT, STAY
from icrl4aht_data.overcooked.cells import (
    BUTTON,
    COOKED,
    FACING_OF,
    GOAL,
    INDICATOR,
    NOWHERE,
    PILE,
    PLATE,
    PLATES,
    POT,
    WALL,
)
from icrl4aht_data.overcooked.state import State, ingredient_count, unpack
from icrl4aht_data.overcooked.tables import SEARCH_ORDER, Tables

UNREACHABLE = 10_000
"""Distance of a cell that cannot be reached."""

_ACTION_OF_FACING = np.argsort(FACING_OF)


def is_dish(item: UInt8[Array, "*B"]) -> Bool[Array, "*B"]:
    """Return whether an item is a plate with a cooked soup."""
    return (item & (PLATE | COOKED)) == (PLATE | COOKED)


def is_ingredient(item: UInt8[Array, "*B"]) -> Bool[Array, "*B"]:
    """Return whether an item consists of ingredients without a plate."""
    return (item >> 2 > 0) & ((item & PLATE) == 0)


def _path_length(distance: UInt8[Array, "*B"]) -> Int[Array, "*B"]:
    return jnp.where(distance < NOWHERE, distance.astype(jnp.int32), UNREACHABLE)


class Rule(NamedTuple):
    """Rule of a teammate: if a condition holds and a target can be reached, go to the nearest target.

    Attributes:
        when: bool scalar, condition of the rule.
        targets: bool (cells,), cells to go to.
        waits: Python bool, whether to face the target and wait instead of interacting.
    """

    when: Bool[Array, ""]
    targets: Bool[Array, " cells"]
    waits: bool = False


class ChosenRule(NamedTuple):
    """The first rule of a list that applies. If no rule applies, only `found` is meaningful.

    Attributes:
        found: bool scalar, whether a rule applies.
        number: int32 scalar, the rule's position in the list.
        target: int32 scalar, cell of the nearest target of the rule.
        waits: bool scalar, the rule's `waits`.
    """

    found: Bool[Array, ""]
    number: Int[Array, ""]
    target: Int[Array, ""]
    waits: Bool[Array, ""]


@dataclass(frozen=True, eq=False)
class Scene:
    """Features of a state from one agent's view; a feature is computed when it is first used.

    All masks are bool arrays of shape (cells,).

    Attributes:
        tables: tables of the layout.
        record: uint8 (S,), the state record.
        slot: 0 or 1, the agent with this view; the other agent is its partner.
    """

    tables: Tables
    record: UInt8[Array, " S"]
    slot: int

    @cached_property
    def state(self) -> State:
        """Fields of the state record."""
        return unpack(self.tables, self.record)

    @cached_property
    def cells(self) -> Int[Array, " cells"]:
        """Cell numbers of all cells of the layout."""
        return jnp.arange(self.tables.kinds.shape[0])

    @cached_property
    def own_cell(self) -> Int[Array, ""]:
        """Cell number of the agent's position."""
        return self.state.positions[self.slot].astype(jnp.int32)

    @cached_property
    def partner_cell(self) -> Int[Array, ""]:
        """Cell number of the partner's position."""
        return self.state.positions[1 - self.slot].astype(jnp.int32)

    # Properties for the items in both agents' hands

    @cached_property
    def hand(self) -> UInt8[Array, ""]:
        """Item byte in the agent's hand."""
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
        """Item byte in the partner's hand."""
        return self.state.hands[1 - self.slot]

    # Properties and methods for masks over cells

    def cells_of_kind(self, kind: int) -> Bool[Array, " cells"]:
        """Return the mask of cells of a kind."""
        return jnp.asarray(self.tables.kinds) == kind

    def cells_near(self, kind: int) -> Bool[Array, " cells"]:
        """Return the mask of cells next to a cell of a kind: above, below, left or right."""
        return (jnp.asarray(self.tables.near) >> kind & 1) > 0

    def values_on_cells(self, kind: int, values: Array) -> Array:
        """Return a value for each cell: the value of the pot, button or counter on the cell, or 0."""
        # A gather is used, because a scatter of traced values is slow under vmap.
        number = jnp.asarray(self.tables.number)
        if not values.shape[0]:
            return jnp.zeros(number.shape, values.dtype)
        found = values[jnp.minimum(number, values.shape[0] - 1)]
        return jnp.where(self.cells_of_kind(kind) & (number < NOWHERE), found, jnp.zeros((), values.dtype))

    @cached_property
    def fillable_pots(self) -> Bool[Array, " P"]:
        """Whether each pot takes another ingredient, in the order of the layout's pots."""
        # A pot with three ingredients cooks by itself, so full pots are cooking or cooked.
        items = self.state.pot_items
        exists = jnp.asarray(self.tables.pots) < NOWHERE
        return exists & (self.state.pot_timers == 0) & ((items & COOKED) == 0) & (ingredient_count(items) < 3)

    @cached_property
    def fillable_pot_cells(self) -> Bool[Array, " cells"]:
        """Mask of the cells of pots that take another ingredient."""
        return self.values_on_cells(POT, self.fillable_pots)

    @cached_property
    def cooking(self) -> Bool[Array, " cells"]:
        return self.values_on_cells(POT, self.state.pot_timers > 0)

    @cached_property
    def cooked(self) -> Bool[Array, " cells"]:
        return self.values_on_cells(POT, (self.state.pot_items & COOKED) > 0)

    @cached_property
    def pots(self) -> Bool[Array, " cells"]:
        return self.cells_of_kind(POT)

    @cached_property
    def pots_in_use(self) -> Bool[Array, " cells"]:
        """Mask of pots that contain ingredients, raw, cooking or cooked."""
        return self.values_on_cells(POT, self.state.pot_items > 0)

    @cached_property
    def counter_ingredients(self) -> Bool[Array, " cells"]:
        """Mask of counters with an ingredient on top."""
        return self.values_on_cells(WALL, is_ingredient(self.state.counters))

    @cached_property
    def empty_counters(self) -> Bool[Array, " cells"]:
        """Mask of walls and counters without an item, including unreachable walls."""
        # The published teammates also target unreachable walls; `first` skips rules without a reachable target.
        taken = self.values_on_cells(WALL, self.state.counters > 0)
        return self.cells_of_kind(WALL) & ~taken

    @cached_property
    def button_lit(self) -> Bool[Array, ""]:
        return jnp.any(self.state.buttons > 0)

    @cached_property
    def needed(self) -> Int[Array, " 3"]:
        """Number of pieces of each ingredient that the recipe still needs, given the contents of all pots together."""
        # As in the published code, the contents of all pots are added up as if they were in one pot.
        return jnp.maximum(
            self.ingredient_counts(self.state.recipe) - self.ingredient_counts(self.state.pot_items).sum(axis=0), 0
        )

    @staticmethod
    def ingredient_counts(item: UInt8[Array, "*B"]) -> Int[Array, "*B 3"]:
        """Return how many pieces of each ingredient an item has; counts are in order of id and padded to 3 with 0."""
        # An item byte has two bits for each ingredient, above the bits of plate and cooked.
        shift = 2 + 2 * jnp.arange(3, dtype=jnp.uint8)
        return (item[..., None] >> shift & 3).astype(jnp.int32)

    def piles_of(self, wanted: Bool[Array, " 3"]) -> Bool[Array, " cells"]:
        """Return the mask of piles of the wanted ingredient types."""
        piles = jnp.asarray(self.tables.piles)
        return jnp.any((self.ingredient_counts(piles) > 0) & wanted, axis=-1) & self.cells_of_kind(PILE)

    @cached_property
    def needed_piles(self) -> Bool[Array, " cells"]:
        return self.piles_of(self.needed > 0)

    @cached_property
    def recipe_piles(self) -> Bool[Array, " cells"]:
        return self.piles_of(self.ingredient_counts(self.state.recipe) > 0)

    @cached_property
    def goals(self) -> Bool[Array, " cells"]:
        return self.cells_of_kind(GOAL)

    @cached_property
    def plate_piles(self) -> Bool[Array, " cells"]:
        return self.cells_of_kind(PLATES)

    @cached_property
    def buttons(self) -> Bool[Array, " cells"]:
        return self.cells_of_kind(BUTTON)

    @cached_property
    def indicators(self) -> Bool[Array, " cells"]:
        return self.cells_of_kind(INDICATOR)

    # Methods for distances and moves

    def distances(self, cell: Int[Array, ""]) -> Int[Array, " cells"]:
        """Return the distances from a floor cell to all other cells; UNREACHABLE without a path."""
        return _path_length(jnp.asarray(self.tables.distance)[cell])

    @cached_property
    def _target_distance(self) -> Int[Array, " cells"]:
        return _path_length(jnp.asarray(self.tables.target_distance)[self.own_cell])

    def manhattan(self, cell: Int[Array, "*B"], other: Int[Array, "*B"]) -> Int[Array, "*B"]:
        """Return the Manhattan distance of two cells, or of broadcast arrays of cells."""
        x, y = jnp.asarray(self.tables.column), jnp.asarray(self.tables.row)
        return jnp.abs(x[cell] - x[other]) + jnp.abs(y[cell] - y[other])

    def neighbours(self, cell: Int[Array, ""]) -> Int[Array, " 4"]:
        """Return the cells above, below, left and right of a cell; -1 outside the map."""
        width, height = jnp.asarray(self.tables.size)
        x = jnp.asarray(self.tables.column)[cell] + jnp.array([0, 0, -1, 1])
        y = jnp.asarray(self.tables.row)[cell] + jnp.array([-1, 1, 0, 0])
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return jnp.where(inside, y * width + x, -1)

    def access_cells(self, target: Int[Array, ""]) -> Int[Array, " 4"]:
        """Return the floor cells above, below, left and right of a cell; -1 for neighbours that are not floor."""
        cells = self.neighbours(target)
        return jnp.where((cells >= 0) & jnp.asarray(self.tables.walkable)[cells], cells, -1)

    def single_access_cell(self, target: Int[Array, ""]) -> Int[Array, ""]:
        """Return the only access cell of a target; -1 if the target has none or several."""
        access = self.access_cells(target)
        return jnp.where(jnp.sum(access >= 0) == 1, jnp.max(access), -1)

    def first_step(self, cell: Int[Array, ""]) -> Int[Array, ""]:
        """Return the action of the first step towards a floor cell."""
        return jnp.asarray(self.tables.first_step)[self.own_cell, cell].astype(jnp.int32)

    def reachable(self, mask: Bool[Array, " cells"]) -> Bool[Array, " cells"]:
        """Restrict a mask to cells next to a floor cell that the agent can reach."""
        return mask & (self._target_distance < UNREACHABLE)

    def nearest_distance(self, mask: Bool[Array, " cells"]) -> Int[Array, ""]:
        """Return the distance to the nearest access cell of any cell in the mask; UNREACHABLE without a path."""
        return jnp.min(jnp.where(mask, self._target_distance, UNREACHABLE))

    def nearest_cell(self, mask: Bool[Array, " cells"]) -> Int[Array, ""]:
        """Return the nearest cell of the mask, with ties in reading order; undefined if no cell is reachable."""
        return jnp.argmin(jnp.where(mask, self._target_distance, UNREACHABLE))

    def first(self, rules: Sequence[Rule]) -> ChosenRule:
        """Return the first rule that applies, with the rule's nearest target."""
        # All rules are evaluated, because a branch would run both sides under vmap anyway.
        targets = jnp.stack([rule.targets for rule in rules])
        possible = jnp.stack([rule.when for rule in rules]) & jnp.any(self.reachable(targets), axis=-1)
        number = jnp.argmax(possible)
        waits = jnp.asarray(np.array([rule.waits for rule in rules]))[number]
        return ChosenRule(jnp.any(possible), number, self.nearest_cell(targets[number]), waits)

    def approach(
        self, target: Int[Array, ""], extra: Float[Array, " cells"] | None = None
    ) -> tuple[Int[Array, ""], Int[Array, ""] | Float[Array, ""]]:
        """Return the step towards the cheapest access cell of a target, and the cell's cost.

        The cost is the distance, plus 100 if the partner is on the cell, plus the cell's value in `extra`.
        """
        access = self.access_cells(target)
        # No path is as long as 100, so an occupied access cell is only chosen if no other can be reached.
        distance = jnp.where(access >= 0, self.distances(self.own_cell)[access], UNREACHABLE)
        cost = distance + 100 * (access == self.partner_cell)
        if extra is not None:
            cost = cost + extra[access]
        best = jnp.argmin(cost)
        return jnp.where(cost[best] < UNREACHABLE, self.first_step(access[best]), STAY), cost[best]

    def go_to(
        self,
        target: Int[Array, ""],
        waits: Bool[Array, ""] | bool = False,
        step: Int[Array, ""] | None = None,
    ) -> Int[Array, ""]:
        """Return the next action to walk to a target, face the target, and then interact or wait.

        The argument `step` replaces the step of `approach`.
        """
        adjacent = self.manhattan(self.own_cell, target) == 1
        direction = jnp.argmax(self.neighbours(self.own_cell) == target)  # number of the action up, down, left or right
        faced = jnp.asarray(_ACTION_OF_FACING)[self.state.facings[self.slot].astype(jnp.int32)]
        # A move towards an adjacent target only turns the agent, because targets block the move.
        action = jnp.where(faced == direction, jnp.where(waits, STAY, INTERACT), direction)
        return jnp.where(adjacent, action, self.approach(target)[0] if step is None else step)

    @cached_property
    def move_cells(self) -> Int[Array, " 4"]:
        """Cells to which a move right, down, left or up leads; the agent's cell if the map blocks the move."""
        return jnp.asarray(self.tables.moves)[self.own_cell, jnp.array(SEARCH_ORDER)].astype(jnp.int32)

    @cached_property
    def free_moves(self) -> Bool[Array, " 4"]:
        """Whether neither the map nor the partner blocks a move right, down, left or up."""
        return (self.move_cells != self.own_cell) & (self.move_cells != self.partner_cell)

    def sidestep(self, otherwise: Int[Array, ""] | int) -> Int[Array, ""]:
        """Return the first free move in the order right, down, left, up, or `otherwise` if no move is free."""
        return self.best_move(self.free_moves, jnp.zeros(4), otherwise)

    def best_move(
        self,
        allowed: Bool[Array, " 4"],
        score: Int[Array, " 4"] | Float[Array, " 4"],
        otherwise: Int[Array, ""] | int = STAY,
    ) -> Int[Array, ""]:
        """Return the allowed move with the highest score; ties are resolved in the order right, down, left, up."""
        best = jnp.argmax(jnp.where(allowed, score, -jnp.inf))
        return jnp.where(jnp.any(allowed), jnp.asarray(SEARCH_ORDER)[best], otherwise)

    def wander(self, stay_score: int = 50) -> Int[Array, ""]:
        """Return a move to a free neighbour cell.

        If no cell is free, return `stay`, or a move towards an adjacent partner if `stay_score` > 100.
        """
        # As in the published code, pushing costs 100, so a `stay_score` above 100 prefers pushing to staying.
        scores = jnp.where(self.move_cells == self.own_cell, 1000, 100 * (self.move_cells == self.partner_cell))
        best = jnp.argmin(jnp.append(scores, stay_score))
        return jnp.asarray((*SEARCH_ORDER, STAY))[best]

    def destination(self, action: Int[Array, ""]) -> Int[Array, ""]:
        """Return the cell to which a move action points, ignoring walls; the agent's cell for other actions."""
        ahead = self.neighbours(self.own_cell)[jnp.minimum(action, 3)]
        return jnp.where(action < 4, ahead, self.own_cell)
