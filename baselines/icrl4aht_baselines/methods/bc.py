"""Behaviour cloning without memory: predict an action from the present observation alone.

It is the floor for methods that learn from histories: what they earn above it, they earn by what they remember. Its
parts have the interfaces of AD's, so it is trained on the same windows with the same loss.

Shapes: `B` batch size, `N` tokens of a sequence, `D` width.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from icrl4aht_baselines.methods.ad import action_method
from icrl4aht_baselines.methods.method import Method, World
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import StepInput, Tokenizer


class ObservationTokenizer(Tokenizer):
    """Tokenizer of observations: actions, rewards and the teammate's actions are not inputs."""

    @nn.compact
    def __call__(self, step: StepInput, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Return one token for each step."""
        token = nn.Dense(self.width, name="project", dtype=self.dtype)(self.encoder(step.obs))
        return nn.Dropout(self.dropout)(token, deterministic=deterministic)


class MemorylessTrunk(nn.Module):
    """Residual dense layers, which process each token alone, with the interface of `Transformer`."""

    layers: int = 4
    width: int = 256
    dropout: float = 0.1

    def setup(self) -> None:
        self.hidden = [nn.Dense(self.width) for _ in range(self.layers)]
        self.norms = [nn.LayerNorm() for _ in range(self.layers + 1)]
        self.drop = nn.Dropout(self.dropout)

    def __call__(self, x: Float[Array, "*B D"], *, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Return the features of tokens."""
        *before, last = self.norms
        for norm, hidden in zip(before, self.hidden, strict=True):
            x = x + self.drop(nn.gelu(hidden(norm(x))), deterministic=deterministic)
        return last(x)

    def start(self, context: int) -> Float[Array, " 0"]:
        """Return the empty state; `context` has no effect."""
        return jnp.zeros(0)

    def start_after(self, x: Float[Array, "N D"], context: int) -> Float[Array, " 0"]:
        """Return the empty state; the tokens have no effect."""
        return self.start(context)

    def advance(
        self, x: Float[Array, " D"], state: Float[Array, " 0"]
    ) -> tuple[Float[Array, " D"], Float[Array, " 0"]]:
        """Return the features of the next token, and the empty state."""
        return self(x), state


def bc(options: ModelOptions, world: World) -> Method:
    """Return behaviour cloning without memory; `layers` is the number of dense layers."""
    trunk = MemorylessTrunk(options.layers, options.width, options.dropout)
    return action_method("bc", "BC", options, world, trunk, ObservationTokenizer)
