"""A scripted ego that sees the whole state: how much an ego can matter, beside `stay` and `random`.

It plays seat 0. It fills one pot at a time with what the recipe lacks, fetches the plate so that it arrives when the
soup is done, and delivers only what the recipe asks for; any other soup goes onto a counter until it is asked for.
With a second pot it cooks ahead. What to expect of the teammate it learns by watching: one that cooks and delivers is
left to its work, one that does only half of that is forestalled. It hands nothing over, which no layout rewards, never
presses a button, and stays where it cannot matter. No chance is involved.

P are the pots that the ego reaches, Q the recipes that it may cook: the current one, then the layout's. All times are
in steps.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, UInt8

from generation.policy import Policy
from generation.teammates.heuristics.paths import Paths, Scene
from icrl4aht_data.overcooked.actions import EGO, INTERACT, STAY, TEAMMATE
from icrl4aht_data.overcooked.layouts import COOKED, FACING_OF, GOAL, PILE, PLATE, PLATES, POT, WALL, Layout
from icrl4aht_data.overcooked.state import ingredient_count, record_size, unpack

FAR = 1000
"""The time to what cannot be reached, or only when the teammate steps aside."""

NEVER = 10_000
"""The cost of what cannot or should not be done."""

PATIENCE = 10
"""Steps without a change in the pots after which the ego stops waiting for the teammate."""

_DISH = np.uint8(PLATE | COOKED)


class Kitchen(NamedTuple):
    """What the ego knows of a layout before it starts. NumPy."""

    paths: Paths
    mine: np.ndarray  # bool (cells,), what the ego can face
    shared: np.ndarray  # bool (cells,), what both can face
    serves: bool  # the ego can plate and deliver
    mate_serves: bool  # the teammate can plate and deliver the ego's soups
    pots: np.ndarray  # int (P,), numbers of the pots
    pot_cells: np.ndarray  # int (P,)
    piles: np.ndarray  # bool (types, cells), the piles of each ingredient that the ego can face
    passed: np.ndarray  # bool (P,), pots that the teammate, coming from its piles, leaves for a nearer one
    obstacles: np.ndarray  # int (O,), where a teammate can be in the way; first -1, nowhere, alone if rooms are apart
    time: np.ndarray  # int32 (O, cells, 4, cells), until the ego, on a cell and with a facing, faces a cell
    action: np.ndarray  # int32 (O, cells, 4, cells), the first on that way; INTERACT if it faces the cell already
    leg: np.ndarray  # int32 (cells, cells), time from facing one cell to facing another, in an empty room
    trip: np.ndarray  # int32 (P, types), time to bring a piece from its pile to a pot and to come back


def _study(layout: Layout) -> Kitchen:
    paths, kinds = Paths(layout), layout.kinds
    mine, theirs = (np.isin(np.arange(layout.cells), layout.ahead[room]) for room in layout.rooms)
    shared = mine & theirs
    pots = np.array([k for k, cell in enumerate(layout.pots) if mine[cell]], int)
    pot_cells = np.array(layout.pots, int)[pots]
    serves, mate_serves = (all((here & (kinds == k)).any() for k in (PLATES, GOAL)) for here in (mine, theirs))
    serves, mate_serves = serves and len(pots) > 0, mate_serves and bool(theirs[pot_cells].any())
    piles = (layout.piles == np.array([layout.ingredient_item(i) for i in layout.ingredients])[:, None]) & mine
    starts = paths.access[(kinds == PILE) & theirs].ravel()
    their_way = paths.target_distance[starts[starts >= 0]][:, pot_cells].sum(axis=0)
    passed = their_way > their_way.min(initial=NEVER)

    obstacles = np.array([-1, *(layout.rooms[EGO] if np.array_equal(*layout.rooms) else [])], int)
    time, action = _ways(layout, obstacles)
    leg = np.full((layout.cells, layout.cells), FAR, np.int32)
    np.minimum.at(leg, layout.ahead[layout.rooms[EGO]], time[0, layout.rooms[EGO]])
    trip = np.where(piles[:, :, None], leg + leg.T + 2, FAR).min(axis=1).T[pot_cells]
    return Kitchen(
        paths, mine, shared, serves, mate_serves, pots, pot_cells, piles, passed, obstacles, time, action, leg, trip
    )


def _ways(layout: Layout, obstacles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`Kitchen.time` and `Kitchen.action`."""
    count, cells, room = len(obstacles), layout.cells, layout.rooms[EGO]
    time = np.full((count, cells, 4, cells), FAR, np.int32)
    for facing in range(4):
        time[:, room, facing, layout.ahead[room, facing]] = 0
    ends = np.repeat(layout.moves[None, :, :4].astype(int), count, axis=0)  # (O, cells, actions)
    ends = np.where(ends == obstacles[:, None, None], np.arange(cells)[:, None], ends)
    while True:
        after = time[np.arange(count)[:, None, None], ends, FACING_OF]  # (O, cells, actions, cells)
        shorter = np.minimum(time, after.min(axis=2, keepdims=True) + 1)
        if np.array_equal(shorter, time):
            return time, np.where(time == 0, INTERACT, after.argmin(axis=2)[:, :, None]).astype(np.int32)
        time = shorter


