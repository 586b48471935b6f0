"""Test that encoders give the same results for observations and for their compact forms."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners.encoder import CompactView, WindowEncoder, WindowEntries, WordWindow

from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import columns
from tests.helpers.states import random_records

LAYOUT = get_layout("demo_wide")
RECORDS = random_records(LAYOUT, 60, np.random.default_rng(0)).reshape(3, 20, -1)

TOLERANCE = 1e-12
"""Tolerance relative to the largest value, for float64 sums in different orders; the largest error seen was 8e-16.

In float32, a layer norm of few active features magnifies rounding so much that it would hide wrong sums.
"""


def encoder(kind, view: CompactView | None = None) -> WindowEncoder:
    return WindowEncoder(12, kind, pointwise=(10, 6), spatial=(5,), normalize=True, view=view)


def gradient_and_features(module: WindowEncoder) -> Any:
    """Return a function that computes the gradient of the features' weighted sum, and the features themselves."""

    def weighted_sum(params, seen):
        features: Any = module.apply(params, seen)
        return jnp.vdot(features, jnp.arange(features.size, dtype=features.dtype).reshape(features.shape)), features

    return jax.jit(jax.grad(weighted_sum, has_aux=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["words", "mlp"])
def test_compact_inputs_give_the_features_and_gradients_of_observations(kind):
    obs = jnp.asarray(observe(LAYOUT, RECORDS, 0))
    view = CompactView(kind, (LAYOUT,))
    seen = view(jnp.asarray(RECORDS))
    assert isinstance(seen, WordWindow if kind == "words" else WindowEntries)
    plain, compact = encoder("paper" if kind == "words" else kind, view), encoder(kind, view)
    params = plain.init(jax.random.key(1), obs)
    own = compact.init(jax.random.key(1), seen)
    jax.tree.map(np.testing.assert_array_equal, params, own)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda values: values.astype(jnp.float64), params)
        expected_gradient, expected = gradient_and_features(plain)(params, obs)
        gradient, features = gradient_and_features(compact)(params, seen)
        again: Any = jax.jit(compact.apply)(params, obs)  # the encoder also accepts observations
    assert features.shape == (3, 20, 12) and features.dtype == jnp.float64
    found, wanted = (
        jax.tree.leaves((features, gradient, again)),
        jax.tree.leaves((expected, expected_gradient, expected)),
    )
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=TOLERANCE * np.abs(other).max())


def test_only_entries_that_can_differ_from_0_have_nonzero_initial_weights():
    """The encoder's initial weights are 0 for observation entries that are always 0 on its layout."""
    obs, view = jnp.asarray(observe(LAYOUT, RECORDS, 0)), CompactView("mlp", (LAYOUT,))
    kernels = {}
    for name, module, seen in (
        ("plain", encoder("mlp"), obs),
        ("view", encoder("mlp", view), obs),
        ("compact", encoder("mlp", view), view(jnp.asarray(RECORDS))),
    ):
        params: Any = module.init(jax.random.key(1), seen)
        kernels[name] = np.asarray(params["params"]["FlatDense_0"]["kernel"])
    expected = np.zeros_like(kernels["plain"])
    expected[view.entries] = kernels["plain"][view.entries]
    assert 0 < len(view.entries) < len(expected)
    np.testing.assert_array_equal(kernels["view"], expected)
    np.testing.assert_array_equal(kernels["compact"], expected)


def test_view_of_both_agents_has_more_entries_than_view_of_the_ego():
    """On demo_wide the agents are in separate rooms, so some observation entries are nonzero only for the teammate."""
    ego, both = (CompactView("mlp", (LAYOUT,), agents) for agents in ((0,), (0, 1)))
    assert len(ego.entries) < len(both.entries)
    assert set(ego.entries) <= set(both.entries)


def test_invalid_state_records_give_nan_features():
    view, broken = CompactView("words", (LAYOUT,)), RECORDS.copy()
    broken[1, 4, columns(LAYOUT).hands] = 255
    module = encoder("words", view)
    params = jax.jit(module.init)(jax.random.key(1), view(jnp.asarray(RECORDS)))
    wrong = np.isnan(np.asarray(jax.jit(module.apply)(params, view(jnp.asarray(broken))))).any(axis=-1)
    assert np.argwhere(wrong).tolist() == [[1, 4]]
