"""Test the heuristic teammates: published actions and mean returns, every family on every layout as either agent,
rules that published episodes do not cover, and random numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment
from icrl4aht_generation.experts.padded import padded_layout
from icrl4aht_generation.policy import Noise, Situation
from icrl4aht_generation.teammates.heuristics import territory, utility_greedy
from icrl4aht_generation.teammates.heuristics.heuristic import draw
from icrl4aht_generation.teammates.heuristics.utility_greedy import GreedyMemory
from icrl4aht_generation.teammates.instances import published_teammates
from icrl4aht_generation.teammates.registry import (
    HEURISTIC_FAMILIES,
    build_teammate,
    heuristic_teammate,
    sample_teammate,
)

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS, STAY, UP
from icrl4aht_data.overcooked.cells import COOKED, PLATE
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.state import faults, record_size
from icrl4aht_data.overcooked.tables import Tables
from tests.helpers.states import random_records, state_record

H1, H2, H3, H4 = "recipe_aware_button", "territory", "assembly_line", "utility_greedy"
PUBLISHED_PLAY = """
test_simple (5,2) 000 recipe_aware_button 0 325041120202020202020202020240442402020202020202042402020240
test_simple (5,2) 000 recipe_aware_button 1 444044414444440341314344444444444444444444144444344444444444
test_simple (5,2) 000 recipe_aware_button 2 444444404444444444443144444444444444444444444444444444444444
test_simple (5,2) 000 recipe_aware_button 3 444044414444443444134444444444444444444444444444444344441444
test_simple (5,2) 000 recipe_aware_button 4 325041120204240202020202020240442402402020202020240420202042
test_simple (5,2) 000 territory 0 444444444444444444444444444444444444444444444444444444444444
test_simple (5,2) 000 territory 1 030535113355551133555511335555113351355555113351355555113351
test_simple (5,2) 000 territory 2 444404444441434444444444444414334044144444444444414344444414
test_simple (5,2) 000 territory 3 030512503051250305125325124440123244401232535051250305125030
test_simple (5,2) 000 territory 4 030512503051250305125012020202020202020202020202020202020202
test_simple (5,2) 000 assembly_line 0 044344404454444125043051245043444440444514244454444444444444
test_simple (5,2) 000 assembly_line 1 013430535020512503051254044340132051123245413244444444402444
test_simple (5,2) 000 assembly_line 2 043130414305125034143041341430413134130512503130144301444341
test_simple (5,2) 000 assembly_line 3 034045414235045121503305143143441435051124302502404305125403
test_simple (5,2) 000 assembly_line 4 344425134444124444444443142444443444124434444142444444444444
test_simple (5,2) 000 utility_greedy 0 030512503051250305125325124444444444444450530512503051250305
test_simple (5,2) 000 utility_greedy 1 030512503051250305125325124444444444444450530512503051250305
test_simple (5,2) 000 utility_greedy 2 030512503051250305125325124444444444444450530512503051250305
test_simple (5,2) 000 utility_greedy 3 030512503051250305125325124444444444444450530512503051250305
test_simple (5,2) 000 utility_greedy 4 030512503051250305125325124444444444444450530512503051250305
"""
"""Lines of layout, teammate's start, recipe, family, instance, and 60 actions in the published ids, computed by an
independent simulator of the published teammates. The ego is at (1, 1), both face up, and the recipe is constant."""
PLAYS = [line.split() for line in PUBLISHED_PLAY.split("\n")[1:-1]]

PUBLISHED_MEANS = {
    "coord_simple": {H1: [0] * 5, H2: [0] * 5, H3: [20.0, 20.0, 0.0, 9.2, 0.0], H4: [40.0] * 5},
    "test_simple": {H1: [0] * 5, H2: [0] * 5, H3: [20.0, 20.0, 0.0, 9.8, 0.0], H4: [40.0] * 5},
}
"""Mean returns of t0..t4 with an ego that always stays, over 500 episodes, by the independent simulator."""

NOISE = """
0 1 0.403646 0.557784 0.155612 0.673338
507451445 1853169794 0.828372 0.199526 0.000862 0.100014
3704974950 1863054868 0.543613 0.206101 0.890238 0.024123
3779159788 2663927681 0.767915 0.845932 0.815822 0.315233
2783477504 2669311029 0.067546 0.878911 0.419685 0.275308
2051959874 1657856991 0.208008 0.492793 0.256239 0.877548
3808005281 3946009514 0.226624 0.606609 0.665490 0.032333
3331961082 2320838513 0.669757 0.632860 0.953956 0.912423
"""
"""Lines of a step's key (two words) and random numbers u1..u4, as the published code draws them (JAX 0.5.3)."""


