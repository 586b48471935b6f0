"""Test `cell_words`, which encodes each visible cell as an integer, against the channels that `observe` returns."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest

from icrl4aht_data.overcooked.cells import CENTRE, VISIBLE
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, get_layout, with_recipes
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import columns, record_size
from icrl4aht_data.overcooked.words import cell_words
from tests.helpers.layout_params import layout_params
from tests.helpers.random_releases import random_history
from tests.helpers.states import random_records

each_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)


def example_records(layout: Layout) -> np.ndarray:
    """Return state records of shape (800, S), uint8: half from random play, half drawn from all valid states."""
    rng = np.random.default_rng(5)
    return np.concatenate([random_history(layout, 4, 100, rng)["state"], random_records(layout, 400, rng)])


@each_layout
@pytest.mark.parametrize("agent", [0, 1])
def test_channels_of_words_equal_the_observation(layout, agent):
    records, words = example_records(layout), cell_words((layout,))
    expected = observe(layout, records, agent)
    ids = words.ids(records, agent=agent)
    assert ids.dtype == np.int32
    np.testing.assert_array_equal(words.channels[ids].reshape(expected.shape), expected)


@pytest.mark.parametrize("name", layout_params(["test_wide", "cramped_up"]))
@pytest.mark.parametrize("agent", [0, 1])
def test_compiled_words_equal_those_of_numpy(name, agent):
    records, words = example_records(get_layout(name)), cell_words((get_layout(name),))
    np.testing.assert_array_equal(jax.jit(partial(words.ids, agent=agent))(records), words.ids(records, agent=agent))


@each_layout
def test_word_entries_include_every_nonzero_entry_of_observations(layout):
    records, words = example_records(layout), cell_words((layout,))
    seen = [np.flatnonzero(observe(layout, records, agent).reshape(len(records), -1).any(axis=0)) for agent in (0, 1)]
    assert np.isin(seen[0], words.entries((0,))).all()
    assert np.isin(seen[1], words.entries((1,))).all()
    np.testing.assert_array_equal(words.entries((0, 1)), np.union1d(words.entries((0,)), words.entries((1,))))
    one_recipe = cell_words((with_recipes(layout, layout.recipes[:1]),))
    np.testing.assert_array_equal(one_recipe.entries(), words.entries(), "the entries do not depend on the recipes")
    # model encoders skip the remaining entries of observations, which are always zero
    assert len(words.entries((0,))) < VISIBLE * layout.channels / 2


@pytest.mark.parametrize("canonical", [False, True], ids=["own", "canonical"])
def test_cell_words_of_several_layouts_in_one_batch_give_the_observations(canonical):
    """Mix four layouts with equal channels, or all layouts with canonical channels."""
    names = LAYOUTS if canonical else ("asymm_both", "cramped_up", "asymm_right", "cramped_down")
    layouts = tuple(map(get_layout, names))
    words, size = cell_words(layouts, canonical), max(map(record_size, layouts))
    number = np.array([2, *range(len(layouts))[::-1]])
    mixed = np.zeros((len(number), 40, size), np.uint8)
    expected = np.zeros((len(number), 40, *observation_shape(layouts[0], canonical)), np.uint8)
    for row, layout in enumerate(layouts[n] for n in number):
        records = example_records(layout)[::20]
        mixed[row, :, : records.shape[-1]], expected[row] = records, observe(layout, records, 0, canonical)
    ids = words.ids(mixed, number)
    np.testing.assert_array_equal(words.channels[ids].reshape(expected.shape), expected)
    np.testing.assert_array_equal(jax.jit(words.ids)(mixed, number), ids)
    seen = np.flatnonzero(expected.reshape(-1, VISIBLE * expected.shape[-1]).any(axis=0))
    assert np.isin(seen, words.entries()).all()
    assert len(words.channels) < 700


@pytest.mark.parametrize(("column", "value"), [("pot_timers", 31), ("pot_items", 255), ("hands", 255)])
def test_impossible_contents_map_to_the_last_word(column, value):
    layout = get_layout("cramped_up")
    records, words = example_records(layout), cell_words((layout,))
    records[:, getattr(columns(layout), column)] = value
    ids = words.ids(records)
    impossible = len(words.channels) - 1
    assert (ids == impossible).any(axis=-1).mean() > 0.5
    assert (words.channels[impossible] == 255).all()
    if column == "hands":
        assert (ids[:, CENTRE] == impossible).all()
