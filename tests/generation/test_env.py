"""Test the JAX environment: episode starts and ends, random keys, recipes, and agreement with the NumPy rules."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.experts.padded import padded_layout
from icrl4aht_generation.layouts.rearranged import with_four_recipes

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import INTERACT, STAY
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.state import State, columns, record_size, unpack
from tests.helpers.states import random_records, state_record

CRAMPED = LAYOUTS["cramped_up"]
PLATE, COOKED, ZERO, ONE = 1, 2, 4, 16  # item bytes; ZERO is a piece of ingredient 0, ONE is a piece of ingredient 1
FOUR_RECIPES = np.array([3 * ZERO, 2 * ZERO + ONE, ZERO + 2 * ONE, 3 * ONE], np.uint8)

N, MAX_STEPS, STEPS = 2000, 5, 13  # N environments in one batch

FLOOR = {  # floor cells (x, y) that the ego and the teammate can reach, read off the maps
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


class CompiledEnv(NamedTuple):
    """An environment with its functions `init` and `step`, each jitted once."""

    env: Environment
    init: jax.stages.Wrapped
    step: jax.stages.Wrapped

    @classmethod
    def jit(cls, env: Environment) -> CompiledEnv:
        return cls(env, jax.jit(env.init), jax.jit(env.step))


@pytest.fixture(scope="module")
def cramped() -> CompiledEnv:
    return CompiledEnv.jit(Environment(CRAMPED, max_steps=MAX_STEPS))


def some_keys(number: int) -> jax.Array:
    return jax.random.split(jax.random.key(number), N)


def move_to_goal(state: EnvState) -> EnvState:
    """Return environments on cramped_up in which the teammate faces the goal with a dish of the current recipe."""
    where, recipes = columns(CRAMPED), fields(CRAMPED, state.record).recipe
    records = np.repeat(state_record(CRAMPED, (1, 1, "up"), (3, 2, "down")), len(recipes), axis=0)
    records[:, where.recipe] = recipes
    records[:, where.hands.start + 1] = recipes | (PLATE | COOKED)
    return state._replace(record=jnp.asarray(records))


class StepBatch(NamedTuple):
    """Steps of a batch of environments: states before each step, results and actions."""

    before: list[EnvState]
    steps: list
    actions: np.ndarray  # shape (STEPS, N, 2)


def step_batch(compiled: CompiledEnv, keys: jax.Array, actions: np.ndarray) -> StepBatch:
    """Step through two episodes into a third; in the second step of each episode, every teammate delivers."""
    state, before, steps = compiled.init(keys), [], []
    actions = actions.copy()
    for number in range(len(actions)):
        if number % MAX_STEPS == 1:
            state = move_to_goal(state)
            actions[number] = STAY, INTERACT
        before.append(state)
        steps.append(compiled.step(state, jnp.asarray(actions[number])))
        state = steps[-1].state
    return StepBatch(before, steps, actions)


@pytest.fixture(scope="module")
def keys() -> jax.Array:
    return some_keys(0)


@pytest.fixture(scope="module")
def actions() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 6, (STEPS, N, 2)).astype(np.int32)


@pytest.fixture(scope="module")
def batch_steps(cramped, keys, actions) -> StepBatch:
    return step_batch(cramped, keys, actions)


def fields(layout: Layout, record: jax.Array) -> State:
    return unpack(layout, np.asarray(record))


def assert_uniform(values: Sequence | np.ndarray, possible: int) -> None:
    """Assert that `possible` values occur equally often: chi-square is below its mean plus six standard deviations."""
    found, counts = np.unique(np.asarray(values), axis=0, return_counts=True)
    assert len(found) == possible
    expected = counts.sum() / possible
    assert expected >= 30
    freedom = possible - 1
    assert ((counts - expected) ** 2 / expected).sum() < freedom + 6 * np.sqrt(2 * freedom)


@pytest.mark.parametrize("name", FLOOR)
def test_start_positions_facings_and_recipes_are_uniform(name):
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
    assert_uniform(state.positions, pairs)  # the agents never share a cell
    assert_uniform(np.concatenate([state.facings, state.recipe[:, None]], axis=1), 4 * 4 * 2)
    assert set(np.unique(state.recipe)) == {3 * ZERO, 3 * ONE}
    assert not records[:, columns(layout).hands].any()
    assert not records[:, columns(layout).delivered :].any()


def test_episodes_end_exactly_after_max_steps(batch_steps):
    done = np.stack([np.asarray(step.done) for step in batch_steps.steps])
    ends = [False, False, False, False, True]
    np.testing.assert_array_equal(done, np.array([*ends, *ends, *ends[:3]])[:, None].repeat(N, axis=1))
    clocks = np.stack([np.asarray(step.state.clock) for step in batch_steps.steps])
    episodes = np.stack([np.asarray(step.state.episode) for step in batch_steps.steps])
    assert (clocks == np.array([1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1, 2, 3])[:, None]).all()
    assert (episodes == np.array([0] * 4 + [1] * 5 + [2] * 4)[:, None]).all()


def test_final_state_follows_the_rules_even_if_the_episode_ends(batch_steps):
    for state, step, actions in zip(batch_steps.before, batch_steps.steps, batch_steps.actions, strict=True):
        recipes = np.asarray(step.final)[:, columns(CRAMPED).recipe]  # recipes drawn by the environment
        expected = rules.step(CRAMPED, np.asarray(state.record), actions, recipes)
        np.testing.assert_array_equal(step.final, expected.state)
        np.testing.assert_array_equal(step.reward, expected.reward)
        np.testing.assert_array_equal(step.shaped, expected.shaped)
        if not np.asarray(step.done).any():
            np.testing.assert_array_equal(step.state.record, step.final)


def test_only_environments_with_ended_episodes_restart(cramped, batch_steps):
    """Environments in one batch restart when their own episode ends."""
    clocks = np.arange(N) % MAX_STEPS
    state = batch_steps.steps[2].state._replace(clock=jnp.asarray(clocks, jnp.int32))
    step = cramped.step(state, jnp.asarray(batch_steps.actions[3]))
    done = clocks == MAX_STEPS - 1
    np.testing.assert_array_equal(step.done, done)
    np.testing.assert_array_equal(step.state.clock, np.where(done, 0, clocks + 1))
    np.testing.assert_array_equal(step.state.episode, done)
    np.testing.assert_array_equal(np.asarray(step.state.record)[~done], np.asarray(step.final)[~done])
    # The start of the second episode does not depend on when the first one ends.
    np.testing.assert_array_equal(
        np.asarray(step.state.record)[done], np.asarray(batch_steps.steps[MAX_STEPS - 1].state.record)[done]
    )


def test_results_of_an_environment_do_not_depend_on_its_batch(cramped, keys, actions, batch_steps):
    """Two environments of the batch repeat their steps in a batch of two and get the same results."""
    which = np.array([1234, 0])
    found = step_batch(cramped, keys[which], actions[:, which])
    for ours, theirs in zip(found.steps, batch_steps.steps, strict=True):
        np.testing.assert_array_equal(ours.final, np.asarray(theirs.final)[which])
        np.testing.assert_array_equal(ours.state.record, np.asarray(theirs.state.record)[which])
        assert (ours.state.key == theirs.state.key[which]).all()


def test_raw_random_keys_give_the_results_of_typed_keys(cramped, keys):
    np.testing.assert_array_equal(cramped.init(jax.random.key_data(keys)).record, cramped.init(keys).record)


def recipe_transitions(compiled: CompiledEnv, seed: int, deliveries: int) -> np.ndarray:
    """Deliver in every step; return recipes before and after each correct delivery, of shape (deliveries * N, 2)."""
    state, pairs = compiled.init(some_keys(seed)), []
    for _ in range(deliveries):
        state = move_to_goal(state)
        step = compiled.step(state, jnp.asarray(np.tile(np.array([STAY, INTERACT], np.int32), (N, 1))))
        assert (np.asarray(step.reward) == 20).all()
        assert (fields(CRAMPED, step.final).delivered == 1).all()
        pairs.append([fields(CRAMPED, record).recipe for record in (state.record, step.final)])
        np.testing.assert_array_equal(pairs[-1][1], compiled.env.next_recipe(state))
        state = step.state
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs])


def test_correct_delivery_draws_a_uniform_next_recipe(cramped):
    pairs = recipe_transitions(cramped, seed=3, deliveries=4)
    assert set(np.unique(pairs)) == {3 * ZERO, 3 * ONE}
    assert_uniform(pairs, 4)  # the next recipe may equal the previous one
    by_environment = pairs[:, 1].reshape(4, N).T
    assert_uniform(by_environment, 16)  # successive recipes are independent


def test_recipe_changes_only_after_correct_deliveries(batch_steps):
    for number, (state, step) in enumerate(zip(batch_steps.before, batch_steps.steps, strict=True)):
        before, after = (fields(CRAMPED, record) for record in (state.record, step.final))
        correct = number % MAX_STEPS == 1
        assert (after.delivered == correct).all()
        changed = (before.recipe != after.recipe).mean()
        assert 0.4 < changed < 0.6 if correct else changed == 0


def test_four_recipes_are_drawn_uniformly_at_starts_and_after_deliveries():
    four = CompiledEnv.jit(Environment(with_four_recipes(CRAMPED), max_steps=MAX_STEPS))
    np.testing.assert_array_equal(four.env.tables.recipes, FOUR_RECIPES)
    started = fields(CRAMPED, four.init(some_keys(4)).record).recipe
    assert set(np.unique(started)) == set(FOUR_RECIPES.tolist())
    assert_uniform(started, 4)
    pairs = recipe_transitions(four, seed=4, deliveries=MAX_STEPS)  # the last delivery ends the episode
    assert set(np.unique(pairs)) == set(FOUR_RECIPES.tolist())
    assert_uniform(pairs, 16)


def random_inputs(layout: Layout, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random records, actions (mostly `interact`) and next recipes; soups often match the recipe."""
    rng = np.random.default_rng(size)
    records, where = random_records(layout, size, rng), columns(layout)
    soup = records[:, where.pot_items.start]
    records[:, where.recipe] = np.where(soup & COOKED, soup & ~np.uint8(COOKED), records[:, where.recipe])
    actions = np.where(rng.random((size, 2)) < 0.75, INTERACT, rng.integers(0, 6, (size, 2))).astype(np.int32)
    return records, actions, rng.choice(layout.recipe_items, size)


