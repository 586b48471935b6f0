"""Test that `fast_observe` equals the reference implementation `observe`."""

from __future__ import annotations

import numpy as np
import pytest

from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import columns, record_size
from tests.helpers.random_releases import random_history

each_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
each_kind = pytest.mark.parametrize("canonical", [False, True], ids=["own", "canonical"])


@each_layout
@each_kind
@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_fast_observe_equals_observe_on_random_states(layout, canonical, dtype):
    """Compare both functions on random state records, including states that no game reaches."""
    rng = np.random.default_rng(2)
    where = columns(layout)
    states = rng.integers(0, 256, (1000, record_size(layout))).astype(np.uint8)
    states[:, where.positions] = rng.choice(np.flatnonzero(layout.walkable), (1000, 2))
    states[:, where.facings] %= 4
    states[:, where.delivered] %= 2
    states[:, where.pot_timers] %= 32
    states[:, where.recipe] = rng.choice(layout.recipe_items, 1000)
    out = np.full((1000, *observation_shape(layout, canonical)), 9, dtype)
    assert fast_observe(layout, states, out, threads=3, canonical=canonical) is out
    np.testing.assert_array_equal(out, observe(layout, states, 0, canonical))


@each_kind
@pytest.mark.parametrize(
    ("column", "value"), [("positions", 0), ("recipe", 77), ("delivered", 2), ("facings", 4), ("pot_timers", 99)]
)
def test_fast_observe_equals_observe_on_invalid_records(column, value, canonical):
    layout = get_layout("coord_simple")
    states = random_history(layout, 4, 20, np.random.default_rng(3))["state"]
    states[7, getattr(columns(layout), column)] = value
    out = np.empty((len(states), *observation_shape(layout, canonical)), np.float32)
    found = fast_observe(layout, states, out, canonical=canonical)
    np.testing.assert_array_equal(found, observe(layout, states, 0, canonical))


def test_fast_observe_accepts_batch_shapes_and_empty_input():
    layout = get_layout("cramped_up")
    states = random_history(layout, 2, 6, np.random.default_rng(4))["state"].reshape(3, 4, -1)
    out = fast_observe(layout, states, np.empty((3, 4, *layout.obs_shape), np.uint8))
    np.testing.assert_array_equal(out, observe(layout, states, 0))
    assert fast_observe(layout, states[:0], np.empty((0, 4, *layout.obs_shape), np.uint8)).shape[0] == 0
    with pytest.raises(ValueError, match="C-contiguous"):
        fast_observe(layout, states, np.empty((4, 3, *layout.obs_shape), np.uint8).swapaxes(0, 1))