def _hindrance(paths: Paths) -> np.ndarray:
    """int32 (3, cells, cells): how little the ego should wait on a cell when the teammate is on another one and carries
    a dish, a plate or an ingredient, or nothing: 16 for the next cell of each way that the teammate may be going, 8
    beside it, 4 where something other than a counter is used."""
    layout = paths.layout
    used = np.isin(layout.kinds, [GOAL, POT, PILE, PLATES])[layout.ahead].any(axis=1) & layout.walkable
    table = np.tile(4 * used, (3, layout.cells, 1)).astype(np.int32)
    for carries, kinds in enumerate([[GOAL], [POT], [PILE, PLATES]]):
        ends = {int(cell) for cell in paths.access[np.isin(layout.kinds, kinds)].ravel() if cell >= 0}
        for mate in layout.rooms[TEAMMATE]:
            for end in ends - {int(mate)}:
                ahead = layout.moves[mate, paths.first_step[mate, end]]
                table[carries, mate] += 8 * np.maximum(2 - paths.distance[ahead], 0)
    return table


class Memory(NamedTuple):
    """What the ego remembers; it outlives episodes."""

    record: UInt8[Array, " S"]  # of the last step
    action: Int[Array, ""]  # of the last step
    calm: Int[Array, ""]  # steps since the pots or the recipe changed
    still: Int[Array, ""]  # steps since the teammate moved
    bumps: Int[Array, ""]  # steps in a row that the ego failed to move
    plates: Bool[Array, ""]  # the teammate has held a plate
    cooks: Bool[Array, ""]  # the teammate has filled a pot
    parks: Bool[Array, ""]  # the teammate has put a dish onto a counter


def oracle(layout: Layout) -> Policy:
    """The scripted ego of a layout, without parameters; `act` takes the state record uint8 (S,)."""
    kitchen = _study(layout)
    matters = kitchen.serves or bool(np.isin(layout.kinds[kitchen.shared], [POT, WALL]).any())

    def init(params, key: Key[Array, ""]) -> Memory:
        zero, no = jnp.int32(0), jnp.asarray(False)
        return Memory(jnp.zeros(record_size(layout), jnp.uint8), zero + STAY, zero, zero, zero, no, no, no)

    def act(params, memory: Memory, record: UInt8[Array, " S"], key: Key[Array, ""]):
        if not matters:
            return jnp.int32(STAY), memory
        scene = Scene(kitchen.paths, record, EGO)
        memory = _remember(scene, memory)
        action = _decide(_look(kitchen, scene, memory)).astype(jnp.int32)
        return action, memory._replace(action=action)

    return Policy((), init, act, "state")