def stacked(family: str, thetas: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the parameters of several teammates of a family, stacked along a new first axis."""
    defaults = HEURISTIC_FAMILIES[family].defaults
    dtypes = {name: np.int32 if isinstance(default, int) else np.float32 for name, default in defaults.items()}
    return {name: np.array([theta[name] for theta in thetas], dtype) for name, dtype in dtypes.items()}


@cache
def start_records(name: str) -> np.ndarray:
    """Return 128 records of random starts, and the published start."""
    records = jax.jit(Environment(LAYOUTS[name]).init)(jax.random.split(jax.random.key(7), 128)).record
    return np.concatenate([records, state_record(LAYOUTS[name], (1, 1, "up"), (5, 2, "up"))])


@cache
def played(name: str, family: str) -> tuple[np.ndarray, np.ndarray]:
    """Return actions and returns of a family's five published teammates as agent 1, in 129 episodes of 100 steps.

    Actions have shape (100, 5, 129), and returns have shape (5, 129). Noise is as published, and the ego always stays.
    The last episode has the published start and a constant recipe.
    """
    layout, records = LAYOUTS[name], start_records(name)
    entries = published_teammates(name, family)
    policy = build_teammate(layout, entries[0], noise="fixed")
    recipes = np.random.default_rng(3).choice(layout.recipe_items, (100, len(records)))
    recipes[:, -1] = layout.recipe_items[0]

    def play_episode(params, record, recipes):
        def step(carry, recipe):
            record, memory = carry
            action, memory = policy.act(params, memory, record, jax.random.key(0))
            outcome = rules.step(layout, record, jnp.array([STAY, action]), recipe)
            return (outcome.state, memory), (action, outcome.reward)

        return jax.lax.scan(step, (record, policy.init(params, jax.random.key(99))), recipes)[1]

    run = jax.jit(jax.vmap(jax.vmap(play_episode, (None, 0, 1), 1), (0, None, None), 1))
    params = stacked(family, [entry["theta"] for entry in entries])
    actions, rewards = run(params, records, recipes)
    return np.asarray(actions), np.asarray(rewards.sum(axis=0))


@pytest.mark.parametrize("line", PLAYS, ids=lambda line: f"{line[3]}-t{line[4]}")
def test_actions_equal_the_published_actions(line):
    name, start, recipe, family, number, digits = line
    assert (start, recipe, len(digits)) == ("(5,2)", "000", 60)
    actions = played(name, family)[0][:60, int(number), -1]
    assert "".join(str(PUBLISHED_ACTIONS.index(ACTIONS[action])) for action in actions) == digits


@pytest.mark.parametrize("name", ["test_simple", pytest.param("coord_simple", marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", HEURISTIC_FAMILIES)
def test_mean_returns_agree_with_published_means(name, family):
    returns = played(name, family)[1][:, :-1]
    published = np.array(PUBLISHED_MEANS[name][family])
    error = returns.std(axis=1) * np.sqrt(1 / returns.shape[1] + 1 / 500)
    assert np.all(np.abs(returns.mean(axis=1) - published) <= 4 * error), (returns.mean(axis=1), error)


def test_random_numbers_equal_those_of_the_published_code():
    key = jax.random.key(1)
    for line in NOISE.split("\n")[1:-1]:
        first, second, *expected = line.split()
        assert jax.random.key_data(key).tolist() == [int(first), int(second)]
        key, u = draw(key)
        np.testing.assert_allclose(u, np.array(expected, float), atol=5e-7)


def noise_key(memory: Any) -> jax.Array:
    """Return the random key in the memory of a heuristic; H3's memory consists of the key."""
    return getattr(memory, "key", memory)


@pytest.mark.parametrize("family", HEURISTIC_FAMILIES)
def test_fixed_noise_ignores_the_episode_key_unlike_seeded_noise(family):
    for slot in (0, 1):
        teammate = heuristic_teammate(family, "default", 0)
        fixed, seeded = (build_teammate(LAYOUTS["cramped_up"], teammate, slot, noise) for noise in get_args(Noise))
        assert noise_key(fixed.init(fixed.params, jax.random.key(123))) == jax.random.key(slot)
        assert noise_key(seeded.init(seeded.params, jax.random.key(123))) == jax.random.key(123)


ROWS = 48
ALL_SLOTS = tuple((family, slot) for family in HEURISTIC_FAMILIES for slot in (0, 1))


@cache
def compiled_teammates() -> tuple[dict, Callable]:
    """Return the policies by (family, agent), and one compiled program that steps all policies on any layout.

    The program takes lists of parameters and of memories in the order of `ALL_SLOTS`, with leaves of shape (ROWS, ...),
    padded records of shape (ROWS, S), and padded tables. It returns a list of pairs of actions and memories.
    """
    policies = {slot: build_teammate(None, heuristic_teammate(slot[0], "default", 0), slot[1]) for slot in ALL_SLOTS}

    def act(params, memories, record, tables):
        view, key = Situation(tables, record), jax.random.key(0)
        return [policies[s].act(p, m, view, key) for s, p, m in zip(ALL_SLOTS, params, memories, strict=True)]

    return policies, jax.jit(jax.vmap(act, in_axes=(0, 0, 0, None)))


def pad_inputs(layout: Layout, records: np.ndarray) -> tuple[Tables, np.ndarray]:
    """Return tables and records padded to common shapes, so that all layouts share one compilation."""
    tables, _, positions = padded_layout(layout)
    found = np.zeros((len(records), record_size(tables)), np.uint8)
    found[:, positions] = records
    return tables, found


def act_all(layout: Layout, params: dict, memories: dict, records: np.ndarray) -> dict:
    _, act = compiled_teammates()
    tables, records = pad_inputs(layout, records)
    inputs = ([part[slot] for slot in ALL_SLOTS] for part in (params, memories))
    return dict(zip(ALL_SLOTS, act(*inputs, records, tables), strict=True))


@cache
def first_memories() -> dict:
    keys = jax.random.split(jax.random.key(4), ROWS)
    policies, _ = compiled_teammates()
    return {slot: jax.vmap(p.init, (None, 0))(p.params, keys) for slot, p in policies.items()}


@cache
def default_params() -> dict:
    return {slot: stacked(slot[0], [HEURISTIC_FAMILIES[slot[0]].defaults] * ROWS) for slot in ALL_SLOTS}


@cache
def many_params(name: str) -> dict:
    """Return ROWS parameter sets for every (family, agent): published parameters, presets and sampled parameters."""
    params = {}
    for family, heuristic in HEURISTIC_FAMILIES.items():
        presets = [heuristic_teammate(family, preset, 0)["theta"] for preset in heuristic.presets]
        sampled = [
            sample_teammate(family, number, split)["theta"] for number in range(3) for split in ("train", "test")
        ]
        published = [entry["theta"] for entry in published_teammates(name, family)]
        thetas = [*published, *presets, *sampled]
        params[family, 0] = params[family, 1] = stacked(family, [thetas[i % len(thetas)] for i in range(ROWS)])
    return params


DEFAULT_LAYOUTS = ("demo_wide",)
ACTIONS_ON = {"demo_wide": "6311923e202b557d"}
"""Hash of the actions that all families take in the next test, which changes of the code must not alter."""


@pytest.mark.parametrize(
    "name", [name if name in DEFAULT_LAYOUTS else pytest.param(name, marks=pytest.mark.slow) for name in LAYOUTS]
)
def test_every_family_plays_every_layout_as_both_agents(name):
    """In row i, two agents of family i % 4 play with each other; other families act on the same states."""
    layout = LAYOUTS[name]
    rng = np.random.default_rng(2)
    params, memories = many_params(name), first_memories()
    shapes = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), memories)
    records, digest = random_records(layout, ROWS, rng), hashlib.sha256()
    for _ in range(25):
        acted = act_all(layout, params, memories, records)
        memories = {slot: memory for slot, (_, memory) in acted.items()}
        actions = np.stack([acted[slot][0] for slot in ALL_SLOTS])
        assert actions.dtype == np.int32
        assert set(np.unique(actions)) <= set(range(len(ACTIONS)))
        digest.update(actions.tobytes())
        played = actions.reshape(4, 2, ROWS)[np.arange(ROWS) % 4, :, np.arange(ROWS)]
        records = rules.step(layout, records, played, rng.choice(layout.recipe_items, ROWS)).state
        assert faults(layout, records) == []
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), memories) == shapes
    assert digest.hexdigest()[:16] == ACTIONS_ON.get(name, digest.hexdigest()[:16])


