"""Encoders of the positive control's worlds; those of OvercookedV2 are in `icrl4aht_generation.learners.encoder`."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import orthogonal_dense
from jaxtyping import Array, Float, Num

FEATURES = 64
"""Width of an encoded observation and of an embedded action (the paper's d_emb)."""


class FlatEncoder(nn.Module):
    """One dense layer, for worlds whose observation is a short vector."""

    features: int = FEATURES
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, obs: Num[Array, "*B N"]) -> Float[Array, "*B F"]:
        """Return features of observations, which are integers or float."""
        return orthogonal_dense(self.features)(obs.astype(self.dtype))
