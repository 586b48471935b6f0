"""Hybrid-AD (paper, Sec. 5.3, "Recurrent Architecture Variant"): AD's loss on a recurrent state tracker.

Shapes: `B` batch size, `N` tokens of a sequence, `D` width.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.network import GRU
from jaxtyping import Array, Float

from icrl4aht_baselines.methods.ad import action_method
from icrl4aht_baselines.methods.options import ModelOptions


class RecurrentTrunk(nn.Module):
    """GRU layers, each a scan over time, and a last layer norm, with the interface of `Transformer`.

    The state starts from zero at a window's first step and continues over episodes, as a transformer's context does.
    """

    layers: int = 2
    width: int = 256
    dropout: float = 0.1

    def setup(self) -> None:
        self.grus = [GRU(self.width) for _ in range(self.layers)]
        self.norm, self.drop = nn.LayerNorm(), nn.Dropout(self.dropout)

    def __call__(self, x: Float[Array, "B N D"], *, deterministic: bool = True) -> Float[Array, "B N D"]:
        """Return features of complete sequences."""
        zeros = tuple(jnp.zeros((x.shape[0], self.width), x.dtype) for _ in range(self.layers))
        return jnp.swapaxes(self._scan(jnp.swapaxes(x, 0, 1), zeros, deterministic)[0], 0, 1)

    def start(self, context: int) -> tuple[Float[Array, " D"], ...]:
        """Return the states before the first token, one per layer, whatever the context's length."""
        return tuple(jnp.zeros(self.width) for _ in range(self.layers))

    def start_after(self, x: Float[Array, "N D"], context: int) -> tuple[Float[Array, " D"], ...]:
        """Return the states after a sequence of tokens."""
        return self._advance(x, self.start(context))[1]

    def advance(
        self, x: Float[Array, " D"], memory: tuple[Float[Array, " D"], ...]
    ) -> tuple[Float[Array, " D"], tuple[Float[Array, " D"], ...]]:
        """Return the features of one more token, and the states after it."""
        features, states = self._advance(x[None], memory)
        return features[0], states

    def follow(
        self, x: Float[Array, "N B D"], states: tuple[Float[Array, "B D"], ...]
    ) -> tuple[Float[Array, "N B D"], tuple[Float[Array, "B D"], ...]]:
        """Return the features of B sequences with time on the first axis, and the states after them."""
        return self._scan(x, states, True)

    def _advance(self, x: Float[Array, "N D"], states: tuple[Array, ...]) -> tuple[Float[Array, "N D"], tuple]:
        features, states = self._scan(x[:, None], tuple(hidden[None] for hidden in states), True)
        return features[:, 0], tuple(hidden[0] for hidden in states)

    def _scan(self, x: Float[Array, "N B D"], states: tuple[Array, ...], deterministic: bool) -> tuple[Array, tuple]:
        no_reset, last_states = jnp.zeros(x.shape[:2], bool), []
        for gru, state in zip(self.grus, states, strict=True):
            state, x = gru(state, x, no_reset)
            x = self.drop(x, deterministic=deterministic)
            last_states.append(state)
        return self.norm(x), tuple(last_states)


def _make_trunk(options: ModelOptions) -> RecurrentTrunk:
    return RecurrentTrunk(options.recurrent_layers, options.width, options.dropout)


hybrid_ad = action_method("hybrid_ad", "Hybrid-AD", _make_trunk)
"""Maker of Hybrid-AD; 913,310 parameters at C = 40 channels."""
