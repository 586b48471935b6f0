"""A scripted ego that sees the whole state: how much an ego can matter, beside `stay` and `random`.

It plays seat 0. It fills one pot at a time with what the recipe lacks, fetches the plate so that it arrives when the
soup is done, and delivers only what the recipe asks for; a soup that nobody asks for is plated and put on a counter.
With a second pot it cooks ahead. It never presses a button, and where its room shares nothing with the teammate's
and cannot produce a dish it stays. All of it is a function of the state and a few steps of memory, without chance.

P are the pots that the ego reaches, Q the recipes it may cook: the current one, then the layout's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, UInt8

from generation.teammates.base import Policy
from generation.teammates.paths import Paths
from icrl4aht_data.benchmark import EGO, INTERACT, STAY, TEAMMATE
from icrl4aht_data.overcooked.layouts import COOKED, GOAL, PILE, PLATE, PLATES, POT, WALL, Layout
from icrl4aht_data.overcooked.state import State, ingredient_count, record_size, unpack

import os

KNOB = eval(os.environ.get("KNOB", "{}"))
FAR = 1000
"""Steps to what cannot be reached."""

PATIENCE = 10
"""Steps without any change in the pots after which the ego no longer counts on the teammate's hand."""

_FACING_OF = np.array([0, 1, 3, 2])  # action up, down, left, right -> facing up, down, right, left


class Memory(NamedTuple):
    record: UInt8[Array, " S"]  # of the last step
    action: Int[Array, ""]  # of the last step
    calm: Int[Array, ""]  # steps since the pots or the recipe changed
    blocked: Int[Array, ""]  # steps in a row that the teammate stood where the ego wants to be
    plates: Bool[Array, ""]  # whether the teammate ever held a plate
    trust: Bool[Array, ""]  # whether the teammate delivers what it plates, as far as seen
    held: Int[Array, ""]  # steps that the teammate has held its dish


class Option(NamedTuple):
    """Something to do: go to the cheapest cell and interact."""

    when: Bool[Array, ""]
    cost: Int[Array, " cells"]  # FAR and more where it cannot be done


