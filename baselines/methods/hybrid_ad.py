"""Hybrid-AD (paper, Sec. 4.4, "Recurrent Architecture Variant"): AD's loss on a recurrent state tracker."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from baselines.methods.ad import action_method
from baselines.methods.method import ModelOptions
from generation.learners.network import GRU


class Recurrent(nn.Module):
    """Layers of GRUs, each a scan over time, and a last layer norm: a trunk as the transformer is one.

    The state starts from zero at a window's first step and goes on over episodes, as the transformer's context does.
    """

    layers: int = 2
    width: int = 256
    dropout: float = 0.1

    def setup(self) -> None:
        self.grus = [GRU(self.width) for _ in range(self.layers)]
        self.norm, self.drop = nn.LayerNorm(), nn.Dropout(self.dropout)

    def __call__(
        self, x: Float[Array, "B N D"], *, lengths: Int[Array, " B"] | None = None, deterministic: bool = True
    ) -> Float[Array, "B N D"]:
        """Whole sequences. `lengths` change nothing: padding stands behind what is valid, and no state comes back."""
        start = tuple(jnp.zeros((x.shape[0], self.width), x.dtype) for _ in range(self.layers))
        return jnp.swapaxes(self._run(jnp.swapaxes(x, 0, 1), start, deterministic)[0], 0, 1)

    def start(self, context: int) -> tuple[Float[Array, " D"], ...]:
        """The state before the first token, whatever the context's length."""
        return tuple(jnp.zeros(self.width) for _ in range(self.layers))

    def advance(
        self, x: Float[Array, " D"], memory: tuple[Float[Array, " D"], ...]
    ) -> tuple[Float[Array, " D"], tuple[Float[Array, " D"], ...]]:
        """One more token."""
        features, after = self._run(x[None, None], tuple(hidden[None] for hidden in memory), True)
        return features[0, 0], tuple(hidden[0] for hidden in after)

    def _run(self, x: Float[Array, "N B D"], hidden: tuple[Array, ...], deterministic: bool) -> tuple[Array, tuple]:
        never, after = jnp.zeros(x.shape[:2], bool), []
        for gru, state in zip(self.grus, hidden, strict=True):
            state, x = gru(state, x, never)
            x = self.drop(x, deterministic=deterministic)
            after.append(state)
        return self.norm(x), tuple(after)


def _trunk(options: ModelOptions) -> Recurrent:
    return Recurrent(options.recurrent_layers, options.width, options.dropout)


hybrid_ad = action_method("hybrid_ad", "Hybrid-AD", _trunk)
"""913,310 parameters at C = 40."""