@pytest.fixture(scope="module")
def jitted_rules() -> jax.stages.Wrapped:
    """Return a compiled function that observes a state of any layout and then computes one step."""
    return jax.jit(lambda tables, *inputs: (*rules.step(tables, *inputs), observe_both(tables, inputs[0])))


@pytest.mark.parametrize("name", LAYOUTS)
def test_rules_and_observations_are_equal_in_numpy_and_jax(jitted_rules, name):
    layout = LAYOUTS[name]
    inputs = random_inputs(layout, 3072)
    outcome = rules.step(layout, *inputs)
    ours = (*outcome, observe_both(layout, inputs[0]))
    assert [array.dtype.name for array in ours] == ["uint8", "float32", "float32", "uint8", "uint8"]
    tables, _, positions = padded_layout(layout)
    records, *deep_inputs = (array.reshape(64, 48, *array.shape[1:]) for array in inputs)
    padded = np.zeros((64, 48, record_size(tables)), np.uint8)
    padded[..., positions] = records
    state, *others, observations = jitted_rules(tables, padded, *deep_inputs)
    found = (state[..., positions], *others, observations[..., : layout.channels])
    for theirs, expected in zip(found, ours, strict=True):
        np.testing.assert_array_equal(theirs, expected.reshape(64, 48, *expected.shape[1:]), strict=True)
    everything = 255 if layout.buttons else 255 & ~rules.PRESSED
    assert np.bitwise_or.reduce(outcome.events, axis=None) == everything  # every event occurs
