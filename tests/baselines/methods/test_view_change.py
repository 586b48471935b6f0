"""Test changed views of an ego: mirrored layouts and hidden recipe indicators."""

from __future__ import annotations

import dataclasses
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.methods.view_change import ViewChange, changed_view, no_change, number_layouts

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import EGO, INTERACT
from icrl4aht_data.overcooked.cells import FACINGS
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import initial_record, record_size

LAYOUT = get_layout("cramped_up")
MIRRORINGS = list(product((False, True), repeat=2))
"""All pairs of flags: whether the order of rows is reversed, and whether the order of columns is."""


def mirrored_layout(layout: Layout, rows: bool, columns: bool) -> Layout:
    kept = layout.rows[::-1] if rows else layout.rows
    return dataclasses.replace(layout, name="mirrored", rows=tuple(r[::-1] if columns else r for r in kept))


def mirrored_cells(layout: Layout, cells: np.ndarray, rows: bool, columns: bool) -> np.ndarray:
    y, x = np.divmod(cells, layout.width)
    y, x = (layout.height - 1 - y if rows else y), (layout.width - 1 - x if columns else x)
    return (y * layout.width + x).astype(np.uint8)


def mirrored_facings(facings: np.ndarray, rows: bool, columns: bool) -> np.ndarray:
    swapped = {"up": "down", "down": "up"} if rows else {}
    swapped |= {"left": "right", "right": "left"} if columns else {}
    return np.array([FACINGS.index(swapped.get(name, name)) for name in FACINGS], np.uint8)[facings]


def view_change(rows: bool, columns: bool, hidden: bool = False) -> ViewChange:
    return ViewChange(*(jnp.asarray(flag) for flag in (hidden, rows, columns)))


@pytest.mark.parametrize(("rows", "columns"), MIRRORINGS)
def test_mirrored_views_equal_views_on_the_mirrored_layout(rows, columns):
    """Play a layout and its mirrored version from corresponding states, with actions and mirrored actions."""
    rng, other = np.random.default_rng(0), mirrored_layout(LAYOUT, rows, columns)
    free = np.flatnonzero(LAYOUT.walkable)
    positions = rng.choice(free, (64, 2)).astype(np.uint8)
    positions = positions[positions[:, 0] != positions[:, 1]]
    facings = rng.integers(4, size=positions.shape).astype(np.uint8)
    recipe = rng.choice(LAYOUT.recipe_items, len(positions)).astype(np.uint8)
    one = initial_record(LAYOUT, positions, facings, recipe)
    two = initial_record(
        other, mirrored_cells(LAYOUT, positions, rows, columns), mirrored_facings(facings, rows, columns), recipe
    )
    view, seen = view_change(rows, columns), 0
    for _ in range(60):
        expected = observe(other, two, EGO, canonical=True)
        np.testing.assert_array_equal(
            view.observations(jnp.asarray(observe(LAYOUT, one, EGO, canonical=True))), expected
        )
        seen += int(expected[..., CANONICAL_CHANNELS.index("item_ingredient_0")].sum())
        actions = rng.choice([0, 1, 2, 3, INTERACT, INTERACT], (len(one), 2))
        mirrored = np.asarray(view.actions(jnp.asarray(actions)))
        one = rules.step(LAYOUT, one, actions, recipe).state
        two = rules.step(other, two, mirrored, recipe).state
    assert seen > 0  # an item was visible at some step


def test_hidden_recipe_indicator_looks_like_a_counter():
    """asymm_right equals asymm_both without the recipe indicator in the ego's part of the layout."""
    both, right = get_layout("asymm_both"), get_layout("asymm_right")
    positions = np.array([[both.agent_cells[0], both.agent_cells[1]]], np.uint8)
    facings, recipe = np.zeros((1, 2), np.uint8), both.recipe_items[:1]
    shown, without = (
        jnp.asarray(observe(layout, initial_record(layout, positions, facings, recipe), EGO, canonical=True))
        for layout in (both, right)
    )
    assert not np.array_equal(shown, without)
    np.testing.assert_array_equal(view_change(False, False, hidden=True).observations(shown), without)
    np.testing.assert_array_equal(no_change().observations(shown), shown)


def test_layout_numbers_of_a_batch_determine_how_views_are_changed():
    """The layout number of a row encodes both the layout and how the view is mirrored."""
    layouts = [get_layout("asymm_both"), LAYOUT]
    size = max(record_size(layout) for layout in layouts)
    records = np.zeros((4, 2, size), np.uint8)
    for row, layout in enumerate((layouts[0], layouts[1], layouts[1], layouts[0])):
        positions = np.array([layout.agent_cells], np.uint8)
        record = initial_record(layout, positions, np.zeros((1, 2), np.uint8), layout.recipe_items[:1])
        records[row, :, : record.shape[-1]] = record
    numbers = np.array([0, 1, 1 + 2 * 3, 0 + 2 * 1], np.int32)
    seen: Any = jax.jit(changed_view(layouts, hidden=["asymm_both"]))(jnp.asarray(records), numbers)
    plain: Any = jax.jit(changed_view(layouts))(jnp.asarray(records), numbers % 2)
    expected = [view_change(False, False, True), no_change(), view_change(True, True), view_change(True, False, True)]
    for row, view in enumerate(expected):
        np.testing.assert_array_equal(seen[row], view.observations(plain[row]))
    assert len({np.asarray(obs[0]).tobytes() for obs in seen}) == 4


def test_mirrored_batches_have_mirrored_actions():
    """Mirroring a batch also mirrors its actions; the number in `layouts` encodes how each window is mirrored."""
    dataset = load_icrl4aht(layout=["asymm_both", "demo_wide"], split="train", obs="state", channels="canonical")
    layouts = [*reversed(dataset.layouts)]
    sampler = dataset.ad(batch_size=64, length=40, seed=3, labels="expert", teammate_actions=True)
    plain, mirrored = (number_layouts(sampler, layouts, mirror).batch(5) for mirror in (False, True))
    mirroring, number = np.divmod(mirrored.layouts, len(layouts))
    np.testing.assert_array_equal(number, plain.layouts)
    assert set(mirroring) == {0, 1, 2, 3}
    np.testing.assert_array_equal(mirrored.obs, plain.obs)  # the view mirrors observations, not state records
    view = ViewChange(*(jnp.asarray(flag)[:, None] for flag in (mirroring < 0, mirroring % 2 > 0, mirroring > 1)))
    np.testing.assert_array_equal(mirrored.target_actions, view.actions(plain.target_actions.astype(np.int32)))
    assert mirrored.target_actions.dtype == plain.target_actions.dtype
    first = plain.is_first | ~plain.attention_mask
    np.testing.assert_array_equal(mirrored.prev_actions[first], 0)
    expected = np.asarray(view.actions(plain.prev_teammate_actions))
    np.testing.assert_array_equal(mirrored.prev_teammate_actions[~first], expected[~first])
    again = number_layouts(sampler, layouts, True).batch(5)
    np.testing.assert_array_equal(again.layouts, mirrored.layouts)