@dataclass(frozen=True, eq=False)
class Kitchen:
    """What the ego knows of a layout before it starts. NumPy."""

    layout: Layout

    @cached_property
    def mine(self) -> np.ndarray:
        """bool (cells,): what the ego can face."""
        return self._faced_from(EGO)

    @cached_property
    def theirs(self) -> np.ndarray:
        """bool (cells,): what the teammate can face."""
        return self._faced_from(TEAMMATE)

    def _faced_from(self, agent: int) -> np.ndarray:
        return np.isin(np.arange(self.layout.cells), self.layout.ahead[self.layout.rooms[agent]])

    @cached_property
    def shared_room(self) -> bool:
        return np.array_equal(*self.layout.rooms)

    @cached_property
    def pots(self) -> np.ndarray:
        """int (P,): numbers of the pots that the ego reaches."""
        return np.array([k for k, cell in enumerate(self.layout.pots) if self.mine[cell]], int)

    @cached_property
    def pot_cells(self) -> np.ndarray:
        return np.array(self.layout.pots, int)[self.pots]

    def of(self, kind: int, reach: np.ndarray) -> np.ndarray:
        return (self.layout.kinds == kind) & reach

    @cached_property
    def pile_masks(self) -> np.ndarray:
        """bool (types, cells): the piles of each ingredient that the ego reaches."""
        items = [self.layout.ingredient_item(i) for i in self.layout.ingredients]
        return (self.layout.piles == np.array(items)[:, None]) & self.mine

    @cached_property
    def mate_serves(self) -> bool:
        """Whether the teammate can plate and deliver soups of the ego's pots, also wrong ones."""
        theirs = self.theirs
        return bool(theirs[self.pot_cells].any() and self.of(GOAL, theirs).any() and self.of(PLATES, theirs).any())

    @cached_property
    def serves(self) -> bool:
        """Whether the ego can plate and deliver."""
        return bool(self.of(GOAL, self.mine).any() and self.of(PLATES, self.mine).any() and len(self.pots))

    @cached_property
    def matters(self) -> bool:
        """Whether the ego can do anything for the return."""
        shared = self.mine & self.theirs
        return self.serves or bool(self.of(POT, shared).any() or self.of(WALL, shared).any())

    @cached_property
    def apart(self) -> np.ndarray:
        """bool (P,): pots that the teammate, on its way from its piles, passes over for another one."""
        piles = [int(c) for c in (self.of(PILE, self.theirs)).nonzero()[0]]
        distance = Paths(self.layout).access_distance  # (cells, cells, 4)
        access = Paths(self.layout).access
        total = np.array(
            [sum(min(distance[a, pot].min() for a in access[pile] if a >= 0) for pile in piles) for pot in self.pot_cells]
        )
        return total > total.min() if len(total) else total > 0

    @cached_property
    def stations(self) -> np.ndarray:
        """bool (cells,): floor from which something other than a counter can be faced."""
        useful = np.isin(self.layout.kinds, [GOAL, POT, PILE, PLATES])
        return self.layout.walkable & useful[self.layout.ahead].any(axis=1)

    @cached_property
    def in_the_way(self) -> np.ndarray:
        """int32 (3, cells, cells): how much the ego on a cell hinders a teammate on another one that carries a dish,
        a plate or an ingredient, or nothing: 2 for each next cell of its ways to where it may be going, 1 beside it."""
        paths, layout = Paths(self.layout), self.layout
        table = np.zeros((3, layout.cells, layout.cells), np.int32)
        for carries, kinds in enumerate([(GOAL,), (POT,), (PILE, PLATES)]):
            for target in np.isin(layout.kinds, kinds).nonzero()[0]:
                for access in paths.access[target]:
                    for mate in layout.rooms[TEAMMATE]:
                        if access >= 0 and access != mate:
                            ahead = layout.moves[mate, paths.first_step[mate, access]]
                            table[carries, mate] += np.maximum(2 - paths.distance[ahead], 0)
        return table

    @cached_property
    def obstacles(self) -> np.ndarray:
        """int (O,): where a teammate can stand in the way; the first, -1, is nowhere."""
        return np.concatenate([[-1], self.layout.rooms[EGO] if self.shared_room else np.array([], int)]).astype(int)

    @cached_property
    def _ways(self) -> tuple[np.ndarray, np.ndarray]:
        layout, count = self.layout, len(self.obstacles)
        cells, room = layout.cells, layout.rooms[EGO]
        time = np.full((count, cells, 4, cells), FAR, np.int32)
        for facing in range(4):
            time[:, room, facing, layout.ahead[room, facing]] = 0
        ends = np.repeat(layout.moves[None, :, :4].astype(int), count, axis=0)
        here = np.broadcast_to(np.arange(cells)[None, :, None], ends.shape)
        ends = np.where(ends == self.obstacles[:, None, None], here, ends)
        while True:
            after = time[np.arange(count)[:, None, None], ends, _FACING_OF]  # (O, cells, actions, cells)
            shorter = np.minimum(time, np.minimum(after.min(axis=2) + 1, FAR)[:, :, None])
            if np.array_equal(shorter, time):
                break
            time = shorter
        action = np.where(time == 0, INTERACT, after.argmin(axis=2)[:, :, None])
        return time, action.astype(np.int32)

    @property
    def time(self) -> np.ndarray:
        """int32 (O, cells, 4, cells): steps until the ego, on a cell and facing somewhere, faces a cell."""
        return self._ways[0]

    @property
    def action(self) -> np.ndarray:
        """int32 (O, cells, 4, cells): the first action on that way; INTERACT if it faces it already."""
        return self._ways[1]

    @cached_property
    def leg(self) -> np.ndarray:
        """int32 (cells, cells): steps from facing one cell to facing another, in an empty room."""
        leg = np.full((self.layout.cells,) * 2, FAR, np.int32)
        for cell in self.layout.rooms[EGO]:
            for facing in range(4):
                faced = self.layout.ahead[cell, facing]
                leg[faced] = np.minimum(leg[faced], self.time[0, cell, facing])
        return leg

    @cached_property
    def trip(self) -> np.ndarray:
        """int32 (P, types): steps to bring one piece of an ingredient from its pile to a pot and to come back."""
        there = np.where(self.pile_masks[:, :, None], self.leg + self.leg.T, FAR)  # (types, cells, cells)
        return there.min(axis=1).T[self.pot_cells] + 2


