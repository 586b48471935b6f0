"""Test that an environment with several layouts gives the results of a separate environment for each layout."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.cells import BUTTON, POT, WALL
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.state import columns, padded_columns
from icrl4aht_data.overcooked.tables import make_tables, stack_tables

NAMES = ("cramped_up", "coord_ring", "test_wide", "demo_wide")
"""Layouts of different sizes; in some, agents are separated, or buttons or delivery indicators exist."""

GROUP = [LAYOUTS[name] for name in NAMES]
ENVS, STEPS = 3 * len(NAMES), 30


@pytest.fixture(scope="module")
def recorded_steps() -> dict[str, np.ndarray]:
    """Play two episodes of random actions; return arrays of shape (steps, environments, ...) by name."""
    env = Environment(GROUP, max_steps=STEPS)

    def step(state, key):
        actions = jax.random.randint(key, (ENVS, 2), 0, 6)
        actions = jnp.where(jax.random.uniform(key, actions.shape) < 0.4, 5, actions)  # about half of them interact
        after = env.step(state, actions)
        shown = {
            "record": state.record,
            "actions": actions,
            "obs": env.observe(state, canonical=True),
            "next_recipe": env.next_recipe(state),
            "reward": after.reward,
            "shaped": after.shaped,
            "final": after.final,
            "layout": state.layout,
        }
        return after.state, shown

    run = jax.jit(lambda keys, steps: jax.lax.scan(step, env.init(keys), steps)[1])
    found = run(random_keys(ENVS), jax.random.split(jax.random.key(1), 2 * STEPS))
    return {name: np.asarray(value) for name, value in found.items()}


def random_keys(count: int) -> jax.Array:
    return jax.random.split(jax.random.key(0), count)


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_environment_with_several_layouts_equals_one_environment_per_layout(recorded_steps, number):
    layout, envs = GROUP[number], np.arange(number, ENVS, len(NAMES))
    own = padded_columns(layout, stack_tables(GROUP))
    part = {name: value[:, envs] for name, value in recorded_steps.items()}
    assert (part["layout"] == number).all()
    records, final = part["record"][..., own], part["final"][..., own]
    others = np.setdiff1d(np.arange(part["record"].shape[-1]), own)
    assert not part["record"][..., others].any()  # padded pots and counters stay empty
    for episode in (0, STEPS):
        start = Environment(layout, STEPS).first_record(random_keys(ENVS)[envs], jnp.full(len(envs), episode // STEPS))
        np.testing.assert_array_equal(records[episode], start)
    alone = rules.step(layout, records, part["actions"], part["next_recipe"])
    np.testing.assert_array_equal(final, alone.state)
    np.testing.assert_array_equal(part["reward"], alone.reward)
    np.testing.assert_array_equal(part["shaped"], alone.shaped)
    np.testing.assert_array_equal(part["obs"], observe_both(layout, records, canonical=True))
    assert set(np.unique(part["next_recipe"])) == set(layout.recipe_items)
    assert (records[..., columns(layout).hands] > 0).any()


def test_layouts_are_drawn_uniformly_at_each_reset():
    env = Environment(GROUP, max_steps=1, redraws=True)
    step = jax.jit(lambda state: env.step(state, jnp.full((ENVS, 2), 4)).state)
    states = [jax.jit(env.init)(random_keys(ENVS))]
    for _ in range(30):
        states.append(step(states[-1]))
    numbers = np.array([state.layout for state in states])
    counts = np.bincount(numbers.ravel(), minlength=len(GROUP))
    assert (abs(counts / counts.sum() - 1 / len(GROUP)) < 0.08).all()
    for number, layout in enumerate(GROUP):
        cells = np.array([state.record for state in states])[numbers == number][:, :2]
        assert layout.walkable[cells].all()


def test_padding_does_not_change_the_tables_of_a_layout():
    """Cells that are added as padding are walls, and no agent can face them."""
    stacked = stack_tables(GROUP)
    for number, layout in enumerate(GROUP):
        own = make_tables(layout, stacked.pots.shape[-1], stacked.buttons.shape[-1])
        for table, padded in zip(jax.tree.leaves(own), jax.tree.leaves(stacked), strict=True):
            np.testing.assert_array_equal(padded[number][tuple(map(slice, table.shape))], table)
            assert padded.dtype == table.dtype
        beyond = slice(layout.cells, None)
        assert (stacked.kinds[number, beyond] == WALL).all() and not stacked.walkable[number, beyond].any()
        faced = stacked.faced[number][layout.walkable.nonzero()[0]]
        for kind, cells in ((POT, layout.pots), (BUTTON, layout.buttons), (WALL, layout.counters)):
            assert set((faced[faced & 255 == kind] >> 16).tolist()) <= set(range(len(cells)))


def test_layouts_that_cannot_be_stacked_raise_errors():
    with pytest.raises(OptionError, match="no layouts to stack"):
        stack_tables([])
    odd = Layout("mine", "mine_too", ("W5W2W", "0A AW", "WWXWW"), recipes=((0, 2, 5),))
    with pytest.raises(OptionError, match=r"layouts \['mine'\] have ingredients without a canonical channel"):
        stack_tables([odd, *GROUP])
    with pytest.raises(OptionError, match="has no canonical channel"):
        observe_both(odd, np.zeros((1, 8 + len(odd.counters)), np.uint8), canonical=True)


def test_initial_layouts_can_be_chosen_by_number():
    env = Environment(GROUP, max_steps=STEPS)
    state = jax.jit(env.init)(random_keys(2), jnp.array([3, 1]))
    assert state.layout is not None and state.layout.tolist() == [3, 1]
    assert all(GROUP[number].walkable[cells].all() for number, cells in zip([3, 1], state.record[:, :2], strict=True))