def _remember(scene: Scene, last: Memory) -> Memory:
    """The memory after this state, but for the action."""
    layout, new = scene.paths.layout, scene.state
    old = unpack(layout, last.record)
    same = jnp.all(new.pot_items == old.pot_items) & (new.recipe == old.recipe)
    ego_rests, mate_rests = new.positions[EGO] == old.positions[EGO], new.positions[TEAMMATE] == old.positions[TEAMMATE]
    bumped = ego_rests & mate_rests & (jnp.asarray(layout.moves)[scene.me, last.action] != scene.me)
    had = old.hands[TEAMMATE]
    put = (had >> 2 > 0) & (new.hands[TEAMMATE] == 0)
    onto_counter = jnp.any((new.counters > 0) & (old.counters == 0))
    into_pot = jnp.sum(ingredient_count(new.pot_items)) > jnp.sum(ingredient_count(old.pot_items))
    return Memory(
        scene.record,
        last.action,
        jnp.where(same, last.calm + 1, 0),
        jnp.where(mate_rests, last.still + 1, 0),
        jnp.where(bumped, last.bumps + 1, 0),
        last.plates | (new.hands[TEAMMATE] & PLATE > 0),
        last.cooks | (put & into_pot & ~onto_counter),
        last.parks | (put & onto_counter & (had & PLATE > 0)),
    )


