"""`mean_ad`: AD that summarizes the past by its mean."""

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_baselines.methods.ad import action_method


class Mean(nn.Module):
    """A trunk that computes each feature from the mean of the tokens so far."""

    width: int

    def setup(self):
        self.mix = nn.Dense(self.width)

    def __call__(self, x, *, deterministic=True):
        """Return the features (B, N, D) of windows of tokens (B, N, D); padding comes last."""
        return nn.gelu(self.mix(x.cumsum(axis=1) / jnp.arange(1, x.shape[1] + 1)[:, None]))

    def start(self, context):
        """Return the memory before the first token."""
        return jnp.zeros(self.width), jnp.float32(0)

    def start_after(self, x, context):
        """Return the memory after a sequence of tokens (N, D)."""
        return x.sum(axis=0), jnp.float32(len(x))

    def advance(self, x, memory):
        """Return the feature (D,) of the next token (D,) and the updated memory."""
        total, count = memory[0] + x, memory[1] + 1
        return nn.gelu(self.mix(total / count)), (total, count)


def mean_ad(options, world):
    """Return the method for `ModelOptions` and a `World`."""
    return action_method("mean_ad", "Mean-AD", options, world, Mean(options.width))
