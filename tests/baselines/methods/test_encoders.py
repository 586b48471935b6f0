"""Test that the encoders `words` and `mlp` give equal results on state records and on observations."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import batch_steps, plain_view
from icrl4aht_generation.learners import encoder
from icrl4aht_generation.learners.encoder import CompactView, GroupedWords

from icrl4aht_data import get_layout, load_icrl4aht
from tests.helpers.random_releases import random_release
from tests.helpers.small_models import TINY, random_parameters

OPTIONS = dataclasses.replace(TINY, layers=1, dropout=0.0)


@pytest.fixture(scope="module")
def two_layouts(tmp_path_factory) -> Path:
    """Return a release of two layouts whose observations have the same shape."""
    root = tmp_path_factory.mktemp("releases") / "two"
    random_release(root, layouts=("asymm_both", "cramped_up"))
    return root


def make_method(kind: Any, view: Any = None) -> Method:
    return get_method("ad")(
        dataclasses.replace(OPTIONS, encoder=kind), overcooked_world([get_layout("demo_wide")], kind, view)
    )


def load_batch(root: Path, obs: Any) -> Any:
    dataset = load_icrl4aht(root, layout="demo_wide", obs=obs)
    return dataset.ad(length=9, batch_size=3, teammate_actions=True)[2]


def loss_and_gradient(method: Method, params: Any, batch: Any) -> Any:
    return jax.jit(jax.value_and_grad(lambda p: method.loss(p, params, batch, None), has_aux=True))(params)


def test_words_encoder_has_the_loss_and_gradient_of_the_paper_encoder(lite):
    """The paper's encoder receives observations; the encoder `words` receives state records.

    The tolerance of each parameter's gradient is relative to the largest entry of this gradient.
    """
    paper, words = make_method("paper", plain_view), make_method("words")
    params = random_parameters(paper)
    jax.tree.map(np.testing.assert_array_equal, params, random_parameters(words))
    (loss, log), gradient = loss_and_gradient(words, params, load_batch(lite[0], "state"))
    (expected_loss, expected_log), expected = loss_and_gradient(paper, params, load_batch(lite[0], "uint8"))
    assert 0 < log["distinct_observations"] < 1
    np.testing.assert_allclose(loss, expected_loss, rtol=1e-5)
    for number in log.keys() & expected_log.keys():
        np.testing.assert_allclose(log[number], expected_log[number], rtol=1e-4, err_msg=number)
    for leaf, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(leaf, other, rtol=1e-3, atol=2e-5 * np.abs(other).max())


@pytest.mark.parametrize("collide", [False, True])
def test_equal_observations_are_grouped_unless_hashes_collide(monkeypatch, collide):
    """If hashes collide, each observation forms a group by itself."""
    if collide:
        monkeypatch.setattr(encoder, "_hash_words", lambda ids: (jnp.zeros(len(ids), jnp.uint32),) * 2)
    ids = np.random.default_rng(0).integers(0, 300, (4, 25))[[[0, 1, 0, 2], [1, 1, 3, 0]]]
    grouped: Any = encoder.group_equal(encoder.WordWindow(jnp.asarray(ids, jnp.int32)))
    count = int(grouped.groups)
    assert count == (8 if collide else 4)
    assert encoder.encoding_metrics(grouped)["distinct_observations"] == count / 8
    assert sorted(set(grouped.group.ravel().tolist())) == list(range(count))
    np.testing.assert_array_equal(ids.reshape(8, 25)[grouped.first[grouped.group]], ids)


@pytest.mark.parametrize("canonical", [False, True])
@pytest.mark.parametrize("kind", ["paper", "words", "mlp"])
def test_observations_computed_from_states_equal_stored_observations(two_layouts, kind, canonical):
    layouts = tuple(get_layout(name) for name in ("asymm_both", "cramped_up"))
    view = CompactView(kind, layouts, canonical=canonical)
    channels = "canonical" if canonical else "own"
    shown, states = (
        load_icrl4aht(two_layouts, layout=[layout.name for layout in layouts], obs=obs, channels=channels)
        .ad(batch_size=8, length=5)[0]
        for obs in ("uint8", "state")
    )  # fmt: skip
    assert set(np.asarray(states.layouts).tolist()) == {0, 1}
    steps = batch_steps(jax.tree.map(jnp.asarray, states), view)
    assert isinstance(steps.obs, GroupedWords) == (kind == "words")
    np.testing.assert_array_equal(view.observations(steps.obs), shown.obs)
