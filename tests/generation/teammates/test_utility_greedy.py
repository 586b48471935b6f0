"""H4 utility_greedy: the published play, a plain rewriting of its rules, its noise, and its lookup tables of paths."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.paths import UNREACHABLE, Paths
from icrl4aht_generation.policy import Noise
from icrl4aht_generation.teammates.heuristics import utility_greedy
from icrl4aht_generation.teammates.heuristics.heuristic import next_key
from icrl4aht_generation.teammates.heuristics.utility_greedy import UTILITY_GREEDY, GreedyMemory
from icrl4aht_generation.teammates.registry import build_teammate, heuristic_teammate

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS, DOWN, INTERACT, LEFT, PUBLISHED_ACTIONS, RIGHT, STAY, TEAMMATE, UP
from icrl4aht_data.overcooked.layouts import BUTTON, GOAL, LAYOUTS, PLATES, WALL, Layout
from icrl4aht_data.overcooked.state import ingredient_count, start, unpack
from tests.helpers.states import random_records, state_record

PUBLISHED_PLAY = "030512503051250305125325124444444444444450530512503051250305"
"""H4-t0..t4 on test_simple in the published ids, by an independent simulator of the published teammates."""

NAMES = (
    *("w_deliver", "w_pickup_cooked", "w_get_plate", "w_add_ingredient", "w_fetch_ingredient", "w_stage_on_counter"),
    *("w_start_cooking", "w_press_L", "dist_weight", "inertia", "counter_preference"),
)

TEST_THETAS = [
    dict(zip(NAMES, values, strict=True))
    for values in (
        (18.0, 15.0, 10.0, 5.0, 4.0, 1.0, 8.0, 0.0, 0.3, 0.4, 0.3),
        (6.0, 4.0, 3.0, 14.0, 12.0, 4.0, 16.0, 0.0, 0.4, 0.5, 0.7),
        (10.0, 8.0, 6.0, 8.0, 7.0, 3.0, 9.0, 0.0, 1.5, 0.2, 0.5),
        (10.0, 9.0, 6.0, 7.0, 5.0, 2.0, 8.0, 0.0, 0.5, 0.85, 0.5),
        (9.0, 7.0, 6.0, 8.0, 7.0, 8.0, 6.0, 0.0, 0.4, 0.3, 0.9),
    )
]
"""H4-t0..t4 of the published manifests."""

SEARCH = (RIGHT, DOWN, LEFT, UP)
DELTA = {UP: (0, -1), DOWN: (0, 1), LEFT: (-1, 0), RIGHT: (1, 0)}
FACED_BY = {0: UP, 1: DOWN, 2: RIGHT, 3: LEFT}  # facing -> the action that turns there

OPEN = Layout(
    "open",
    "test_open",
    ("WWWWWWWWWWWW", "WA    W    W", "W     W    W", "W     W    W", "W     W A  W", "W     0    1", "WWWWWWWWWWWW"),
)
"""Two rooms without counters inside."""

ISLAND = Layout(
    "island",
    "test_island",
    ("W0PRWWW1", "XA   WWW", "W P    W", "B   AWWW", "WWLWWWWW"),
    recipes=((0, 0, 1), (0, 1, 1)),
)
"""One room: a pot that can be reached from all sides, one from below, an alley with a dead end at (6, 2); the pile of
ingredient 1, which the recipes ask for, is out of reach."""


# Playing.


@lru_cache
def _scan(layout: Layout, slot: int, noise: Noise, steps: int):
    """Return a jitted function of H4 with a motionless partner.

    It maps thetas (K, ...), records (N, S), next recipes (steps, N) and keys (N,) to actions and rewards (steps, K, N).
    """
    policy = build_teammate(layout, {"family": "utility_greedy", "theta": UTILITY_GREEDY.defaults}, slot, noise)

    def one(params, record, recipes, key):
        def step(carry, recipe):
            record, memory = carry
            action, memory = policy.act(params, memory, record, key)
            both = jnp.full(2, STAY).at[slot].set(action)
            outcome = rules.step(layout, record, both, recipe)
            return (outcome.state, memory), (action, outcome.reward)

        return jax.lax.scan(step, (record, policy.init(params, key)), recipes)[1]

    batch = jax.vmap(jax.vmap(one, (None, 0, 1, 0), 1), (0, None, None, None), 1)
    return jax.jit(batch)


def play(
    layout: Layout,
    records: np.ndarray,
    recipes: np.ndarray,
    keys: jax.Array,
    *,
    thetas: list[dict[str, float]] = TEST_THETAS,
    slot: int = TEAMMATE,
    noise: Noise = "fixed",
) -> tuple[np.ndarray, np.ndarray]:
    """Actions and rewards (steps, thetas, N)."""
    params = {name: jnp.array([theta[name] for theta in thetas], jnp.float32) for name in UTILITY_GREEDY.defaults}
    actions, rewards = _scan(layout, slot, noise, len(recipes))(params, records, recipes, keys)
    return np.asarray(actions), np.asarray(rewards)


def start_records(layout: Layout, n: int) -> np.ndarray:
    """Return random starts (n, S) in a layout with a room for each agent."""
    rng = np.random.default_rng(5)
    positions = np.stack([rng.choice(room, n) for room in layout.rooms], axis=1)
    return start(layout, positions, rng.integers(0, 4, (n, 2), np.uint8), rng.choice(layout.recipe_items, n))


@lru_cache
def published(name: str) -> tuple[np.ndarray, np.ndarray]:
    """100 steps of H4-t0..t4 in agent 1 under the published noise, from 12 random starts and, last, from the scene of
    the published string with its recipe pinned: actions and rewards (100, 5, 13)."""
    layout = LAYOUTS[name]
    records = start_records(layout, 12)
    recipes = np.random.default_rng(3).choice(layout.recipe_items, (100, 13))
    pinned = state_record(layout, (1, 1, "up"), (5, 2, "up")) if name == "test_simple" else records[:1]
    recipes[:, -1] = pinned[0, 6]
    keys = jax.random.split(jax.random.key(8), 13)
    return play(layout, np.concatenate([records, pinned]), recipes, keys)


@pytest.mark.parametrize("theta", range(5))
def test_published_actions(theta):
    assert len(PUBLISHED_PLAY) == 60
    expected = [PUBLISHED_ACTIONS[int(digit)] for digit in PUBLISHED_PLAY]
    assert [ACTIONS[action] for action in published("test_simple")[0][:60, theta, -1]] == expected


@pytest.mark.parametrize(
    "name",
    [
        "test_simple",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("coord_simple", "coord_ring", "demo_simple")),
    ],
)
def test_two_deliveries_in_100_steps_with_a_motionless_ego(name):
    rewards = published(name)[1]
    assert set(np.unique(rewards)) == {0, 20}
    np.testing.assert_array_equal((rewards > 0).sum(axis=0), 2)
    np.testing.assert_array_equal(rewards.sum(axis=0), 40)
    first, second = np.sort(rewards.argsort(axis=0, kind="stable")[-2:], axis=0) + 1
    assert 36 <= first.min() <= first.max() <= 50  # as in 150 games of that simulator
    assert 74 <= second.min() <= second.max() <= 92


def test_h4_plays_as_agent_0():
    layout = LAYOUTS["asymm_both"]
    records = start_records(layout, 8)
    recipes = np.random.default_rng(4).choice(layout.recipe_items, (100, 8))
    _, rewards = play(layout, records, recipes, jax.random.split(jax.random.key(0), 8), slot=0)
    assert np.all(rewards.sum(axis=0) >= 20)


# Every rule, rewritten in plain Python.


class Plain(NamedTuple):
    intent: int
    action: int
    wait: int


def plain_rules(
    layout: Layout, theta: dict[str, float], record: np.ndarray, slot: int, last: int, roll: int
) -> Plain | None:
    """Spec/teammates.md, 1.3 to 1.5 and 2.4, cell by cell, for an H4 that does not wait; None if two intents score
    the same on paper, where rounding decides."""
    state = unpack(layout, record)
    width = layout.width
    mine, partner = int(state.positions[slot]), int(state.positions[1 - slot])
    hand, recipe = int(state.hands[slot]), int(state.recipe)
    facing = FACED_BY[int(state.facings[slot])]
    steps_to = brute_distances(layout)
    pots = [
        (cell, int(item), int(timer), int(ingredient_count(item)))
        for cell, item, timer in zip(layout.pots, state.pot_items, state.pot_timers, strict=True)
    ]
    lying = dict(zip(layout.counters, state.counters.tolist(), strict=True))
    of_kind = {
        kind: [c for c in range(layout.cells) if layout.kinds[c] == kind] for kind in (WALL, GOAL, PLATES, BUTTON)
    }
    empty = [c for c in of_kind[WALL] if not lying.get(c)]
    nonfull = [c for c, item, timer, count in pots if timer == 0 and not item & 2 and count < 3]
    cooking = [c for c, _, timer, _ in pots if timer > 0]
    cooked = [c for c, item, _, _ in pots if item & 2]

    def count_of(item: int, k: int) -> int:
        return item >> (2 + 2 * k) & 3

    def piles(wanted: list[int]) -> list[int]:
        items = [4 << 2 * k for k in wanted]
        return [c for c in range(layout.cells) if int(layout.piles[c]) in items]

    kinds = range(len(layout.ingredients))
    needed = piles([k for k in kinds if count_of(recipe, k) > sum(count_of(item, k) for _, item, _, _ in pots)])
    wanted = piles([k for k in kinds if count_of(recipe, k)])

    def floor_around(cell: int) -> list[int]:
        around = [neighbour(layout, cell, action) for action in (UP, DOWN, LEFT, RIGHT)]
        return [c for c in around if c >= 0 and layout.walkable[c]]

    def away(cell: int) -> int:
        return min((steps_to[mine, c] for c in floor_around(cell)), default=UNREACHABLE)

    def reach(cells: list[int]) -> list[int]:
        return [c for c in cells if away(c) < UNREACHABLE]

    def go(cell: int, arrived: int) -> int:
        for action in DELTA:
            if neighbour(layout, mine, action) == cell:
                return arrived if facing == action else action
        costs = [steps_to[mine, c] + 100 * (c == partner) for c in floor_around(cell)]
        return brute_first_step(layout, mine, floor_around(cell)[int(np.argmin(costs))])

    is_dish, is_plate = hand & 3 == 3, hand == 1
    is_ingredient = hand >> 2 > 0 and not hand & 1
    waits = is_plate and not reach(cooked) and bool(reach(cooking))
    near_pots = [c for c in empty if any(neighbour(layout, c, action) in layout.pots for action in DELTA)]
    stage = near_pots if near_pots and theta["counter_preference"] > 0.5 else empty
    n_cooking, n_cooked, n_nonfull = len(cooking), len(cooked), len(nonfull)
    fullest = max(count for *_, count in pots)
    idle = 0.8 if n_nonfull == 0 else 0.2
    plate = 1 + 0.3 * n_cooking + 0.5 * n_cooked if n_cooking + n_cooked else idle
    can_fetch = hand == 0 and needed and (reach(nonfull) or reach(empty))
    if reach(needed):
        fetch = 1 + 0.2 * n_nonfull if reach(nonfull) else 0.8
    else:
        fetch = 0.4 + 0.05 * n_nonfull if reach(nonfull) else 0.15
    stages = (is_ingredient and not reach(nonfull)) or (is_plate and n_cooking + n_cooked + n_nonfull == 0)
    lit = any(int(timer) > 0 for timer in state.buttons)
    intents = [
        (is_dish, "w_deliver", 1 + 0.5 * n_cooked, of_kind[GOAL]),
        (is_plate, "w_pickup_cooked", 1.5 if waits else 1 + 0.5 * n_cooked, cooking if waits else cooked),
        (hand == 0, "w_get_plate", plate, of_kind[PLATES]),
        (is_ingredient, "w_add_ingredient", 1 + 0.2 * (3 - fullest), nonfull),
        (can_fetch, "w_fetch_ingredient", fetch, reach(needed) or wanted),
        (stages, "w_stage_on_counter", 0.5 + 0.1 * n_nonfull, stage),
        (False, "w_start_cooking", 1.5, []),
        (theta["w_press_L"] > 0 and hand == 0 and not lit, "w_press_L", 1.0, of_kind[BUTTON]),
    ]
    scores: dict[int, float] = {}
    for number, (allowed, weight, value, targets) in enumerate(intents):
        if allowed and reach(targets):
            bonus = 2 * theta["inertia"] * (number == last)
            scores[number] = theta[weight] * value - theta["dist_weight"] * min(away(c) for c in targets) + bonus
    best = max(scores, key=lambda number: scores[number], default=-1)
    if sum(score > scores[best] - 1e-4 for score in scores.values()) > 1:
        return None
    if best < 0:
        free = [a for a in SEARCH if brute_move(layout, mine, a) not in (mine, partner)]
        action = free[0] if free else STAY
    else:
        target = min(intents[best][3], key=lambda cell: (away(cell), cell))
        action = go(target, STAY if best == 1 and waits else INTERACT)
    if action in DELTA:
        x, y = mine % width + DELTA[action][0], mine // width + DELTA[action][1]
        touches = abs(x - partner % width) + abs(y - partner // width) <= 1
        if touches and roll < 20 + 20 * slot:
            return Plain(best, STAY, 1 + roll % 2)
    return Plain(best, action, 0)


def neighbour(layout: Layout, cell: int, action: int) -> int:
    """Return the cell next to a cell, -1 outside the map."""
    x, y = cell % layout.width + DELTA[action][0], cell // layout.width + DELTA[action][1]
    return y * layout.width + x if 0 <= x < layout.width and 0 <= y < layout.height else -1


def brute_move(layout: Layout, cell: int, action: int) -> int:
    """Return the cell to which a move leads when no agent is in the way."""
    target = neighbour(layout, cell, action)
    return target if target >= 0 and "".join(layout.rows)[target] in " A" else cell


@lru_cache
def brute_distances(layout: Layout) -> np.ndarray:
    """int (cells, cells): steps between floor cells, by relaxing all triples (Floyd and Warshall)."""
    distance = np.full((layout.cells, layout.cells), UNREACHABLE)
    for cell, letter in enumerate("".join(layout.rows)):
        if letter in " A":
            for action in DELTA:
                distance[cell, brute_move(layout, cell, action)] = 1
            distance[cell, cell] = 0
    for via in range(layout.cells):
        distance = np.minimum(distance, distance[:, via, None] + distance[via])
    return np.minimum(distance, UNREACHABLE)


def brute_first_step(layout: Layout, origin: int, target: int) -> int:
    """The first action, right, down, left, up, that starts a shortest path."""
    left = brute_distances(layout)[origin, target]
    if left in (0, UNREACHABLE):
        return STAY
    return next(a for a in SEARCH if brute_distances(layout)[brute_move(layout, origin, a), target] == left - 1)


@pytest.mark.parametrize(
    ("layout", "slot"),
    [
        (ISLAND, 1),
        (LAYOUTS["demo_wide"], 0),
        *(
            pytest.param(LAYOUTS[name], slot, marks=pytest.mark.slow)
            for name, slot in (("coord_ring", 1), ("asymm_both", 0), ("cramped_up", 1))
        ),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_equals_plain_rules_on_random_states(layout, slot):
    rng = np.random.default_rng(11)
    n = 400
    records = random_records(layout, n, rng)
    if layout is ISLAND:  # some in the dead end behind the partner, with a plate that no soup needs yet
        records[:20] = state_record(layout, (5, 2, "up"), (6, 2, "down"), hands=(0, 1))
    last, rolls = rng.integers(-1, 8, n), rng.integers(0, 100, n)
    thetas = [
        UTILITY_GREEDY.defaults | UTILITY_GREEDY.presets[preset] for preset in UTILITY_GREEDY.presets
    ] + TEST_THETAS
    close = (3.0,) * 8 + (0.3, 1.0, 1.0)  # the highest of weights under which the intents score much alike
    thetas += [dict(zip(UTILITY_GREEDY.defaults, (rng.random(11) * close).tolist(), strict=True)) for _ in range(30)]
    of = rng.integers(0, len(thetas), n)
    params = {name: jnp.array([thetas[t][name] for t in of], jnp.float32) for name in UTILITY_GREEDY.defaults}
    keys = jax.random.wrap_key_data(jnp.stack([jnp.asarray(rolls, jnp.uint32), jnp.zeros(n, jnp.uint32)], axis=1))
    policy = build_teammate(layout, {"family": "utility_greedy", "theta": UTILITY_GREEDY.defaults}, slot)
    memory = GreedyMemory(keys, jnp.asarray(last, jnp.int32), jnp.zeros(n, jnp.int32))
    act = jax.jit(jax.vmap(policy.act))
    actions, after = act(params, memory, records, keys)
    found = [Plain(*row) for row in np.stack([after.intent, actions, after.wait], axis=1).tolist()]
    expected = [plain_rules(layout, thetas[of[i]], records[i], slot, int(last[i]), int(rolls[i])) for i in range(n)]
    clear = [pair for pair in zip(found, expected, strict=True) if pair[1] is not None]
    assert len(clear) > 0.95 * n
    assert [pair[0] for pair in clear] == [pair[1] for pair in clear]


# Noise.


ROLLS = [0, 1, 19, 20, 39, 40, 41, 99]


@lru_cache
def _act(slot: int):
    """H4 in cramped_up, eight at once: memory, records (8, S) -> actions (8,), memory."""
    policy = build_teammate(LAYOUTS["cramped_up"], heuristic_teammate("utility_greedy", "default", 0), slot)
    keys = jax.random.split(jax.random.key(0), 8)
    act = jax.jit(jax.vmap(policy.act, in_axes=(None, 0, 0, 0)))
    return lambda memory, records: act(policy.params, memory, records, keys)


def _memory(rolls: list[int], intent: int = -1, wait: int = 0) -> GreedyMemory:
    key = jax.random.wrap_key_data(jnp.array([[300 + roll, 7] for roll in rolls], jnp.uint32))
    return GreedyMemory(key, jnp.full(8, intent), jnp.full(8, wait))


def _first_memory(noise: Noise, keys: jax.Array, slot: int = TEAMMATE) -> GreedyMemory:
    policy = build_teammate(LAYOUTS["cramped_up"], heuristic_teammate("utility_greedy", "default", 0), slot, noise)
    return jax.vmap(policy.init, in_axes=(None, 0))(policy.params, keys)


def _heading_up(slot: int, partner: tuple[int, int, str]) -> np.ndarray:
    """(8, S): H4, empty-handed at (1, 2), wants to go up to (1, 1), towards pile 0."""
    mover = (1, 2, "up")
    record = state_record(LAYOUTS["cramped_up"], *((mover, partner) if slot == 0 else (partner, mover)))
    return np.repeat(record, 8, axis=0)


@pytest.mark.parametrize("slot", [0, 1])
def test_yields_only_where_the_next_cell_touches_the_partner(slot):
    actions, after = _act(slot)(_memory(ROLLS), _heading_up(slot, (2, 1, "down")))
    yields = [roll < (20, 40)[slot] for roll in ROLLS]
    assert actions.tolist() == [STAY if y else UP for y in yields]
    assert after.wait.tolist() == [1 + roll % 2 if y else 0 for y, roll in zip(yields, ROLLS, strict=True)]
    assert after.intent.tolist() == [utility_greedy.FETCH] * 8
    actions, after = _act(slot)(_memory(ROLLS), _heading_up(slot, (3, 2, "down")))
    assert (actions.tolist(), after.wait.tolist()) == ([UP] * 8, [0] * 8)


def test_waiting_keeps_the_intent_and_advances_the_key():
    memory = _memory(ROLLS, intent=utility_greedy.PRESS, wait=2)
    keys = [memory.key]
    for wait in (1, 0):
        actions, memory = _act(1)(memory, _heading_up(1, (2, 1, "down")))
        keys.append(memory.key)
        assert actions.tolist() == [STAY] * 8
        assert memory.wait.tolist() == [wait] * 8
        assert memory.intent.tolist() == [utility_greedy.PRESS] * 8
    for before, after in pairwise(keys):
        links = jax.vmap(lambda key: jax.random.split(key, 3)[0])(before)
        np.testing.assert_array_equal(jax.random.key_data(after), jax.random.key_data(links))


def test_fixed_key_chain_is_the_published_one():
    chain = [(0, 1), (507451445, 1853169794), (3704974950, 1863054868)]
    keys = jax.random.split(jax.random.key(123), 8)
    assert jax.random.key_data(_first_memory("fixed", keys, slot=0).key).tolist() == [[0, 0]] * 8
    memory = _first_memory("fixed", keys)
    assert memory.intent.tolist() == [-1] * 8
    assert memory.wait.tolist() == [0] * 8
    assert tuple(jax.random.key_data(next_key(next_key(memory.key[0]))).tolist()) == chain[2]
    for expected in chain:
        assert {tuple(key) for key in jax.random.key_data(memory.key).tolist()} == {expected}
        _, memory = _act(1)(memory, _heading_up(1, (2, 1, "down")))


def test_seeded_noise_depends_on_the_episode_key_and_fixed_does_not():
    layout = LAYOUTS["cramped_up"]

    def actions(noise: Noise, keys: jax.Array) -> np.ndarray:
        memory, records, rows = _first_memory(noise, keys), _heading_up(1, (2, 1, "down")), []
        for _ in range(20):
            acted, memory = _act(1)(memory, records)
            rows.append(np.asarray(acted))
            both = np.stack([np.full(8, STAY), rows[-1]], axis=1)
            records = rules.step(layout, records, both, records[:, 6]).state
        return np.stack(rows, axis=1)

    keys = jax.random.split(jax.random.key(2), 8)
    assert len(np.unique(actions("fixed", keys), axis=0)) == 1
    seeded = actions("seeded", keys)
    assert len(np.unique(seeded, axis=0)) > 2
    np.testing.assert_array_equal(actions("seeded", keys[::-1]), seeded[::-1])


# Lookup tables of paths.


@pytest.mark.parametrize("name", LAYOUTS)
def test_paths_equal_brute_force_and_lead_one_step_nearer(name):
    layout = LAYOUTS[name]
    paths = Paths(layout)
    np.testing.assert_array_equal(paths.distance, brute_distances(layout))
    first = [[brute_first_step(layout, a, b) for b in range(layout.cells)] for a in range(layout.cells)]
    np.testing.assert_array_equal(paths.first_step, first)
    origin, target = ((paths.distance > 0) & (paths.distance < UNREACHABLE)).nonzero()
    assert len(origin)
    after = layout.moves[origin, paths.first_step[origin, target]]
    np.testing.assert_array_equal(paths.distance[after, target], paths.distance[origin, target] - 1)
    np.testing.assert_array_equal(paths.first_step[(paths.distance == 0) | (paths.distance == UNREACHABLE)], STAY)


def test_ties_resolve_right_down_left_up_in_an_open_room():
    paths = Paths(OPEN)
    centre_x, centre_y = 3, 3
    for x in range(1, 6):
        for y in range(1, 6):
            dx, dy = x - centre_x, y - centre_y
            expected = RIGHT if dx > 0 else DOWN if dy > 0 else LEFT if dx < 0 else UP if dy < 0 else STAY
            found = paths.first_step[centre_y * OPEN.width + centre_x, y * OPEN.width + x]
            assert ACTIONS[found] == ACTIONS[expected], (x, y)


def test_rooms_are_out_of_each_others_reach():
    paths = Paths(OPEN)
    here, there = OPEN.rooms
    assert np.all(paths.distance[np.ix_(here, there)] == UNREACHABLE)
    assert paths.distance[np.ix_(here, here)].max() == 8
    pile_0 = 5 * OPEN.width + 6  # between the rooms: both agents reach it
    assert paths.access[pile_0].tolist() == [-1, -1, pile_0 - 1, pile_0 + 1]
    assert paths.target_distance[pile_0 - 1, pile_0] == paths.target_distance[pile_0 + 1, pile_0] == 0