# Tests of single actions without noise, for rules that the published episodes do not cover.

ZERO, ONE = 4, 16  # item bytes of ingredients 0 and 1
SOUP_0 = 3 * ZERO | COOKED
DISH_0 = SOUP_0 | PLATE
MIXED = 2 * ZERO + ONE


def one_step(
    layout: Layout, family: str, slot: int, theta: dict[str, float], mine, partner, memory=None, **fields
) -> tuple[str, Any]:
    """Return a teammate's action and memory; `mine` and `partner` are (x, y, facing, item in hand)."""
    agents = (mine, partner) if slot == 0 else (partner, mine)
    fields["hands"] = [agent[3] for agent in agents]
    records = np.repeat(state_record(layout, agents[0][:3], agents[1][:3], **fields), ROWS, axis=0)
    memories = first_memories()
    mind = memories[family, slot]
    if memory:
        mind = mind._replace(**{name: np.full_like(getattr(mind, name), v) for name, v in memory.items()})
    own = {(family, slot): stacked(family, [HEURISTIC_FAMILIES[family].defaults | theta] * ROWS)}
    actions, after = act_all(layout, default_params() | own, memories | {(family, slot): mind}, records)[family, slot]
    assert len(set(actions.tolist())) == 1
    return ACTIONS[actions[0]], jax.tree.map(lambda leaf: leaf[0], after)