class View(NamedTuple):
    """One state as the ego reads it. Traced."""

    kitchen: Kitchen
    scene: Scene
    memory: Memory
    origin: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]  # the obstacle, the ego's cell and facing
    time: Int[Array, " cells"]  # until the ego faces a cell, around the teammate
    items: UInt8[Array, " cells"]  # what lies on each counter
    sources: Bool[Array, "types cells"]  # where each ingredient can be taken
    contents: UInt8[Array, " P"]  # of the pots, without the cooked flag
    timers: Int[Array, " P"]
    full: Bool[Array, " P"]
    right: Bool[Array, " P"]  # pots with the soup that the recipe asks for, done or not
    recipes: UInt8[Array, " Q"]
    stock: Int[Array, " Q"]  # soups of each recipe that need no more ingredients
    lacking: Int[Array, "P Q types"]  # what each pot lacks of each recipe; negative where it has too much
    risky: Bool[Array, ""]  # the teammate is likely to take any soup out of the ego's pots, also a wrong one
    careful: Bool[Array, ""]  # it also fills them, and a wrong soup keeps it from cooking the right one
    mate_delivers: Bool[Array, ""]  # the teammate is about to change the recipe

    @property
    def dish(self) -> UInt8[Array, ""]:
        """The one that the recipe asks for."""
        return self.recipes[0] | _DISH

    def cost(self, mask: Bool[Array, " cells"] | np.ndarray, then: Array | int = 0) -> Int[Array, " cells"]:
        """Time to the cells of a mask and from there on; NEVER elsewhere."""
        return jnp.where(mask & self.kitchen.mine, self.time + then, NEVER)

    def at_pots(self, which: Bool[Array, " P"], then: Array | int = 0) -> Int[Array, " cells"]:
        """Time to some of the pots and from there on; NEVER elsewhere."""
        cells = self.kitchen.pot_cells
        there = jnp.where(which, self.time[cells] + then, NEVER)
        return jnp.full(self.time.shape, NEVER).at[cells].set(there)

    @property
    def parking(self) -> Int[Array, " cells"]:
        """Costs of putting something down: out of the teammate's reach, or near a pot if the ego only fills pots."""
        kitchen = self.kitchen
        near = 2 * kitchen.leg[:, kitchen.pot_cells].min(axis=1, initial=FAR)
        return self.cost(self.scene.empty_counters, jnp.asarray(3 * kitchen.shared if kitchen.serves else near))

    @property
    def plates(self) -> Bool[Array, " cells"]:
        return (self.scene.plate_piles | (self.items == PLATE)) & self.kitchen.mine

    @property
    def plans(self) -> Int[Array, "P Q"]:
        """Costs of cooking a recipe in a pot: first what is least in stock, then the least work."""
        trip = self.kitchen.trip[:, None]
        enough = jnp.all((self.lacking >= 0) & ((self.lacking == 0) | (trip < FAR)), axis=-1)
        possible = enough & ~self.full[:, None]
        current, short = self.recipes == self.recipes[0], self.stock[0] == 0
        # Beside a cooking teammate: nothing ahead in a pot that it uses, unless nothing else is left.
        wanted = jnp.where(short, current, self.kitchen.passed[:, None]) | (short & ~jnp.any(possible[:, 0]))
        work = jnp.sum(self.lacking * np.minimum(trip, FAR // 10), axis=-1)
        return jnp.where(possible & (wanted | ~self.careful), 200 * (self.stock - current + 1) + work, NEVER)

    @property
    def spoiled(self) -> Bool[Array, " P"]:
        """Pots with a beginning that leads nowhere, to be filled up with anything and cleared if nothing else helps."""
        nowhere = ~self.full & (self.contents > 0) & (jnp.min(self.plans, axis=1) == NEVER)
        return nowhere & (self.stock[0] == 0) & self.kitchen.serves

    @property
    def clears(self) -> Bool[Array, ""]:
        """Whether a soup that nobody asks for has to leave its pot."""
        return self.risky | ((self.stock[0] == 0) & (jnp.min(self.plans[:, 0]) == NEVER))

    @property
    def mate_takes(self) -> Bool[Array, " P"]:
        """The soup that is the teammate's to serve: the first right one, if it cooks, too, and does not dawdle."""
        first = jnp.arange(len(self.timers)) == jnp.argmin(jnp.where(self.right, self.timers, NEVER))
        elsewhere = (self.scene.partner_hand & COOKED > 0) | (
            self.scene.holds_plate & (self.scene.partner_hand != PLATE)
        )
        dawdles = (self.memory.calm >= PATIENCE) & (self.timers == 0)
        return self.right & first & self.careful & ~self.memory.parks & ~elsewhere & ~dawdles

    @property
    def too_early(self) -> Bool[Array, " P"]:
        """Pots to wait at."""
        hand, mixed = self.scene.hand, self.contents + self.scene.hand
        completes = self.careful & (ingredient_count(mixed) == 3)
        # A wrong soup, or a second one, may be done only soon after one that the teammate waits for.
        ahead = (mixed != self.recipes[0]) | (self.stock[0] > 0)
        spoils = ahead & ~jnp.any(self.right & (self.timers >= PATIENCE))
        leaves_it = (self.scene.partner_hand == hand) & (self.memory.calm < PATIENCE)
        unknown = self.mate_delivers & (self.careful | (len(self.timers) == 1))
        adds = self.full | (completes & (spoils | leaves_it)) | unknown
        return (self.timers > 0) | (self.scene.holds_ingredient & adds)


def _look(kitchen: Kitchen, scene: Scene, memory: Memory) -> View:
    state, layout = scene.state, scene.paths.layout
    obstacle = jnp.argmax(jnp.asarray(kitchen.obstacles) == scene.partner)
    origin = (obstacle, scene.me, state.facings[EGO].astype(jnp.int32))
    items = jnp.zeros(layout.cells, jnp.uint8).at[np.array(layout.counters, int)].set(state.counters)
    lying = items == (4 << 2 * np.arange(len(kitchen.piles)))[:, None]
    contents = state.pot_items[kitchen.pots] & np.uint8(0xFF - COOKED)
    full = ingredient_count(contents) == 3
    recipes = jnp.concatenate([state.recipe[None], jnp.asarray(layout.recipe_items)])
    cooked = (full[:, None] & (contents[:, None] == recipes)).sum(axis=0)
    plated = ((items[:, None] == recipes | _DISH) & kitchen.mine[:, None]).sum(axis=0) + (scene.hand == recipes | _DISH)
    risky = memory.plates & kitchen.mate_serves
    return View(
        kitchen,
        scene,
        memory,
        origin,
        time=jnp.asarray(kitchen.time)[origin],
        items=items,
        sources=(jnp.asarray(kitchen.piles) | lying) & kitchen.mine,
        contents=contents,
        timers=state.pot_timers[kitchen.pots].astype(jnp.int32),
        full=full,
        right=full & (contents == state.recipe),
        recipes=recipes,
        stock=cooked + plated + ((scene.partner_hand == recipes | _DISH) & ~memory.parks),
        lacking=scene.counts(recipes) - scene.counts(contents)[:, None],
        risky=risky,
        careful=risky & memory.cooks,
        mate_delivers=(scene.partner_hand == state.recipe | _DISH) & ~memory.parks,
    )


class Option(NamedTuple):
    """Something to do: go to the cheapest cell and interact."""

    when: Bool[Array, ""]
    cost: Int[Array, " cells"]


def _decide(view: View) -> Int[Array, ""]:
    """The action: the first option that holds and is possible."""
    kitchen, options = view.kitchen, _with_dish(view)
    if len(kitchen.pots):
        options += _with_plate(view) + _with_ingredient(view) + _with_nothing(view)
    possible = jnp.stack([option.when & (jnp.min(option.cost) < NEVER) for option in options])
    target = jnp.argmin(jnp.stack([option.cost for option in options])[jnp.argmax(possible)])
    action = jnp.asarray(kitchen.action)[view.origin][target]
    waits = jnp.any((kitchen.pot_cells == target) & view.too_early) & (action == INTERACT)
    action = jnp.where(waits, STAY, action)
    if len(kitchen.obstacles) > 1:
        return _beside_teammate(view, jnp.any(possible), target, action)
    return jnp.where(jnp.any(possible), action, STAY)


def _with_dish(view: View) -> list[Option]:
    scene, kitchen = view.scene, view.kitchen
    wanted = (view.items == view.dish) & kitchen.mine & bool((scene.paths.static(GOAL) & kitchen.mine).any())
    options = [
        Option(scene.hand == view.dish, view.cost(scene.goals)),
        Option(scene.holds_dish, view.parking),
        Option(scene.holds_nothing, view.cost(wanted)),
        Option(jnp.any(wanted), view.parking),
    ]
    if not len(kitchen.pots):  # wait where the teammate may put down what only the ego will deliver
        near = view.cost(
            scene.empty_counters & kitchen.shared, jnp.asarray(scene.paths.manhattan)[scene.partner] - view.time
        )
        options.append(Option(scene.holds_nothing & (scene.partner_hand == view.dish), near))
    return options


def _with_plate(view: View) -> list[Option]:
    holds, building = view.scene.holds_plate, jnp.min(view.plans) < NEVER
    right = view.right & ~view.mate_takes
    soon = jnp.min(jnp.where(right, view.timers, NEVER)) <= PATIENCE
    rest = jnp.maximum(view.timers - view.time[view.kitchen.pot_cells], 0)
    return [
        Option(holds & (soon | ~building), view.at_pots(right, rest)),
        Option(holds & (view.clears | ~building), view.at_pots(view.full & ~view.right, rest)),
        Option(holds, view.parking),
    ]


def _with_ingredient(view: View) -> list[Option]:
    holds, kind = view.scene.holds_ingredient, view.scene.counts(view.scene.hand) > 0
    takes = jnp.any((view.lacking > 0) & kind, axis=-1)
    # What is for later goes into a pot only if another one is left for the current recipe.
    fits = view.plans[:, 0] < NEVER
    spare = (view.recipes == view.recipes[0]) | (view.stock[0] > 0) | (jnp.sum(fits) > fits)[:, None]
    plans = jnp.min(jnp.where(takes & (spare | ~jnp.any(fits)), view.plans, NEVER), axis=1)
    return [
        Option(holds, view.at_pots(plans < NEVER, plans)),
        Option(holds & ~jnp.any(fits), view.at_pots(view.spoiled)),
        Option(holds & (not view.kitchen.serves), view.at_pots(view.full | view.mate_delivers)),
        Option(holds, view.parking),
    ]


def _with_nothing(view: View) -> list[Option]:
    kitchen, scene, plans = view.kitchen, view.scene, view.plans
    empty = scene.holds_nothing
    to_pot = jnp.asarray(kitchen.leg)[:, kitchen.pot_cells]

    def fetch(ingredients: Bool[Array, " types"], then: Array) -> Int[Array, " cells"]:
        return view.cost(jnp.any(view.sources & ingredients[:, None], axis=0), then)

    def plate_for(which: Bool[Array, " P"]) -> Option:
        return Option(empty & jnp.any(which), view.cost(view.plates, jnp.min(jnp.where(which, to_pot, FAR), axis=1)))

    pot, recipe = jnp.unravel_index(jnp.argmin(plans), plans.shape)
    builds = empty & (jnp.min(plans) < NEVER)
    lacking = view.lacking[pot, recipe]
    brings = (scene.partner_hand & PLATE == 0) & (view.memory.calm < PATIENCE)
    coming = scene.counts(scene.partner_hand) * brings
    ingredients = fetch(lacking > coming, to_pot[:, pot])
    quick = jnp.sum(lacking * jnp.asarray(kitchen.trip)[pot]) <= PATIENCE - 4

    arrival = jnp.min(jnp.where(view.plates[:, None], view.time[:, None] + to_pot, NEVER), axis=0)
    due = view.timers <= arrival + 2
    right = view.right & ~view.mate_takes & kitchen.serves
    wrong = view.full & ~view.right & view.clears & kitchen.serves
    used = jnp.any(scene.counts(view.recipes) > 0, axis=0)
    return [
        Option(builds & quick & ~view.risky, ingredients),
        plate_for(right & due),
        plate_for(wrong & due & view.risky),
        Option(builds, ingredients),
        plate_for(right),
        plate_for(wrong),
        Option(empty & jnp.any(view.spoiled), fetch(used, to_pot[:, 0])),
        # Who only fills pots has a piece ready for the next soup.
        Option(empty & jnp.any(view.full | view.mate_delivers) & (not kitchen.serves), fetch(used, to_pot[:, 0])),
    ]


def _beside_teammate(view: View, found: Bool[Array, ""], target: Int[Array, ""], action: Int[Array, ""]):
    """The action in a room that both share: wait out of the teammate's way, and do not bump into it for ever."""
    scene, kitchen, still = view.scene, view.kitchen, view.memory.still
    layout, origin = scene.paths.layout, view.origin[1:]
    ahead = jnp.asarray(layout.ahead)[scene.partner, scene.state.facings[TEAMMATE].astype(jnp.int32)]
    pushed = (ahead == scene.me) & (still > 0)
    reachable = found & (view.time[target] < FAR)
    # Who stands where the ego has to go may leave in this very step; who does not may be waiting for the ego.
    follows = found & ~reachable & ~pushed & (still < 3)
    through = jnp.asarray(kitchen.action)[0, *origin, target]

    carries = jnp.where(scene.partner_hand & COOKED > 0, 0, jnp.where(scene.partner_hand > 0, 1, 2))
    ends = jnp.asarray(layout.moves[:, : STAY + 1].astype(np.int32))[scene.me]
    stays = jnp.arange(STAY + 1) == STAY
    taken = (ends == scene.partner) | ((ends == scene.me) & ~stays) | (stays & pushed)
    away = jnp.where(found, jnp.asarray(kitchen.time[0].min(axis=1))[ends, target], 0)
    hindrance = jnp.asarray(_hindrance(scene.paths))[carries, scene.partner, ends]
    aside = jnp.argmin(jnp.where(taken, NEVER, hindrance + away - stays))

    works = reachable & ((action != STAY) | scene.holds_plate)
    action = jnp.where(works, action, jnp.where(follows, through, aside))
    return jnp.where(view.memory.bumps % 2 == 1, STAY, action)
