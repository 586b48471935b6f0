"""Small models for observations of three numbers and for four actions, and batches to train them on."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_baselines.control.worlds import FlatEncoder
from icrl4aht_baselines.methods.method import Method, World
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import plain_view

from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch

TINY = ModelOptions(layers=2, width=16, heads=2, teammate_actions=True, next_obs=True)
FLAT = World(lambda dtype: FlatEncoder(8, dtype), (3,), plain_view, 4)


def random_parameters(method: Method) -> Any:
    """Return random parameters without calling the method's initialization, which is slow to compile."""
    rng = np.random.default_rng(1)

    def random_leaf(path, shape):
        centre = 1.0 if path[-1].key == "scale" else 0.0
        return jnp.asarray(rng.normal(centre, (sum(shape.shape[:-1]) or 100) ** -0.5, shape.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(random_leaf, jax.eval_shape(method.init, jax.random.key(0)))


def ad_batch(rows=2, length=7, seed=0) -> ADBatch:
    rng = np.random.default_rng(seed)
    actions = rng.integers(0, 4, (3, rows, length + 1))
    rewards = rng.normal(size=(rows, length)).astype(np.float32)
    mask = np.ones((rows, length), bool)
    dones = np.zeros((rows, length), bool)
    dones[:, 3] = True
    obs = rng.normal(size=(rows, length, 3)).astype(np.float32)
    return ADBatch(obs, actions[0, :, :-1], rewards, actions[0, :, 1:], dones, mask, actions[1, :, :-1])


def dpt_batch(rows=2, context=6, seed=0) -> DPTBatch:
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(rows, context + 1, 3)).astype(np.float32)
    actions = rng.integers(0, 4, (2, rows, context))
    rewards = rng.normal(size=(rows, context)).astype(np.float32)
    query = rng.normal(size=(rows, 3)).astype(np.float32)
    return DPTBatch(query, rng.integers(0, 4, rows), obs[:, :-1], actions[0], obs[:, 1:], rewards, actions[1])
