"""Hybrid-AD (paper, Sec. 5.3, "Recurrent Architecture Variant"): AD with GRU layers instead of a transformer.

Shapes: `B` batch size, `N` tokens of a sequence, `D` width, `S` size of the recurrent state: layers x D.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.network import GRU
from jaxtyping import Array, Float

from icrl4aht_baselines.methods.ad import action_method
from icrl4aht_baselines.methods.method import Method, World
from icrl4aht_baselines.methods.options import ModelOptions


class RecurrentTrunk(nn.Module):
    """GRU layers followed by a layer norm, with the interface of `Transformer`.

    The recurrent state is zero at a window's first step, and is not reset at the end of an episode.
    """

    layers: int = 2
    width: int = 256
    dropout: float = 0.1

    def setup(self) -> None:
        self.grus = [GRU(self.width) for _ in range(self.layers)]
        self.norm, self.drop = nn.LayerNorm(), nn.Dropout(self.dropout)

    def __call__(self, x: Float[Array, "B N D"], *, deterministic: bool = True) -> Float[Array, "B N D"]:
        """Return features of complete sequences."""
        zeros = jnp.zeros((x.shape[0], self.layers * self.width), x.dtype)
        return jnp.swapaxes(self.run_sequences(jnp.swapaxes(x, 0, 1), zeros, deterministic)[0], 0, 1)

    def start(self, context: int) -> Float[Array, " S"]:
        """Return the state before the first token; `context` has no effect."""
        return jnp.zeros(self.layers * self.width)

    def start_after(self, x: Float[Array, "N D"], context: int) -> Float[Array, " S"]:
        """Return the state after a sequence of tokens."""
        return self.run_sequences(x[:, None], self.start(context)[None])[1][0]

    def advance(
        self, x: Float[Array, " D"], state: Float[Array, " S"]
    ) -> tuple[Float[Array, " D"], Float[Array, " S"]]:
        """Return the features of the next token, and the state after this token."""
        features, state = self.run_sequences(x[None, None], state[None])
        return features[0, 0], state[0]

    def run_sequences(
        self, x: Float[Array, "N B D"], state: Float[Array, "B S"], deterministic: bool = True
    ) -> tuple[Float[Array, "N B D"], Float[Array, "B S"]]:
        """Return the features of B sequences, with time on the first axis, and the states after the sequences."""
        no_reset, last_states = jnp.zeros(x.shape[:2], bool), []
        for gru, layer in zip(self.grus, jnp.split(state, self.layers, axis=-1), strict=True):
            layer, x = gru(layer, x, no_reset)
            x = self.drop(x, deterministic=deterministic)
            last_states.append(layer)
        return self.norm(x), jnp.concatenate(last_states, axis=-1)


def hybrid_ad(options: ModelOptions, world: World) -> Method:
    """Return the method Hybrid-AD; with default options and C = 40 channels its model has 913,310 parameters."""
    trunk = RecurrentTrunk(options.recurrent_layers, options.width, options.dropout)
    return action_method("hybrid_ad", "Hybrid-AD", options, world, trunk)
