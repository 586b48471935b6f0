"""Scripted ego that sees the complete state. Its returns show how much more an ego can earn than one that never moves.

The oracle is agent 0 and deterministic. It fills one pot at a time with the ingredients that the recipe still needs,
fetches a plate in time for the soup, and delivers only soups of the current recipe; other soups wait on a counter.
With a second pot the oracle cooks ahead. It watches the teammate: it leaves the work to a teammate that cooks and
delivers, but acts before a teammate that does only half of this. It hands over no items, because no layout rewards
this, never presses a button, and does not move on layouts where it cannot contribute.

Shapes: `P` pots, `Q` recipes that the ego may cook (the current recipe, then the layout's), `S` bytes of a state
record. All times are in steps. Arrays of pots contain pots that the ego cannot reach, but no mask selects these pots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, UInt8

from icrl4aht_data.overcooked.actions import EGO, INTERACT, STAY, TEAMMATE
from icrl4aht_data.overcooked.cells import COOKED, FACING_OF, NOWHERE, PLATE, POT, WALL
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import ingredient_count, record_size, unpack
from icrl4aht_generation.experts.layout_facts import FAR, NEVER, LayoutFacts, stack_facts
from icrl4aht_generation.paths import Scene
from icrl4aht_generation.policy import Policy, Situation, on_layout

WAIT_LIMIT = 10
"""Steps without a change in the pots after which the ego stops waiting for the teammate."""

DISH = np.uint8(PLATE | COOKED)
"""Bits that all dishes on a plate have."""


class OracleMemory(NamedTuple):
    """Memory of the oracle, which lasts from one episode to the next.

    Attributes:
        record: uint8 (S,), state record before the previous step.
        action: int32 (), the ego's action in the previous step.
        calm: int32 (), steps since the pots or the recipe changed.
        still: int32 (), steps since the teammate moved.
        bumps: int32 (), consecutive steps in which the ego failed to move.
        plates: bool (), whether the teammate has held a plate.
        cooks: bool (), whether the teammate has filled a pot.
        parks: bool (), whether the teammate has put a dish onto a counter.
    """

    record: UInt8[Array, " S"]
    action: Int[Array, ""]
    calm: Int[Array, ""]
    still: Int[Array, ""]
    bumps: Int[Array, ""]
    plates: Bool[Array, ""]
    cooks: Bool[Array, ""]
    parks: Bool[Array, ""]


def oracle(layout: Layout | Sequence[Layout]) -> Policy:
    """Return the oracle, a scripted ego.

    Args:
        layout: one layout or several layouts. With one layout, the policy sees state records; with several, it sees a
            `Situation`, which has the number of the layout.
    """
    if isinstance(layout, Layout):
        return on_layout(SITUATION_ORACLE._replace(params=oracle_params([layout])), layout)
    return SITUATION_ORACLE._replace(params=oracle_params(layout))


def oracle_params(layouts: Sequence[Layout]) -> Any:
    """Return the parameters of `SITUATION_ORACLE`: stacked `LayoutFacts` of the layouts, and an empty state record."""
    return stack_facts(layouts), np.zeros(record_size(*layouts), np.uint8)


def _initial_memory(params: Any, key: Key[Array, ""]) -> OracleMemory:
    zero, no = jnp.int32(0), jnp.asarray(False)
    return OracleMemory(jnp.asarray(params[1]), zero + STAY, zero, zero, zero, no, no, no)


def _act(params: Any, memory: OracleMemory, view: Situation, key: Key[Array, ""]):
    # The `LayoutFacts` of all layouts are stacked, so one compiled function plays any layout.
    facts = LayoutFacts(*(jnp.asarray(leaf)[view.layout] for leaf in params[0]))
    scene = Scene(view.tables, view.record, EGO)
    memory = _update_memory(scene, memory)
    action = jnp.where(facts.matters, _choose_action(_view_state(facts, scene, memory)), STAY).astype(jnp.int32)
    return action, memory._replace(action=action)


SITUATION_ORACLE = Policy((), _initial_memory, _act, "situation")
"""The oracle for any layouts; the `params` to set are `oracle_params` of the layouts."""


def _update_memory(scene: Scene, last: OracleMemory) -> OracleMemory:
    """Return the memory updated by a new state; `action` is still the previous action."""
    new, old = scene.state, unpack(scene.tables, last.record)
    same = jnp.all(new.pot_items == old.pot_items) & (new.recipe == old.recipe)
    ego_rests, mate_rests = new.positions[EGO] == old.positions[EGO], new.positions[TEAMMATE] == old.positions[TEAMMATE]
    bumped = ego_rests & mate_rests & (jnp.asarray(scene.tables.moves)[scene.own_cell, last.action] != scene.own_cell)
    # The counters and pots show whether the teammate put its item onto a counter, into a pot or into a goal.
    had = old.hands[TEAMMATE]
    put = (had >> 2 > 0) & (new.hands[TEAMMATE] == 0)
    onto_counter = jnp.any((new.counters > 0) & (old.counters == 0))
    into_pot = jnp.sum(ingredient_count(new.pot_items)) > jnp.sum(ingredient_count(old.pot_items))
    return OracleMemory(
        scene.record,
        last.action,
        jnp.where(same, last.calm + 1, 0),
        jnp.where(mate_rests, last.still + 1, 0),
        jnp.where(bumped, last.bumps + 1, 0),
        last.plates | (new.hands[TEAMMATE] & PLATE > 0),
        last.cooks | (put & into_pot & ~onto_counter),
        last.parks | (put & onto_counter & (had & PLATE > 0)),
    )


@dataclass(frozen=True, eq=False)
class OracleView:
    """Features of one state from the ego's point of view, as traced arrays; properties are computed at first use.

    Attributes:
        facts: precomputed properties of the layout.
        scene: the state from the ego's point of view.
        memory: memory of the ego.
        obstacle: int32 (), index into `LayoutFacts.ways` for the teammate's cell; 0 if the teammate blocks no path.
        time: int32 (cells,), steps until the ego faces each cell, on paths around the teammate.
        items: uint8 (cells,), items on counters.
        sources: bool (3, cells), where each ingredient can be taken.
        contents: uint8 (P,), contents of the pots, without the cooked flag.
        timers: int32 (P,), steps until a pot's soup is done.
        full: bool (P,), whether a pot has three ingredients.
        right: bool (P,), full pots with the current recipe, done or not.
        recipes: uint8 (Q,), item bytes of the recipes that the ego may cook.
        stock: int32 (Q,), soups of each recipe that need no more ingredients.
        missing: int32 (P, Q, 3), ingredients that each pot still needs for each recipe; negative for surplus.
        risky: bool (), whether the teammate is likely to take any soup out of the ego's pots, even a wrong soup.
        careful: bool (), `risky`, and the teammate also fills the ego's pots: a wrong soup would block the right one.
        mate_delivers: bool (), whether the teammate is about to deliver a right soup, which changes the recipe.
    """

    facts: LayoutFacts
    scene: Scene
    memory: OracleMemory
    obstacle: Int[Array, ""]
    time: Int[Array, " cells"]
    items: UInt8[Array, " cells"]
    sources: Bool[Array, "3 cells"]
    contents: UInt8[Array, " P"]
    timers: Int[Array, " P"]
    full: Bool[Array, " P"]
    right: Bool[Array, " P"]
    recipes: UInt8[Array, " Q"]
    stock: Int[Array, " Q"]
    missing: Int[Array, "P Q 3"]
    risky: Bool[Array, ""]
    careful: Bool[Array, ""]
    mate_delivers: Bool[Array, ""]

    @cached_property
    def dish(self) -> UInt8[Array, ""]:
        """Item byte of the current recipe's soup on a plate."""
        return self.recipes[0] | DISH

    def cost(self, mask: Bool[Array, " cells"] | np.ndarray, then: Array | int = 0) -> Int[Array, " cells"]:
        """Return the steps until the ego faces each reachable cell in `mask`, plus `then`; NEVER for other cells."""
        return jnp.where(mask & self.facts.mine, self.time + then, NEVER)

    @cached_property
    def pot_times(self) -> Int[Array, " P"]:
        """Steps until the ego faces each pot."""
        return self.time[jnp.minimum(jnp.asarray(self.scene.tables.pots), self.time.shape[0] - 1)]

    @cached_property
    def steps_to_pots(self) -> Int[Array, "cells P"]:
        """Number of steps from facing each cell to facing each pot."""
        return _decode_steps(jnp.asarray(self.facts.leg))

    def cost_at_pots(self, which: Bool[Array, " P"], then: Array | int = 0) -> Int[Array, " cells"]:
        """Return the steps until the ego faces each reachable pot in `which`, plus `then`; NEVER for other cells."""
        there = jnp.where(which & self.facts.pots, self.pot_times + then, NEVER)
        return jnp.where(self.scene.cells_of_kind(POT), self.scene.values_on_cells(POT, there), NEVER)

    @cached_property
    def parking_cost(self) -> Int[Array, " cells"]:
        """Cost of putting down an item on each counter.

        If the ego can serve, counters that only the ego reaches cost less. Otherwise counters near pots cost less.
        """
        facts = self.facts
        near = 2 * jnp.min(self.steps_to_pots, axis=1, initial=FAR)
        return self.cost(self.scene.empty_counters, jnp.where(facts.serves, 3 * jnp.asarray(facts.shared), near))

    @cached_property
    def plate_cells(self) -> Bool[Array, " cells"]:
        """Cells where the ego can take a plate."""
        return (self.scene.plate_piles | (self.items == PLATE)) & self.facts.mine

    @cached_property
    def plan_costs(self) -> Int[Array, "P Q"]:
        """Cost of cooking each recipe in each pot; NEVER if the ego should not cook the recipe in this pot.

        The cost increases first with the number of soups of the recipe in stock, then with the remaining work.
        """
        trip = jnp.asarray(self.facts.trip)[:, None]
        enough = jnp.all((self.missing >= 0) & ((self.missing == 0) | (trip < FAR)), axis=-1)
        # A surplus ingredient makes a recipe impossible, because no ingredient can be taken out of a pot.
        possible = enough & (self.facts.pots & ~self.full)[:, None]
        current, short = self.recipes == self.recipes[0], self.stock[0] == 0
        # If the teammate cooks, the ego cooks only the current recipe until a soup of this recipe is in stock.
        # If the current recipe is impossible, the ego cooks any recipe.
        # With a soup in stock, the ego cooks ahead, but only in pots that the teammate does not use.
        wanted = jnp.where(short, current, jnp.asarray(self.facts.passed)[:, None]) | (short & ~jnp.any(possible[:, 0]))
        work = jnp.sum(self.missing * jnp.minimum(trip, FAR // 10), axis=-1)
        # A soup in stock adds more to the cost than any walk, because walks are shorter than 200 steps.
        return jnp.where(possible & (wanted | ~self.careful), 200 * (self.stock - current + 1) + work, NEVER)

    @cached_property
    def spoiled_pots(self) -> Bool[Array, " P"]:
        """Partly filled pots that the ego cannot complete to a soup that it should cook.

        No pot counts if the ego cannot serve, or while a soup of the current recipe is in stock.
        """
        nowhere = self.facts.pots & ~self.full & (self.contents > 0) & (jnp.min(self.plan_costs, axis=1) == NEVER)
        return nowhere & (self.stock[0] == 0) & self.facts.serves

    @cached_property
    def must_clear(self) -> Bool[Array, ""]:
        """Whether the ego must take soups of other recipes out of pots."""
        return self.risky | ((self.stock[0] == 0) & (jnp.min(self.plan_costs[:, 0]) == NEVER))

    @cached_property
    def teammate_pots(self) -> Bool[Array, " P"]:
        """The pot that the ego leaves to the teammate, if any: the one whose soup of the current recipe is done first.

        The ego leaves no pot to a teammate that does not cook or is idle.
        """
        first = jnp.arange(len(self.timers)) == jnp.argmin(jnp.where(self.right, self.timers, NEVER))
        elsewhere = (self.scene.partner_hand & COOKED > 0) | (
            self.scene.holds_plate & (self.scene.partner_hand != PLATE)
        )
        # A teammate that lets a finished soup wait will not take it.
        idles = (self.memory.calm >= WAIT_LIMIT) & (self.timers == 0)
        return self.right & first & self.careful & ~self.memory.parks & ~elsewhere & ~idles

    @cached_property
    def waiting_pots(self) -> Bool[Array, " P"]:
        """Pots in front of which the ego waits instead of interacting."""
        hand, mixed = self.scene.hand, self.contents + self.scene.hand
        completes = self.careful & (ingredient_count(mixed) == 3)
        # Start another soup only while a soup of the current recipe still needs WAIT_LIMIT steps or more.
        ahead = (mixed != self.recipes[0]) | (self.stock[0] > 0)
        spoils = ahead & ~jnp.any(self.right & (self.timers >= WAIT_LIMIT))
        leaves_it = (self.scene.partner_hand == hand) & (self.memory.calm < WAIT_LIMIT)
        unknown = self.mate_delivers & (self.careful | (jnp.sum(self.facts.pots) == 1))
        adds = self.full | (completes & (spoils | leaves_it)) | unknown
        return (self.timers > 0) | (self.scene.holds_ingredient & adds)


def _view_state(facts: LayoutFacts, scene: Scene, memory: OracleMemory) -> OracleView:
    state, mine = scene.state, jnp.asarray(facts.mine)
    # Obstacle 0 means that the teammate does not block the ego.
    obstacle = jnp.asarray(facts.obstacle)[scene.partner_cell].astype(jnp.int32)
    faced = jnp.asarray(scene.tables.ahead)[scene.own_cell, state.facings[EGO].astype(jnp.int32)]
    items = scene.values_on_cells(WALL, state.counters)
    lying = items == jnp.array([[4], [16], [64]], jnp.uint8)
    contents = state.pot_items & np.uint8(0xFF - COOKED)
    full = facts.pots & (ingredient_count(contents) == 3)
    recipes = jnp.concatenate([state.recipe[None], jnp.asarray(facts.recipes)])
    cooked = (full[:, None] & (contents[:, None] == recipes)).sum(axis=0)
    plated = ((items[:, None] == recipes | DISH) & mine[:, None]).sum(axis=0) + (scene.hand == recipes | DISH)
    # Assume that a teammate which has never held a plate takes no soups.
    risky = memory.plates & facts.mate_serves
    return OracleView(
        facts,
        scene,
        memory,
        obstacle,
        time=jnp.where(scene.cells == faced, 0, _decode_steps(jnp.asarray(facts.ways)[obstacle, scene.own_cell])),
        items=items,
        sources=(jnp.asarray(facts.piles) | lying) & mine,
        contents=contents,
        timers=state.pot_timers.astype(jnp.int32),
        full=full,
        right=full & (contents == state.recipe),
        recipes=recipes,
        stock=cooked + plated + ((scene.partner_hand == recipes | DISH) & ~memory.parks),
        missing=scene.ingredient_counts(recipes) - scene.ingredient_counts(contents)[:, None],
        risky=risky,
        careful=risky & memory.cooks,
        mate_delivers=(scene.partner_hand == state.recipe | DISH) & ~memory.parks,
    )


def _decode_steps(stored: UInt8[Array, "*B"]) -> Int[Array, "*B"]:
    return jnp.where(stored < NOWHERE, stored.astype(jnp.int32), FAR)


def _first_move(view: OracleView, obstacle: Int[Array, ""] | int, target: Int[Array, ""]) -> Int[Array, ""]:
    """Return the first action of the shortest walk around an obstacle until the ego faces the target cell.

    The action is INTERACT if the ego already faces the target cell.
    """
    scene, ahead = view.scene, jnp.asarray(view.scene.tables.ahead)
    ends = jnp.asarray(scene.tables.moves)[scene.own_cell, :STAY].astype(jnp.int32)
    # The teammate is the obstacle: a move onto its cell only turns the ego.
    ends = jnp.where((ends == scene.partner_cell) & (obstacle > 0), scene.own_cell, ends)
    after = _decode_steps(jnp.asarray(view.facts.ways)[obstacle, ends, target])
    turn = jnp.argmin(jnp.where(ahead[ends, jnp.asarray(FACING_OF)] == target, 0, after))
    return jnp.where(ahead[scene.own_cell, scene.state.facings[EGO].astype(jnp.int32)] == target, INTERACT, turn)


class Subgoal(NamedTuple):
    """Row of the ego's decision table: a condition, and the costs of the cells at which the ego can interact.

    Attributes:
        when: bool (), whether the subgoal applies.
        cost: int32 (cells,), cost of going to each cell in steps; NEVER for unsuitable cells.
    """

    when: Bool[Array, ""]
    cost: Int[Array, " cells"]


def _choose_action(view: OracleView) -> Int[Array, ""]:
    """Return the action towards the first subgoal that applies and has a cell that can be reached."""
    facts = view.facts
    rows = _dish_subgoals(view) + _plate_subgoals(view) + _ingredient_subgoals(view) + _empty_hand_subgoals(view)
    possible = jnp.stack([row.when & (jnp.min(row.cost) < NEVER) for row in rows])
    target = jnp.argmin(jnp.stack([row.cost for row in rows])[jnp.argmax(possible)])
    action = _first_move(view, view.obstacle, target)
    at_pot = (jnp.asarray(view.scene.tables.pots) == target) & facts.pots
    # Interacting too early would spoil the pot or have no effect.
    waits = jnp.any(at_pot & view.waiting_pots) & (action == INTERACT)
    action = jnp.where(waits, STAY, action)
    alone = jnp.where(jnp.any(possible), action, STAY)
    return jnp.where(facts.shares_room, _act_in_shared_room(view, jnp.any(possible), target, action), alone)


def _dish_subgoals(view: OracleView) -> list[Subgoal]:
    scene, facts = view.scene, view.facts
    # A dish on a counter is worth a trip only if the ego can carry it to a goal.
    wanted = (view.items == view.dish) & facts.mine & jnp.any(scene.goals & facts.mine)
    near = view.cost(scene.empty_counters & facts.shared, scene.manhattan(scene.cells, scene.partner_cell) - view.time)
    comes = scene.holds_nothing & (scene.partner_hand == view.dish) & ~jnp.any(facts.pots)
    return [
        # Deliver the current recipe.
        Subgoal(scene.hand == view.dish, view.cost(scene.goals)),
        # Keep a dish of another recipe on a counter, because a wrong delivery costs 20.
        Subgoal(scene.holds_dish, view.parking_cost),
        # Take a dish of the current recipe from a counter, because its delivery earns most per step.
        Subgoal(scene.holds_nothing, view.cost(wanted)),
        # Put down another item to take a dish of the current recipe.
        Subgoal(jnp.any(wanted), view.parking_cost),
        # Wait where the teammate puts down a dish that only the ego can deliver.
        Subgoal(comes, near),
    ]


def _plate_subgoals(view: OracleView) -> list[Subgoal]:
    holds, building = view.scene.holds_plate, jnp.min(view.plan_costs) < NEVER
    right = view.right & ~view.teammate_pots
    soon = jnp.min(jnp.where(right, view.timers, NEVER)) <= WAIT_LIMIT
    # If a soup is not done when the ego arrives, the ego waits. A step of waiting costs as much as a step of walking.
    rest = jnp.maximum(view.timers - view.pot_times, 0)
    return [
        # Plate the soup of the current recipe.
        Subgoal(holds & (soon | ~building), view.cost_at_pots(right, rest)),
        # Take a soup of another recipe out of its pot.
        Subgoal(holds & (view.must_clear | ~building), view.cost_at_pots(view.full & ~view.right, rest)),
        # Put the plate down: no soup needs it, but a pot needs ingredients.
        Subgoal(holds, view.parking_cost),
    ]


def _ingredient_subgoals(view: OracleView) -> list[Subgoal]:
    holds, kind = view.scene.holds_ingredient, view.scene.ingredient_counts(view.scene.hand) > 0
    takes = jnp.any((view.missing > 0) & kind, axis=-1)
    # An ingredient for a later recipe goes into a pot only if another pot is left for the current recipe.
    fits = view.plan_costs[:, 0] < NEVER
    spare = (view.recipes == view.recipes[0]) | (view.stock[0] > 0) | (jnp.sum(fits) > fits)[:, None]
    plans = jnp.min(jnp.where(takes & (spare | ~jnp.any(fits)), view.plan_costs, NEVER), axis=1)
    return [
        # Put the ingredient into the pot with the lowest cost of walking and cooking.
        Subgoal(holds, view.cost_at_pots(plans < NEVER, plans)),
        # Fill up a pot with useless contents, because only a full pot can be emptied.
        Subgoal(holds & ~jnp.any(fits), view.cost_at_pots(view.spoiled_pots)),
        # Wait at the pot, because only the teammate serves.
        Subgoal(holds & ~view.facts.serves, view.cost_at_pots(view.full | view.mate_delivers)),
        # Put down an ingredient that no recipe needs.
        Subgoal(holds, view.parking_cost),
    ]


def _empty_hand_subgoals(view: OracleView) -> list[Subgoal]:
    facts, scene, plans = view.facts, view.scene, view.plan_costs
    empty = scene.holds_nothing
    to_pot = view.steps_to_pots

    def fetch_cost(ingredients: Bool[Array, " types"], then: Array) -> Int[Array, " cells"]:
        return view.cost(jnp.any(view.sources & ingredients[:, None], axis=0), then)

    def plate_subgoal(which: Bool[Array, " P"]) -> Subgoal:
        then = jnp.min(jnp.where(which, to_pot, FAR), axis=1)
        return Subgoal(empty & jnp.any(which), view.cost(view.plate_cells, then))

    pot, recipe = jnp.unravel_index(jnp.argmin(plans), plans.shape)
    builds = empty & (jnp.min(plans) < NEVER)
    missing = view.missing[pot, recipe]
    # Count the teammate's ingredient as already in the pot, unless the pots have not changed for WAIT_LIMIT steps.
    delivering = (scene.partner_hand & PLATE == 0) & (view.memory.calm < WAIT_LIMIT)
    coming = scene.ingredient_counts(scene.partner_hand) * delivering
    ingredients = fetch_cost(missing > coming, to_pot[:, pot])
    quick = jnp.sum(missing * jnp.asarray(facts.trip)[pot]) <= WAIT_LIMIT - 4

    # The earliest step in which the ego can face each pot after it has fetched a plate.
    arrival = jnp.min(jnp.where(view.plate_cells[:, None], view.time[:, None] + to_pot, NEVER), axis=0)
    due = view.timers <= arrival + 2
    right = view.right & ~view.teammate_pots & facts.serves
    wrong = view.full & ~view.right & view.must_clear & facts.serves
    any_ingredient = fetch_cost(
        jnp.any(scene.ingredient_counts(view.recipes) > 0, axis=0), to_pot[:, jnp.argmax(facts.pots)]
    )
    return [
        # Before fetching a plate, fill up a pot that needs few steps.
        Subgoal(builds & quick & ~view.risky, ingredients),
        # Fetch a plate in time for a soup of the current recipe.
        plate_subgoal(right & due),
        # Take a soup of another recipe before the teammate serves it.
        plate_subgoal(wrong & due & view.risky),
        # Fetch an ingredient to cook.
        Subgoal(builds, ingredients),
        # Wait with a plate, because nothing can be cooked.
        plate_subgoal(right),
        # Empty a pot that blocks the current recipe.
        plate_subgoal(wrong),
        # Fill up a pot with useless contents, to empty it later.
        Subgoal(empty & jnp.any(view.spoiled_pots), any_ingredient),
        # An ego that only fills pots holds an ingredient ready for the next soup.
        Subgoal(empty & (jnp.any(view.full) | view.mate_delivers) & ~facts.serves, any_ingredient),
    ]


def _act_in_shared_room(view: OracleView, found: Bool[Array, ""], target: Int[Array, ""], action: Int[Array, ""]):
    """Return the action in a shared room, where the ego makes way for the teammate and resolves mutual blocking."""
    scene, facts, still = view.scene, view.facts, view.memory.still
    tables = scene.tables
    ahead = jnp.asarray(tables.ahead)[scene.partner_cell, scene.state.facings[TEAMMATE].astype(jnp.int32)]
    pushed = (ahead == scene.own_cell) & (still > 0)
    reachable = found & (view.time[target] < FAR)
    # A teammate that blocks the way may leave in this step; if it stays, it may be waiting for the ego.
    follows = found & ~reachable & ~pushed & (still < 3)
    through = _first_move(view, 0, target)

    # What the teammate carries shows where it may be going; see `LayoutFacts.hindrance`.
    carries = jnp.where(scene.partner_hand & COOKED > 0, 0, jnp.where(scene.partner_hand > 0, 1, 2))
    ends = jnp.asarray(tables.moves)[scene.own_cell, : STAY + 1].astype(jnp.int32)
    stays = jnp.arange(STAY + 1) == STAY
    taken = (ends == scene.partner_cell) | ((ends == scene.own_cell) & ~stays) | (stays & pushed)
    faces = jnp.any(jnp.asarray(tables.ahead)[ends] == target, axis=1)
    away = jnp.where(found & ~faces, _decode_steps(jnp.asarray(facts.ways)[0, ends, target]), 0)
    hindrance = jnp.asarray(facts.hindrance)[carries, scene.partner_cell, ends].astype(jnp.int32)
    aside = jnp.argmin(jnp.where(taken, NEVER, hindrance + away - stays))

    # With a plate the ego waits in front of the pot; otherwise it steps aside instead of staying.
    proceeds = reachable & ((action != STAY) | scene.holds_plate)
    action = jnp.where(proceeds, action, jnp.where(follows, through, aside))
    # Two agents that move to the same cell block each other forever, so the ego stays after a failed move.
    return jnp.where(view.memory.bumps % 2 == 1, STAY, action)