SPECIALIST = {"task_specialization": 1.0}
RUNNER, PLATER = {"role_mode": 0}, {"role_mode": 1}
FULL = {"pot_items": [3 * ZERO], "pot_timers": [19]}
DONE = {"pot_items": [SOUP_0]}
INVADER = {"behavior_mode": territory.INVADER, "strictness": 1.0, "shared_margin": 0}
TWO = {"pot_items": [2 * ZERO]}

CRAMPED_CASES = [
    # H1 walks around a partner in its way, or keeps trying to move to the partner's cell.
    (H1, {}, {}, "1 32- 12- left, 1 32- 22- up, 0 21d 31- down, 0 210 22- right, 0 120 22- right, 0 32- 22- up"),
    (H1, {}, DONE, "0 21p 22- right, 1 21p 32d down"),
    # H1 as agent 1 leaves the pot to a partner that carries an ingredient and is about as near to the pot.
    (H1, {}, {}, "1 220v 210 right, 1 220v 110 interact, 1 220v 21p interact, 0 220v 210 interact, 0 21d 32- right"),
    # A specialized H1 fetches no plate as agent 1 while the partner has no plate, and puts its dish down as agent 0.
    (H1, SPECIALIST, {}, "1 21- 32- down, 1 21- 32p left, 0 21d 32- interact"),
    # H1 with a plate makes way for a partner with a dish.
    (H1, {}, {}, "1 21p 11d down, 1 12p 11d right, 1 32p 11d stay, 1 22p 32d left, 0 31p 32d left, 1 21p 12d stay"),
    # Two H1 agents fetch different ingredients of a mixed recipe.
    (H1, {}, {"recipe": MIXED}, "1 22- 12- right, 0 22- 32- left"),
    (H1, {}, {"recipe": MIXED, "pot_items": [ZERO + ONE]}, "1 22- 32- left"),
    # `yield_bias` decides whether H2 waits as agent 1 if the partner is near the only access cell of the target, and
    # whether H2 walks around the partner as agent 0.
    (H2, {"yield_bias": 0.1}, {}, "1 21- 12- stay, 1 21- 32- left"),
    (H2, {"yield_bias": 0.05}, {}, "1 21- 12- left, 1 32- 22- up"),
    (H2, {"yield_bias": 0.3}, {}, "0 32- 22- up"),
    (H2, {"yield_bias": 0.2}, {}, "0 32- 22- left"),
    # H2 picks up items from counters, and puts down a plate that no soup needs.
    (H2, {}, {"counters": {(2, 0): ONE}}, "1 21- 32- interact"),
    (H2, {}, {}, "1 21p 32- interact"),
    (H2, {}, FULL, "1 22pv 32- stay"),
    # A strict H2 without a goal or pile in its territory uses those of the partner's territory.
    (H2, {"strictness": 1.0}, {"recipe": 3 * ONE}, "0 21d 32- right, 0 11- 32- right"),
    # H3 as agent 1 with empty hands makes room for a partner that carries an item; as agent 0 it does not.
    (H3, {}, {}, "1 21- 11p right, 1 31- 21p down, 1 21- 220 right, 1 32- 31d left, 0 21- 11p left"),
    # H3 as agent 1 stays if its next cell is adjacent to the partner.
    (H3, {}, {}, "1 32- 12- stay, 0 32- 12- left, 1 22- 31- left"),
    # H3 counts an ingredient that the partner carries as if it were in the pot, but does not count a carried dish.
    (H3, {}, TWO, "0 22- 310 down, 0 22- 311 left, 0 22- 31d left"),
    # H3 fetches a plate for a finished soup, and with high plate urgency also for a soup that is still cooking.
    (H3, {}, DONE, "0 21- 32- left"),
    (H3, {"plate_urgency": 0.6}, FULL, "0 21- 32- left"),
    (H3, {"plate_urgency": 0.5}, FULL, "0 21- 32- down"),
    (H3, PLATER, {}, "0 210 32- interact"),
    (H3, RUNNER, DONE, "0 21p 32- interact, 0 210 32- interact"),
    # H3 puts an ingredient for the partner on a counter next to the pot, in the middle, or near the partner.
    (H3, RUNNER | {"handoff_style": 0}, FULL, "0 210 32- down"),
    (H3, RUNNER | {"handoff_style": 1}, FULL, "0 210 32- interact"),
    (H3, RUNNER | {"handoff_style": 2}, FULL, "0 210 32- right"),
]
ASYMM_CASES = [
    # H1 carries an ingredient to a pot that needs this ingredient, or else to any pot.
    (H1, {}, {"recipe": MIXED, "pot_items": [0, 2 * ZERO]}, "1 530< 13- up, 1 531< 13- interact"),
    (H1, {}, {"pot_items": [0, ZERO]}, "1 531< 13- interact"),
    # An invading H2 takes no plate from its own side and wanders, unless several soups are ready.
    (H2, INVADER, {"pot_items": [SOUP_0, 0]}, "1 53-> 13- right"),
    (H2, INVADER, {"pot_items": [SOUP_0, SOUP_0]}, "1 53-v 13- interact"),
]
DEMO_CASES = [
    # A stubborn H3 with empty hands walks to its home cell (5, 3) as agent 1; the home cell of agent 0 is a wall.
    (H3, {"stubbornness": 1.0}, {}, "1 13- 51- right, 1 130 51- right, 0 41- 13- left"),
    (H3, {}, {}, "1 13- 51- down"),
]
SCENES = {"cramped_down": CRAMPED_CASES, "asymm_right": ASYMM_CASES, "demo_wide": DEMO_CASES}
"""Cases by layout: family, parameters, state, and moves. A move has the agent's number, the agent's and the partner's
x, y, hand (- nothing, p plate, d dish, 0 or 1) and facing (default up), and the expected action. cramped_down has
floor at (1..3, 1..2), plates at (1, 0), the goal at (3, 0), piles 0 and 1 at (0, 1) and (4, 1) and the pot at (2, 3);
asymm_right has pots at (4, 2) and (4, 3)."""