def oracle(layout: Layout) -> Policy:
    """The scripted ego of a layout; it has no parameters."""
    kitchen = Kitchen(layout)

    def init(params, key: Key[Array, ""]) -> Memory:
        zero = jnp.int32(0)
        return Memory(jnp.zeros(record_size(layout), jnp.uint8), zero + STAY, zero, zero, zero > 0, zero == 0, zero)

    def act(params, memory: Memory, record: UInt8[Array, " S"], key: Key[Array, ""]):
        if not kitchen.matters:
            return jnp.int32(STAY), memory
        view = View(kitchen, record, memory)
        action, blocked = _decide(view)
        return action, Memory(record, action, view.calm, blocked, view.plater, view.trusted, view.held)

    return Policy((), init, act, "state")


@dataclass(frozen=True, eq=False)
class View:
    """One state as the ego reads it. Traced."""

    kitchen: Kitchen
    record: UInt8[Array, " S"]
    memory: Memory

    @cached_property
    def state(self) -> State:
        return unpack(self.kitchen.layout, self.record)

    @cached_property
    def before(self) -> State:
        return unpack(self.kitchen.layout, self.memory.record)

    @cached_property
    def me(self) -> Int[Array, ""]:
        return self.state.positions[EGO].astype(jnp.int32)

    @cached_property
    def partner(self) -> Int[Array, ""]:
        return self.state.positions[TEAMMATE].astype(jnp.int32)

    @cached_property
    def calm(self) -> Int[Array, ""]:
        same = jnp.all(self.state.pot_items == self.before.pot_items) & (self.state.recipe == self.before.recipe)
        return jnp.where(same, self.memory.calm + 1, 0)

    # The teammate's habits.

    @cached_property
    def mate_hand(self) -> UInt8[Array, ""]:
        return self.state.hands[TEAMMATE]

    @cached_property
    def plater(self) -> Bool[Array, ""]:
        return self.memory.plates | ((self.mate_hand & PLATE) > 0)

    @cached_property
    def held(self) -> Int[Array, ""]:
        return jnp.where((self.mate_hand & COOKED) > 0, self.memory.held + 1, 0)

    @cached_property
    def trusted(self) -> Bool[Array, ""]:
        had, empty = (self.before.hands[TEAMMATE] & COOKED) > 0, self.mate_hand == 0
        delivered = had & empty & (self.state.delivered > 0) & (self.before.hands[EGO] == self.state.hands[EGO])
        parked = had & empty & jnp.any((self.state.counters > 0) & (self.before.counters == 0))
        return (self.memory.trust & ~parked & (self.held < 2 * PATIENCE)) | delivered

    @cached_property
    def risky(self) -> Bool[Array, ""]:
        """Whether the teammate is likely to deliver any soup, also a wrong one."""
        return self.plater & self.trusted & self.kitchen.mate_serves

    @cached_property
    def about_to_deliver(self) -> Bool[Array, ""]:
        return self.trusted & (self.mate_hand == self.dish)

    # Ways.

    @cached_property
    def _origin(self) -> tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
        obstacle = jnp.argmax(jnp.asarray(self.kitchen.obstacles) == self.partner)
        return obstacle, self.me, self.state.facings[EGO].astype(jnp.int32)

    @cached_property
    def time(self) -> Int[Array, " cells"]:
        """Steps until the ego faces a cell, around the teammate."""
        return jnp.asarray(self.kitchen.time)[self._origin]

    def way(self, target: Int[Array, ""]) -> Int[Array, ""]:
        return jnp.asarray(self.kitchen.action)[self._origin][target]

    def cost(self, mask: Bool[Array, " cells"] | np.ndarray, then: Array | int = 0) -> Int[Array, " cells"]:
        """Steps to a cell of the mask and from there on."""
        return jnp.where(mask & self.kitchen.mine, self.time + then, 2 * FAR)

    # Hands, counters and what lies there.

    @cached_property
    def hand(self) -> UInt8[Array, ""]:
        return self.state.hands[EGO]

    @cached_property
    def items(self) -> UInt8[Array, " cells"]:
        """What lies on each counter."""
        layout = self.kitchen.layout
        return jnp.zeros(layout.cells, jnp.uint8).at[np.array(layout.counters, int)].set(self.state.counters)

    @cached_property
    def dish(self) -> UInt8[Array, ""]:
        return self.state.recipe | np.uint8(PLATE | COOKED)

    @cached_property
    def plates(self) -> Bool[Array, " cells"]:
        return jnp.asarray(self.kitchen.layout.kinds == PLATES) | (self.items == PLATE)

    def counts(self, item: UInt8[Array, "*B"]) -> Int[Array, "*B types"]:
        shift = 2 + 2 * jnp.arange(len(self.kitchen.layout.ingredients), dtype=jnp.uint8)
        return (item[..., None] >> shift & 3).astype(jnp.int32)

    def loose(self, item: UInt8[Array, ""]) -> Int[Array, " types"]:
        """counts of an ingredient in hand; zeros for everything else."""
        return self.counts(item) * ((item & (PLATE | COOKED)) == 0)

    @cached_property
    def sources(self) -> Bool[Array, "types cells"]:
        """Where each ingredient can be taken."""
        types = range(len(self.kitchen.layout.ingredients))
        return jnp.asarray(self.kitchen.pile_masks) | (self.items == jnp.array([4 << 2 * k for k in types])[:, None])

    @cached_property
    def parking(self) -> Int[Array, " cells"]:
        """Costs of putting something down; a counter that the teammate reaches costs more."""
        free = (self.kitchen.layout.kinds == WALL) & (self.items == 0)
        return self.cost(free, 3 * self.kitchen.theirs)

    # Pots.

    @cached_property
    def contents(self) -> UInt8[Array, " P"]:
        return self.state.pot_items[self.kitchen.pots] & np.uint8(0xFF - COOKED)

    @cached_property
    def timers(self) -> Int[Array, " P"]:
        return self.state.pot_timers[self.kitchen.pots].astype(jnp.int32)

    @cached_property
    def full(self) -> Bool[Array, " P"]:
        return ingredient_count(self.contents) == 3

    @cached_property
    def right(self) -> Bool[Array, " P"]:
        """Pots with the soup that the recipe asks for, done or not."""
        return self.full & (self.contents == self.state.recipe)

    @cached_property
    def mate_takes(self) -> Bool[Array, " P"]:
        """The pot that the teammate will serve."""
        first = jnp.argmin(jnp.where(self.right, self.timers, FAR)) == jnp.arange(len(self.timers))
        leaves = ((self.mate_hand & COOKED) > 0) | ((self.hand == PLATE) & (self.mate_hand != PLATE))
        slow = (self.calm >= PATIENCE) & (self.timers == 0)
        return self.right & first & self.risky & ~leaves & ~slow

    @cached_property
    def recipes(self) -> UInt8[Array, " Q"]:
        return jnp.concatenate([self.state.recipe[None], jnp.asarray(self.kitchen.layout.recipe_items)])

    @cached_property
    def stock(self) -> Int[Array, " Q"]:
        """Soups of each recipe that the ego could deliver without more cooking."""
        cooked = self.full[:, None] & (self.contents[:, None] == self.recipes)
        dishes = self.recipes | np.uint8(PLATE | COOKED)
        lying = (self.items[:, None] == dishes) & self.kitchen.mine[:, None]
        return cooked.sum(axis=0) + lying.sum(axis=0) + (self.hand == dishes) + (self.trusted & (self.mate_hand == dishes))

    @cached_property
    def lacking(self) -> Int[Array, "P Q types"]:
        """What each pot lacks of each recipe; negative where it has too much."""
        return self.counts(self.recipes) - self.counts(self.contents)[:, None]

    @cached_property
    def plans(self) -> Int[Array, "P Q"]:
        """How bad it is to cook a recipe in a pot: first what is least in stock, then the least work. FAR and more
        where it cannot or should not be done."""
        kitchen = self.kitchen
        work = jnp.sum(self.lacking * np.minimum(kitchen.trip, 60)[:, None], axis=-1)
        has_pile = (self.lacking <= 0) | (kitchen.pile_masks.any(axis=1))
        fits = ~self.full[:, None] & jnp.all((self.lacking >= 0) & has_pile, axis=-1)
        current = self.recipes == self.state.recipe
        ahead = self.stock - current
        short = ahead[0] < 0
        stuck = short & ~jnp.any(fits[:, 0])
        allowed = (current & (short | self.kitchen.apart[:, None])) | stuck | ~self.risky | (~short & self.kitchen.apart[:, None])

        return jnp.where(fits & allowed, 150 * (ahead + 1) + work, 10 * FAR)

    def at_pots(self, values: Array) -> Int[Array, " cells"]:
        """Values (P,) on the pots' cells, 2 FAR elsewhere."""
        return jnp.full(self.kitchen.layout.cells, 2 * FAR).at[self.kitchen.pot_cells].set(values)

    def plating(self, which: Bool[Array, " P"]) -> Int[Array, " cells"]:
        """Costs of taking a soup out of one of these pots with a plate in hand: when it is done or reached."""
        return self.at_pots(jnp.where(which, jnp.maximum(self.time[self.kitchen.pot_cells], self.timers), 2 * FAR))


