"""Test canonical channels: a layout's channels move to canonical positions, and all other canonical channels are 0."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.channels import (
    CANONICAL_CHANNELS,
    canonical_positions,
    channel_names,
    observation_shape,
    to_canonical,
)
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, get_layout
from icrl4aht_data.overcooked.observe import observe, observe_both
from tests.helpers.layout_params import layout_params
from tests.helpers.states import random_records

each_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)


def to_canonical_by_name(layout: Layout, own: np.ndarray) -> np.ndarray:
    """Return a layout's observations with each channel moved to the canonical position of its name."""
    out = np.zeros((*own.shape[:-1], 46), own.dtype)
    for number, name in enumerate(channel_names(layout)):
        out[..., CANONICAL_CHANNELS.index(name)] = own[..., number]
    return out


@each_layout
def test_channel_names_match_canonical_positions(layout):
    names, places = channel_names(layout), canonical_positions(layout)
    assert len(names) == layout.channels == len(set(names))
    assert names == tuple(CANONICAL_CHANNELS[place] for place in places)
    assert (np.diff(places) > 0).all(), "own channels keep their order"
    assert observation_shape(layout) == layout.obs_shape
    assert observation_shape(layout, canonical=True) == (5, 5, len(CANONICAL_CHANNELS)) == (5, 5, 46)


def test_canonical_channels_are_the_union_over_all_layouts():
    assert set(CANONICAL_CHANNELS) == {name for layout in LAYOUTS.values() for name in channel_names(layout)}
    assert channel_names(get_layout("test_wide")) == CANONICAL_CHANNELS
    assert CANONICAL_CHANNELS[:8] == (
        "self_position", "self_facing_up", "self_facing_down", "self_facing_right", "self_facing_left",
        "self_plate", "self_cooked", "self_ingredient_0",
    )  # fmt: skip


def test_canonical_positions_refuses_unknown_channels():
    layout = Layout("mine", "mine_too", ("W5W2W", "0A AW", "WWXWW"), recipes=((0, 2, 5),))
    with pytest.raises(OptionError, match=r"layout mine: channels \['self_ingredient_4', .* are not among the 46"):
        canonical_positions(layout)


@each_layout
def test_canonical_observations_equal_channels_moved_by_name(layout):
    records = random_records(layout, 200, np.random.default_rng(5))
    for agent in (0, 1):
        expected = to_canonical_by_name(layout, observe(layout, records, agent))
        assert expected.any()
        np.testing.assert_array_equal(to_canonical(layout, observe(layout, records, agent)), expected, strict=True)
        np.testing.assert_array_equal(observe(layout, records, agent, canonical=True), expected, strict=True)
        np.testing.assert_array_equal(observe_both(layout, records, canonical=True)[:, agent], expected, strict=True)


@pytest.mark.parametrize("name", layout_params(["test_wide", "coord_ring", "cramped_up"]))
@pytest.mark.parametrize("agent", [0, 1])
def test_compiled_canonical_observations_equal_those_of_numpy(name, agent):
    layout = get_layout(name)
    records = random_records(layout, 200, np.random.default_rng(5))
    rendered = jax.jit(partial(observe, layout, agent=agent, canonical=True))(records)
    expected = observe(layout, records, agent, canonical=True)
    np.testing.assert_array_equal(np.asarray(rendered), expected, strict=True)
