"""The JAX environment, and the rules and observations in JAX compared with NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment, EnvState

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import INTERACT, STAY
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.state import State, columns, unpack
from tests.helpers.states import random_records, state_record

CRAMPED = LAYOUTS["cramped_up"]
PLATE, COOKED, ZERO, ONE = 1, 2, 4, 16  # item bytes; ZERO and ONE are a piece of ingredient 0 and of ingredient 1
FOUR_RECIPES = np.array([3 * ZERO, 2 * ZERO + ONE, ZERO + 2 * ONE, 3 * ONE], np.uint8)

N, MAX_STEPS, STEPS = 2000, 5, 13  # every test steps the same two batches: 2,000 environments and one

DEFAULT_LAYOUTS = ("coord_ring", "demo_wide", "asymm_right")
"""Three contrasting layouts; tests of the others are slow."""

FLOOR = {  # the rooms' floor cells (x, y), ego's and teammate's, read off the maps
    "cramped_up": ([(x, y) for y in (1, 2) for x in (1, 2, 3)],) * 2,
    "asymm_both": (
        [(1, 1), (1, 2), (2, 2), (3, 2), (1, 3), (2, 3), (3, 3)],
        [(7, 1), (5, 2), (6, 2), (7, 2), (5, 3), (6, 3), (7, 3)],
    ),
    "coord_ring": (
        [(x, y) for y in range(1, 8) for x in range(1, 8) if x in (1, 7) or y in (1, 7)],
        [(x, y) for y in (3, 4, 5) for x in (3, 4, 5) if (x, y) != (4, 4)],
    ),
}


class Compiled(NamedTuple):
    """An environment with its two functions, each jitted once."""

    env: Environment
    init: jax.stages.Wrapped
    step: jax.stages.Wrapped

    @classmethod
    def of(cls, env: Environment) -> Compiled:
        return cls(env, jax.jit(env.init), jax.jit(env.step))


@pytest.fixture(scope="module")
def cramped() -> Compiled:
    return Compiled.of(Environment(CRAMPED, max_steps=MAX_STEPS))


def some_keys(number: int) -> jax.Array:
    return jax.random.split(jax.random.key(number), N)


def at_goal(state: EnvState) -> EnvState:
    """Return environments of cramped_up changed: the teammate is at the goal with the dish of the current recipe."""
    where, recipes = columns(CRAMPED), fields(CRAMPED, state.record).recipe
    records = np.repeat(state_record(CRAMPED, (1, 1, "up"), (3, 2, "down")), len(recipes), axis=0)
    records[:, where.recipe] = recipes
    records[:, where.hands.start + 1] = recipes | (PLATE | COOKED)
    return state._replace(record=jnp.asarray(records))


class Life(NamedTuple):
    """Steps of a batch: the state before each, its result, and the actions."""

    before: list[EnvState]
    steps: list
    actions: np.ndarray  # (STEPS, N, 2)


def live(compiled: Compiled, keys: jax.Array, actions: np.ndarray) -> Life:
    """Return steps from the first episode into the third; in the second step of each, every teammate delivers."""
    state, before, steps = compiled.init(keys), [], []
    actions = actions.copy()
    for number in range(len(actions)):
        if number % MAX_STEPS == 1:
            state = at_goal(state)
            actions[number] = STAY, INTERACT
        before.append(state)
        steps.append(compiled.step(state, jnp.asarray(actions[number])))
        state = steps[-1].state
    return Life(before, steps, actions)


@pytest.fixture(scope="module")
def keys() -> jax.Array:
    return some_keys(0)


@pytest.fixture(scope="module")
def actions() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 6, (STEPS, N, 2)).astype(np.int32)


@pytest.fixture(scope="module")
def life(cramped, keys, actions) -> Life:
    return live(cramped, keys, actions)


def fields(layout: Layout, record: jax.Array) -> State:
    return unpack(layout, np.asarray(record))


def assert_uniform(values: Sequence | np.ndarray, possible: int) -> None:
    """Every one of `possible` values occurs equally often: chi-square within six standard deviations of its mean."""
    found, counts = np.unique(np.asarray(values), axis=0, return_counts=True)
    assert len(found) == possible
    expected = counts.sum() / possible
    assert expected >= 30
    freedom = possible - 1
    assert ((counts - expected) ** 2 / expected).sum() < freedom + 6 * np.sqrt(2 * freedom)


# Starts


@pytest.mark.parametrize("name", FLOOR)
def test_starts_are_uniform_over_the_rooms_and_facings_and_recipes(name):
    layout = LAYOUTS[name]
    init = jax.jit(Environment(layout).init)
    states = [init(some_keys(number)) for number in range(3)]
    assert all(not np.asarray(state.clock).any() and not np.asarray(state.episode).any() for state in states)
    records = np.concatenate([np.asarray(state.record) for state in states])
    state = unpack(layout, records)
    rooms = [[y * layout.width + x for x, y in room] for room in FLOOR[name]]
    pairs = sum(ego != teammate for ego in rooms[0] for teammate in rooms[1])
    for agent, room in enumerate(rooms):
        assert set(np.unique(state.positions[:, agent])) == set(room)
        assert_uniform(state.positions[:, agent], len(room))
        assert_uniform(np.stack([state.positions[:, agent], state.facings[:, agent]], axis=1), 4 * len(room))
        assert_uniform(np.stack([state.positions[:, agent], state.recipe], axis=1), 2 * len(room))
    assert_uniform(state.positions, pairs)  # the two never share a cell
    assert_uniform(np.concatenate([state.facings, state.recipe[:, None]], axis=1), 4 * 4 * 2)
    assert set(np.unique(state.recipe)) == {3 * ZERO, 3 * ONE}
    assert not records[:, columns(layout).hands].any()
    assert not records[:, columns(layout).delivered :].any()


# Episodes


def test_done_comes_exactly_after_max_steps(life):
    done = np.stack([np.asarray(step.done) for step in life.steps])
    ends = [False, False, False, False, True]
    np.testing.assert_array_equal(done, np.array([*ends, *ends, *ends[:3]])[:, None].repeat(N, axis=1))
    clocks = np.stack([np.asarray(step.state.clock) for step in life.steps])
    episodes = np.stack([np.asarray(step.state.episode) for step in life.steps])
    assert (clocks == np.array([1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1, 2, 3])[:, None]).all()
    assert (episodes == np.array([0] * 4 + [1] * 5 + [2] * 4)[:, None]).all()


def test_final_is_the_rules_outcome_and_is_never_reset(life):
    for state, step, actions in zip(life.before, life.steps, life.actions, strict=True):
        recipes = np.asarray(step.final)[:, columns(CRAMPED).recipe]  # the draws; judged below
        expected = rules.step(CRAMPED, np.asarray(state.record), actions, recipes)
        np.testing.assert_array_equal(step.final, expected.state)
        np.testing.assert_array_equal(step.reward, expected.reward)
        np.testing.assert_array_equal(step.shaped, expected.shaped)
        if not np.asarray(step.done).any():
            np.testing.assert_array_equal(step.state.record, step.final)


def test_only_finished_environments_restart(cramped, life):
    """Environments with different clocks in one batch restart separately."""
    clocks = np.arange(N) % MAX_STEPS
    state = life.steps[2].state._replace(clock=jnp.asarray(clocks, jnp.int32))
    step = cramped.step(state, jnp.asarray(life.actions[3]))
    done = clocks == MAX_STEPS - 1
    np.testing.assert_array_equal(step.done, done)
    np.testing.assert_array_equal(step.state.clock, np.where(done, 0, clocks + 1))
    np.testing.assert_array_equal(step.state.episode, done)
    np.testing.assert_array_equal(np.asarray(step.state.record)[~done], np.asarray(step.final)[~done])
    # Auto-reset leads to the start of the second episode, whenever it comes.
    np.testing.assert_array_equal(
        np.asarray(step.state.record)[done], np.asarray(life.steps[MAX_STEPS - 1].state.record)[done]
    )


# Keys


def assert_equal_lives(found: Sequence, expected: Sequence, which: slice) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours.final, np.asarray(theirs.final)[which])
        np.testing.assert_array_equal(ours.state.record, np.asarray(theirs.state.record)[which])
        np.testing.assert_array_equal(
            jax.random.key_data(ours.state.key), np.asarray(jax.random.key_data(theirs.state.key))[which]
        )


@pytest.mark.parametrize("number", [0, 1234])
def test_an_environment_alone_equals_one_in_a_batch(cramped, keys, actions, life, number):
    which = slice(number, number + 1)
    alone = live(cramped, keys[which], actions[:, which])
    assert_equal_lives(alone.steps, life.steps, which)


def test_the_position_in_the_batch_and_the_others_do_not_matter(cramped, keys, actions, life):
    others = some_keys(2)
    mixed = jnp.concatenate([others[: N // 2], keys[: N // 2][::-1]])
    theirs = np.concatenate([actions[:, N // 2 :], actions[:, : N // 2][:, ::-1]], axis=1)
    found = live(cramped, mixed, theirs)
    mine = [jax.tree.map(lambda leaf: leaf[N // 2 :][::-1], step) for step in found.steps]
    assert_equal_lives(mine, life.steps, slice(0, N // 2))


def test_raw_keys_are_the_same_as_typed_ones(cramped, keys):
    np.testing.assert_array_equal(cramped.init(jax.random.key_data(keys)).record, cramped.init(keys).record)


# Recipes


def transitions(compiled: Compiled, seed: int, deliveries: int) -> np.ndarray:
    """(deliveries * N, 2): the recipe before and after each of several correct deliveries, one a step."""
    state, pairs = compiled.init(some_keys(seed)), []
    for _ in range(deliveries):
        state = at_goal(state)
        step = compiled.step(state, jnp.asarray(np.tile(np.array([STAY, INTERACT], np.int32), (N, 1))))
        assert (np.asarray(step.reward) == 20).all()
        assert (fields(CRAMPED, step.final).delivered == 1).all()
        pairs.append([fields(CRAMPED, record).recipe for record in (state.record, step.final)])
        np.testing.assert_array_equal(pairs[-1][1], compiled.env.next_recipe(state))
        state = step.state
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs])


def test_a_correct_delivery_draws_a_recipe_that_may_repeat(cramped):
    pairs = transitions(cramped, seed=3, deliveries=4)
    assert set(np.unique(pairs)) == {3 * ZERO, 3 * ONE}
    assert_uniform(pairs, 4)  # also the pairs of equal ones
    by_environment = pairs[:, 1].reshape(4, N).T
    assert_uniform(by_environment, 16)  # nor does one draw follow from another


def test_without_a_correct_delivery_the_recipe_stays(life):
    for number, (state, step) in enumerate(zip(life.before, life.steps, strict=True)):
        before, after = (fields(CRAMPED, record) for record in (state.record, step.final))
        correct = number % MAX_STEPS == 1
        assert (after.delivered == correct).all()
        changed = (before.recipe != after.recipe).mean()
        assert 0.4 < changed < 0.6 if correct else changed == 0


def test_recipes_of_ones_own_are_drawn_at_the_start_and_after_deliveries():
    four = Compiled.of(Environment(CRAMPED, max_steps=MAX_STEPS, recipes=FOUR_RECIPES))
    np.testing.assert_array_equal(four.env.recipe_items, FOUR_RECIPES)
    np.testing.assert_array_equal(Environment(CRAMPED).recipe_items, [3 * ZERO, 3 * ONE])
    started = fields(CRAMPED, four.init(some_keys(4)).record).recipe
    assert set(np.unique(started)) == set(FOUR_RECIPES.tolist())
    assert_uniform(started, 4)
    pairs = transitions(four, seed=4, deliveries=MAX_STEPS)  # the last one ends the episode, final shows it still
    assert set(np.unique(pairs)) == set(FOUR_RECIPES.tolist())
    assert_uniform(pairs, 16)


# The rules and observations in JAX compared with NumPy


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(layout, marks=() if name in DEFAULT_LAYOUTS else pytest.mark.slow, id=name)
        for name, layout in LAYOUTS.items()
    ],
)
def in_jax(request: pytest.FixtureRequest):
    """Return a layout, and one jitted step with the observations of the state before it."""
    layout = request.param
    return layout, jax.jit(lambda *inputs: (*rules.step(layout, *inputs), observe_both(layout, inputs[0])))


def random_inputs(layout: Layout, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records, actions and next recipes; mostly interactions, and the first pot's soup is often the recipe's."""
    rng = np.random.default_rng(size)
    records, where = random_records(layout, size, rng), columns(layout)
    soup = records[:, where.pot_items.start]
    records[:, where.recipe] = np.where(soup & COOKED, soup & ~np.uint8(COOKED), records[:, where.recipe])
    actions = np.where(rng.random((size, 2)) < 0.75, INTERACT, rng.integers(0, 6, (size, 2))).astype(np.int32)
    return records, actions, rng.choice(layout.recipe_items, size)


def assert_same_bytes(found: Sequence, expected: Sequence) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
        np.testing.assert_array_equal(np.asarray(ours), np.asarray(theirs))


def test_numpy_and_jax_give_equal_bytes(in_jax):
    layout, jitted = in_jax
    inputs = random_inputs(layout, 3072)
    outcome = rules.step(layout, *inputs)
    ours = (*outcome, observe_both(layout, inputs[0]))
    assert [array.dtype.name for array in ours] == ["uint8", "float32", "float32", "uint8", "uint8"]
    deep_inputs = [array.reshape(64, 48, *array.shape[1:]) for array in inputs]
    assert_same_bytes(jitted(*deep_inputs), [array.reshape(64, 48, *array.shape[1:]) for array in ours])
    everything = 255 if layout.buttons else 255 & ~rules.PRESSED
    assert np.bitwise_or.reduce(outcome.events, axis=None) == everything  # the states cover every event