def _decide(view: View) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The action, and the new count of steps blocked."""
    options = _with_dish(view)
    if len(view.kitchen.pots):
        options += _with_plate(view) + _with_ingredient(view) + _with_nothing(view)
    possible = jnp.stack([option.when & (jnp.min(option.cost) < 2 * FAR) for option in options])
    costs = jnp.stack([option.cost for option in options])[jnp.argmax(possible)]
    target = jnp.argmin(costs)
    action = view.way(target)
    waits = jnp.any((view.kitchen.pot_cells == target) & _not_yet(view))
    action = jnp.where(waits & (action == INTERACT), STAY, action)
    found = jnp.any(possible)
    reachable = found & (costs[target] < FAR)
    if not view.kitchen.shared_room:
        return jnp.where(reachable, action, STAY).astype(jnp.int32), jnp.int32(0)
    idle = ~reachable | (action == STAY) & (view.hand != PLATE)
    action = jnp.where(idle, _make_way(view, jnp.where(found, target, -1)), action)
    bumped = (view.memory.action < STAY) & (view.me == view.before.positions[EGO]) & (view.partner == view.before.positions[TEAMMATE])
    bumped &= jnp.asarray(view.kitchen.layout.moves)[view.me, view.memory.action] != view.me
    blocked = jnp.where(bumped, view.memory.blocked + 1, 0)
    return jnp.where(blocked % 2 == 1, STAY, action).astype(jnp.int32), blocked


def _make_way(view: View, target: Int[Array, ""]) -> Int[Array, ""]:
    """A step to where the ego hinders the teammate least, then off the stations, then near its own target."""
    kitchen = view.kitchen
    carries = jnp.where((view.mate_hand & COOKED) > 0, 0, jnp.where(view.mate_hand > 0, 1, 2))
    ends = jnp.asarray(kitchen.layout.moves[:, :5].astype(int))[view.me]  # up, down, left, right, stay
    taken = (ends == view.partner) | ((ends == view.me) & (jnp.arange(5) < STAY))
    hinders = jnp.asarray(kitchen.in_the_way)[carries, view.partner, ends]
    away = jnp.where(target < 0, 0, jnp.asarray(kitchen.time[0].min(axis=1))[ends, target])
    score = 8 * hinders + 4 * jnp.asarray(kitchen.stations)[ends] + away
    return jnp.argmin(jnp.where(taken, FAR, score - (jnp.arange(5) == STAY)))


def _not_yet(view: View) -> Bool[Array, " P"]:
    """Pots to wait at: cooking ones, and where a piece too early might spoil the soup."""
    mixed = view.contents + view.hand
    adds = (view.hand >> 2 > 0) & (view.hand & PLATE == 0)
    busy = jnp.any(view.right & (view.timers >= KNOB.get("busy", 9)))
    early = view.risky & ~busy & (ingredient_count(mixed) == 3) & ((mixed != view.state.recipe) | (view.stock[0] > 0))
    theirs = view.risky & (ingredient_count(mixed) == 3) & (view.mate_hand == view.hand) & (view.calm < PATIENCE)
    return (view.timers > 0) | (adds & ~view.full & (early | theirs | view.about_to_deliver))


def _with_dish(view: View) -> list[Option]:
    layout = view.kitchen.layout
    is_dish = (view.hand & COOKED) > 0
    lies = (view.items == view.dish) & bool(view.kitchen.of(GOAL, view.kitchen.mine).any())
    return [
        Option(is_dish & (view.hand == view.dish), view.cost(layout.kinds == GOAL)),
        Option(is_dish, view.parking),
        Option(view.hand == 0, view.cost(lies)),
        Option((view.hand > 0) & jnp.any(lies & view.kitchen.mine), view.parking),
    ]


def _with_plate(view: View) -> list[Option]:
    holds = view.hand == PLATE
    wrong = view.full & ~view.right
    building = jnp.min(view.plans) < 10 * FAR
    right = view.right & ~view.mate_takes
    soon = jnp.min(jnp.where(right, view.timers, FAR)) <= KNOB.get("ripe", 12)
    ripe = wrong & (view.timers == 0)
    return [
        Option(holds & soon, view.plating(right)),
        Option(holds & ~building, view.plating(ripe)),
        Option(holds & ~building, view.plating(right)),
        Option(holds & (_must_flush(view) | ~building), view.plating(wrong)),
        Option(holds, view.parking),
    ]


def _must_flush(view: View) -> Bool[Array, ""]:
    """Whether soups that nobody asks for have to leave their pots."""
    short = (view.stock[0] == 0) & (jnp.min(view.plans[:, 0]) >= 10 * FAR)
    return short | view.risky


def _with_ingredient(view: View) -> list[Option]:
    kind = view.loose(view.hand)
    holds = jnp.any(kind > 0)
    fitting = jnp.min(view.plans[:, 0]) < 10 * FAR
    takes = jnp.any((view.lacking > 0) & (kind > 0), axis=-1)
    # A recipe for later may have the pot only if another is left for the current one.
    current = view.recipes == view.state.recipe
    others = jnp.sum(view.plans[:, 0] < 10 * FAR) - (view.plans[:, 0] < 10 * FAR)
    spare = current | (view.stock[0] > 0) | (others[:, None] > 0)
    plans = jnp.where(takes & (spare | ~fitting), view.plans, 10 * FAR)
    best = jnp.min(plans, axis=1)
    cost = jnp.where(best < 10 * FAR, best + view.time[view.kitchen.pot_cells], 2 * FAR)
    return [
        Option(holds, view.at_pots(cost)),
        Option(holds & ~fitting & (view.stock[0] == 0), view.at_pots(_spoiled(view))),
        Option(holds, view.parking),
    ]


def _spoiled(view: View) -> Int[Array, " P"]:
    """Costs of the pots that are part full of what makes no soup."""
    spoiled = ~view.full & (view.contents > 0) & (jnp.min(view.plans, axis=1) >= 10 * FAR)
    return jnp.where(spoiled & view.kitchen.serves, view.time[view.kitchen.pot_cells], 2 * FAR)


def _with_nothing(view: View) -> list[Option]:
    kitchen = view.kitchen
    empty = view.hand == 0
    pot, recipe = jnp.unravel_index(jnp.argmin(view.plans), view.plans.shape)
    building = jnp.min(view.plans) < 10 * FAR
    lacking = view.lacking[pot, recipe]
    helped = lacking - view.loose(view.mate_hand) * (view.calm < PATIENCE)
    to_pot = jnp.asarray(kitchen.leg)[:, kitchen.pot_cells]  # (cells, P)
    ingredients = view.cost(jnp.any(view.sources & (helped > 0)[:, None], axis=0), to_pot[:, pot])

    arrival = jnp.min(jnp.where((view.plates & kitchen.mine)[:, None], view.time[:, None] + to_pot, 2 * FAR), axis=0)
    late = view.timers <= arrival + 2
    wrong = view.full & ~view.right
    right = view.right & kitchen.serves & ~view.mate_takes
    work = jnp.sum(jnp.maximum(lacking, 0) * jnp.asarray(kitchen.trip)[pot])
    nearly = building & (work <= KNOB.get("nearly", 6)) & ~view.risky
    ripe = wrong & (view.timers <= arrival) & ~view.risky & kitchen.serves & (jnp.min(jnp.where(right, view.timers, FAR)) > KNOB.get("ripe", 12))
    plate_for = lambda which: view.cost(view.plates, jnp.min(jnp.where(which, to_pot, FAR), axis=1))
    risky = wrong & view.risky & kitchen.serves
    spoiled = _spoiled(view) < 2 * FAR
    anything = view.cost(jnp.any(view.sources, axis=0))
    return [
        Option(empty & nearly, ingredients),
        Option(empty & jnp.any(right & late), plate_for(right)),
        Option(empty & jnp.any(risky & late), plate_for(risky)),
        Option(empty & building, ingredients),
        Option(empty & jnp.any(ripe), plate_for(ripe)),
        Option(empty & jnp.any(right), plate_for(right)),
        Option(empty & _must_flush(view) & jnp.any(wrong) & kitchen.serves, plate_for(wrong)),
        Option(empty & (view.stock[0] == 0) & jnp.any(spoiled), anything),
    ]
