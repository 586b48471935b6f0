"""Test that the network has the outputs and gradients of a reference network made of Flax's layers."""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic

STEPS, ENVS, CHANNELS = 4, 3, 40

TOLERANCE = 1e-5
"""Tolerance relative to the largest value. The networks add the same float32 products in different orders, so each
layer differs by a few epsilons (1.2e-7); over all layers and four steps, the largest error seen was 1.3e-6.
A wrong weight or gate would give errors as large as the values."""


class PlainActorCritic(nn.Module):
    """The network of the paper (App. B.1 and C.2.1), made of Flax's layers and a Python loop over time."""

    widths: Widths

    @nn.compact
    def __call__(self, hidden, obs, reset):
        widths = self.widths
        x = obs.astype(jnp.float32)
        for i, width in enumerate(widths.pointwise):
            x = nn.relu(nn.Conv(width, (1, 1), name=f"pointwise_{i}")(x))
        for i, width in enumerate(widths.spatial):
            x = nn.relu(nn.Conv(width, (3, 3), padding="SAME", name=f"spatial_{i}")(x))
        x = nn.relu(nn.Dense(widths.dense, name="dense")(x.reshape(*x.shape[:2], -1)))
        x = nn.LayerNorm(name="norm")(x)
        cell, states = nn.GRUCell(widths.gru, name="gru"), []
        for t in range(obs.shape[0]):
            hidden, state = cell(hidden * ~reset[t][:, None], x[t])
            states.append(state)
        x = jnp.stack(states)
        logits = nn.Dense(6, name="actor")(nn.relu(nn.Dense(widths.head, name="actor_hidden")(x)))
        value = nn.Dense(1, name="critic")(nn.relu(nn.Dense(widths.head, name="critic_hidden")(x)))
        return hidden, logits, value[..., 0]


def plain_params(params: Any, widths: Widths) -> dict[str, Any]:
    """Return parameters or gradients under the parameter names of `PlainActorCritic`."""
    tree = jax.tree.map(np.asarray, params["params"])
    encoder, gru = tree["encoder"], tree["gru"]
    plain: dict[str, Any] = {name: tree[name] for name in ("actor_hidden", "actor", "critic_hidden", "critic")}
    for i in range(len(widths.pointwise)):
        layer = encoder[f"Dense_{i}"]
        plain[f"pointwise_{i}"] = layer | {"kernel": layer["kernel"][None, None]}
    for i in range(len(widths.spatial)):
        plain[f"spatial_{i}"] = encoder[f"Conv3x3_{i}"]
    plain["dense"] = encoder[f"Dense_{len(widths.pointwise)}"]
    plain["norm"] = encoder["LayerNorm_0"]
    kernels = np.split(gru["input"]["kernel"], 3, axis=1)
    biases = np.split(gru["input"]["bias"], 3)
    recurrent = np.split(gru["recurrent"], 3, axis=1)
    plain["gru"] = {
        **{f"i{gate}": {"kernel": kernels[k], "bias": biases[k]} for k, gate in enumerate("rzn")},
        **{f"h{gate}": {"kernel": recurrent[k]} for k, gate in enumerate("rzn")},
    }
    plain["gru"]["hn"]["bias"] = gru["candidate_bias"]
    return {"params": plain}


class Case(NamedTuple):
    network: ActorCritic
    params: Any
    hidden: jax.Array
    obs: jax.Array
    reset: jax.Array


@pytest.fixture(scope="module")
def case() -> Case:
    """Return a small network with unequal widths, random nonzero parameters, and random inputs with three resets."""
    widths = Widths(pointwise=(6, 4), spatial=(3, 5), dense=11, gru=7, head=9)
    network, rng = ActorCritic(widths), np.random.default_rng(1)
    shape = (STEPS, ENVS, 5, 5, CHANNELS)
    obs = jnp.asarray(rng.integers(0, 20, shape, np.uint8) * (rng.random(shape) < 0.15))
    hidden = jnp.asarray(rng.normal(size=(ENVS, widths.gru)), jnp.float32)
    reset = np.zeros((STEPS, ENVS), bool)
    reset[0, 0] = reset[2, 1] = reset[3, 1] = True

    def random_weight(weight) -> jax.Array:
        fan_in = np.prod(weight.shape[:-1]) if len(weight.shape) > 1 else 16
        return jnp.asarray(rng.normal(size=weight.shape) * (2 / fan_in) ** 0.5, jnp.float32)

    params = jax.tree.map(random_weight, jax.eval_shape(network.init, jax.random.key(0), hidden, obs, reset))
    return Case(network, params, hidden, obs, jnp.asarray(reset))


def assert_close(found: Any, expected: Any, what: str = "") -> None:
    """Assert that arrays are equal up to `TOLERANCE` times the largest value."""
    size = np.abs(np.asarray(expected)).max()
    assert size > 0, what
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE * size, err_msg=what)


def test_network_has_the_expected_number_of_parameters():
    params = jax.eval_shape(lambda key: ActorCritic(Widths()).untrained(key, CHANNELS), jax.random.key(0))
    assert sum(w.size for w in jax.tree.leaves(params)) == 273_375


def test_outputs_and_gradients_equal_those_of_the_reference_network(case):
    plain = PlainActorCritic(case.network.widths)
    names = plain_params(case.params, case.network.widths)
    weights = jax.random.normal(jax.random.key(4), (STEPS, ENVS, 7))

    def gradients_and_outputs(network):
        """Return a function that computes the gradients of a weighted sum of the outputs, and the outputs."""

        def weighted_sum(params, hidden):
            outputs = network.apply(params, hidden, case.obs, case.reset)
            last, logits, values = outputs
            return jnp.sum(weights[..., :6] * logits) + jnp.sum(weights[..., 6] * values) + jnp.sum(last), outputs

        return jax.jit(jax.grad(weighted_sum, argnums=(0, 1), has_aux=True))

    (gradient, to_hidden), outputs = gradients_and_outputs(case.network)(case.params, case.hidden)
    (plain_gradient, plain_to_hidden), plain_outputs = gradients_and_outputs(plain)(names, case.hidden)
    for found, expected in zip(outputs, plain_outputs, strict=True):
        assert found.shape == expected.shape
        assert_close(found, expected)
    found = plain_params(gradient, case.network.widths)
    assert jax.tree.structure(found) == jax.tree.structure(plain_gradient)
    for (path, expected), leaf in zip(jax.tree.leaves_with_path(plain_gradient), jax.tree.leaves(found), strict=True):
        assert_close(leaf, expected, jax.tree_util.keystr(path))
    assert_close(to_hidden, plain_to_hidden)


def test_initial_weights_have_the_published_scales(case):
    """Initial kernels are orthogonal with the published scales, and initial biases are zero."""
    init = jax.jit(case.network.init)
    params = init(jax.random.key(0), case.hidden, case.obs, case.reset)
    tree = plain_params(params, case.network.widths)["params"]
    scales = {"pointwise_0": 2**0.5, "pointwise_1": 2**0.5, "spatial_0": 2**0.5, "spatial_1": 2**0.5}
    scales |= {"actor_hidden": 2.0, "actor": 0.01, "critic_hidden": 2.0, "critic": 1.0}
    for name, scale in scales.items():
        kernel = np.asarray(tree[name]["kernel"])
        values = np.linalg.svd(kernel.reshape(-1, kernel.shape[-1]), compute_uv=False)
        np.testing.assert_allclose(values, scale, rtol=1e-4, err_msg=name)
        np.testing.assert_array_equal(tree[name]["bias"], 0, err_msg=name)