@pytest.mark.parametrize("case", [(name, *case) for name, cases in SCENES.items() for case in cases], ids=str)
def test_heuristics_take_expected_actions_in_given_states(case):
    name, family, theta, fields, moves = case
    hands = {"-": 0, "p": PLATE, "d": DISH_0, "0": ZERO, "1": ONE}
    facings = {"": "up", "v": "down", "<": "left", ">": "right"}
    for move in moves.split(", "):
        slot, mine, partner, expected = move.split()
        agents = [(int(p[0]), int(p[1]), facings[p[3:]], hands[p[2]]) for p in (mine, partner)]
        assert one_step(LAYOUTS[name], family, int(slot), theta, *agents, **fields)[0] == expected, move


@pytest.mark.parametrize(
    ("cell", "stuck", "expected", "stuck_after"), [(7, 3, "right", 4), (8, 3, "right", 0), (7, 2, "interact", 3)]
)
def test_h2_wanders_after_four_steps_on_the_same_cell(cell, stuck, expected, stuck_after):
    memory, counters = {"cell": cell, "stuck": stuck}, {(2, 0): ONE}
    mine, partner = (2, 1, "up", 0), (3, 2, "up", 0)
    action, after = one_step(LAYOUTS["cramped_down"], H2, 1, {}, mine, partner, memory, counters=counters)
    assert (action, int(after.cell), int(after.stuck)) == (expected, 7, stuck_after)


