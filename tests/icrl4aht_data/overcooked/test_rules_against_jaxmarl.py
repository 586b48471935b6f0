"""Test that states, rewards and observations after a step equal those of JaxMARL for equal states and actions."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from benchmarks.peers import jaxmarl_environment
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import columns
from tests.helpers.jaxmarl_peer import TO_JAXMARL_ACTION, from_jaxmarl_state, jaxmarl_step, to_jaxmarl_state
from tests.helpers.states import random_records

BATCH, STEPS, SCENES = 512, 20, 20  # 10,240 steps of trajectories, then 10,240 single steps from random states


DEFAULT = ("coord_ring",)  # a layout with buttons; tests of all other layouts are marked as slow


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param(layout, id=name, marks=[] if name in DEFAULT else pytest.mark.slow)
        for name, layout in LAYOUTS.items()
    ],
)
def test_step_rewards_and_observations_equal_jaxmarl(layout):
    rng = np.random.default_rng(0)
    env = jaxmarl_environment(layout)
    advance = jaxmarl_step(env)
    events = 0
    records = random_records(layout, BATCH, rng)
    for number in range(STEPS + SCENES):
        if number >= STEPS:
            records = random_records(layout, BATCH, rng)
        actions = np.where(rng.random((BATCH, 2)) < 0.5, 5, rng.integers(0, 6, (BATCH, 2)))
        keys = jax.random.split(jax.random.PRNGKey(number), BATCH)
        states = to_jaxmarl_state(layout, env, records)
        observed, after, reward, shaped = advance(keys, states, TO_JAXMARL_ACTION[actions])
        expected = from_jaxmarl_state(layout, after)
        ours = step(layout, records, actions, expected[:, columns(layout).recipe])
        np.testing.assert_array_equal(ours.state, expected)
        np.testing.assert_array_equal(ours.reward, np.asarray(reward))
        np.testing.assert_array_equal(ours.shaped, np.asarray(shaped))
        np.testing.assert_array_equal(observe_both(layout, ours.state), np.asarray(observed))
        events |= int(np.bitwise_or.reduce(ours.events.reshape(-1)))
        records = ours.state
    everything = 255 if layout.buttons else 255 & ~4
    assert events == everything, f"the random states never caused event bits {everything & ~events:b}"
