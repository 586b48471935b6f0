"""Encoders: one observation to a feature vector (paper, App. E.1)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from generation.learners.encoder import Conv3x3

FEATURES = 64
"""Width of an encoded observation and of an embedded action (the paper's d_emb)."""

_init = nn.initializers.orthogonal(2**0.5)


class GridEncoder(nn.Module):
    """Three 1 x 1 and three 3 x 3 SAME convolutions with ReLU, then one dense layer (paper, App. E.1).

    89,112 parameters at C = 40 channels. Convolutions are matrix products, see `generation.learners.encoder.Conv3x3`.
    """

    features: int = FEATURES
    pointwise: tuple[int, ...] = (128, 128, 8)
    spatial: tuple[int, ...] = (16, 32, 32)
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, obs: Num[Array, "*B 5 5 C"]) -> Float[Array, "*B F"]:
        """Returns features of observations, which are uint8 or float."""
        batch, (height, width, channels) = obs.shape[:-3], obs.shape[-3:]
        x = obs.reshape(-1, height * width, channels).astype(self.dtype)
        for features in self.pointwise:  # a 1 x 1 convolution is a dense layer on every cell
            x = nn.relu(nn.Dense(features, kernel_init=_init)(x))
        x = x.reshape(x.shape[0], -1)
        for features in self.spatial:
            x = nn.relu(Conv3x3(features)(x))
        return nn.Dense(self.features, kernel_init=_init)(x).reshape(*batch, self.features)


class FlatEncoder(nn.Module):
    """One dense layer, for worlds whose observation is a short vector."""

    features: int = FEATURES
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, obs: Num[Array, "*B N"]) -> Float[Array, "*B F"]:
        """Returns features of observations, which are integers or float."""
        return nn.Dense(self.features, kernel_init=_init)(obs.astype(self.dtype))