UNSIGNED = Layout("unsigned", "test_unsigned", ("WWLWPWW", "0A   AX", "1     B", "WWWWWWW"))
"""A layout in which agents see the recipe only after pressing the button."""
SURE = {"press_L_when_unknown": 1.0, "cost_sensitivity": 0.0}


def split_key(key: jax.Array, n: int) -> list[int]:
    """Split a random key n times, keep the first of the two new keys each time, and return the last key's data."""
    for _ in range(n):
        key = jax.random.split(key)[0]
    return jax.random.key_data(key).tolist()


@pytest.mark.parametrize(
    ("theta", "memory", "fields", "expected", "steps"),
    [
        (SURE, {}, {}, "left", 1),  # H1 walks to the button
        (SURE | {"cost_sensitivity": 1.0}, {}, {}, "stay", 0),  # H1 does not press the button; its key stays the same
        ({"press_L_when_unknown": 0.0, "strict_recipe": 0.3}, {}, {}, "left", 0),  # H1 guesses ingredient 0
        ({"press_L_when_unknown": 0.0, "wrong_ingredient_prob": 1.0}, {}, {}, "left", 1),  # H1 takes ingredient 0
        (SURE | {"idle_prob": 1.0}, {}, {}, "stay", 1),
        (SURE, {"recipe": 3 * ZERO, "seen": 0, "clock": 100}, FULL, "stay", 1),
        (SURE, {"recipe": 3 * ZERO, "seen": 0, "clock": 101}, FULL, "left", 1),
        (SURE, {}, FULL | {"buttons": [5]}, "stay", 1),
    ],
)
def test_h1_presses_the_button_to_see_the_recipe(theta, memory, fields, expected, steps):
    action, after = one_step(UNSIGNED, H1, 1, theta, (4, 1, "up", 0), (5, 2, "up", 0), memory, **fields)
    assert action == expected
    start = first_memories()[H1, 1].key[0]
    assert jax.random.key_data(after.key).tolist() == split_key(start, steps)
    assert int(after.recipe) == (3 * ZERO if fields.get("buttons") else memory.get("recipe", 0))


ROLLS = np.array([0, 1, 19, 20, 39, 40, 41, 99] * (ROWS // 8))
"""Random numbers below 100 by which H4 decides whether it yields to its partner, and how long."""


def greedy_memory(intent: int = -1, wait: int = 0) -> GreedyMemory:
    key = jax.random.wrap_key_data(jnp.array([[300 + roll, 7] for roll in ROLLS], jnp.uint32))
    return GreedyMemory(key, jnp.full(ROWS, intent, jnp.int32), jnp.full(ROWS, wait, jnp.int32))


def move_greedy_up(slot: int, partner: tuple[int, int, str], memory: GreedyMemory) -> tuple[np.ndarray, GreedyMemory]:
    """Return actions and memories of `utility_greedy` at (1, 2), on its way up to pile 0 with empty hands."""
    layout, mover = LAYOUTS["cramped_up"], (1, 2, "up")
    record = state_record(layout, *((mover, partner) if slot == 0 else (partner, mover)))
    memories = first_memories() | {(H4, slot): memory}
    return act_all(layout, default_params(), memories, np.repeat(record, ROWS, axis=0))[H4, slot]


@pytest.mark.parametrize("slot", [0, 1])
def test_utility_greedy_yields_only_if_its_next_cell_is_adjacent_to_the_partner(slot):
    actions, after = move_greedy_up(slot, (2, 1, "down"), greedy_memory())
    yields = (20, 40)[slot] > ROLLS
    np.testing.assert_array_equal(actions, np.where(yields, STAY, UP))
    np.testing.assert_array_equal(after.wait, np.where(yields, 1 + ROLLS % 2, 0))
    assert (after.intent == utility_greedy.FETCH).all()
    actions, after = move_greedy_up(slot, (3, 2, "down"), greedy_memory())
    assert (actions == UP).all() and (after.wait == 0).all()


def test_waiting_utility_greedy_keeps_its_intent_and_advances_its_random_key():
    memory = greedy_memory(utility_greedy.PRESS, wait=2)
    for wait in (1, 0):
        following = jax.vmap(lambda key: jax.random.split(key, 3)[0])(memory.key)
        actions, memory = move_greedy_up(1, (2, 1, "down"), memory)
        assert (actions == STAY).all() and (memory.wait == wait).all()
        assert (memory.intent == utility_greedy.PRESS).all() and (memory.key == following).all()
