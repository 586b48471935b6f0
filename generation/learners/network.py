"""The CNN-GRU actor-critic of teammates and egos (paper, App. B.1 and C.2.1), in a form that is fast on a CPU.

B denotes the batch dimension, N sequences, T steps. Parameters and outputs are those of the plain form (1 x 1 and 3 x 3
SAME convolutions, a GRU cell); the arithmetic differs: a 1 x 1 convolution is a matrix product; a 3 x 3 one on a 5 x 5
patch is one dense matrix built from its kernel; the GRU's input products are computed for all steps outside the scan.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from generation.learners.config import Widths
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import WINDOW

_CELLS = WINDOW * WINDOW


class Conv3x3(nn.Module):
    """A 3 x 3 SAME convolution of a 5 x 5 patch: (B, 25 * c_in) -> (B, 25 * features)."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "B _"]) -> Float[Array, "B _"]:
        channels = x.shape[-1] // _CELLS
        kernel = self.param("kernel", nn.initializers.orthogonal(2**0.5), (3, 3, channels, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        taps = jnp.concatenate([kernel.reshape(9, channels, self.features), jnp.zeros_like(kernel[:1, 0])])
        matrix = taps[_tap_of_cells()].transpose(0, 2, 1, 3).reshape(_CELLS * channels, _CELLS * self.features)
        return x @ matrix + jnp.tile(bias, _CELLS)


def _tap_of_cells() -> np.ndarray:
    """int (25, 25): number of the kernel tap, 0..8, between an input and an output cell; 9 if they are not adjacent."""
    cell = np.arange(_CELLS)
    dy = cell[:, None] // WINDOW - cell // WINDOW + 1
    dx = cell[:, None] % WINDOW - cell % WINDOW + 1
    near = (dy >= 0) & (dy < 3) & (dx >= 0) & (dx < 3)
    return np.where(near, dy * 3 + dx, 9)


class ObservationEncoder(nn.Module):
    """Maps observations, each by itself, to features."""

    widths: Widths

    @nn.compact
    def __call__(self, obs: Integer[Array, "*B 5 5 C"]) -> Float[Array, "*B dense"]:
        batch = obs.shape[:-3]
        x = obs.reshape(-1, _CELLS, obs.shape[-1]).astype(jnp.float32)
        for width in self.widths.pointwise:
            x = nn.relu(_dense(width, 2**0.5)(x))
        x = x.reshape(x.shape[0], -1)
        for width in self.widths.spatial:
            x = nn.relu(Conv3x3(width)(x))
        x = nn.relu(_dense(self.widths.dense, 2**0.5)(x))
        return nn.LayerNorm()(x).reshape(*batch, self.widths.dense)


class GRU(nn.Module):
    """A GRU over time that starts from zero where `reset` is set. Parameters as in `flax.linen.GRUCell`."""

    width: int

    @nn.compact
    def __call__(
        self, hidden: Float[Array, "N H"], x: Float[Array, "T N F"], reset: Bool[Array, "T N"]
    ) -> tuple[Float[Array, "N H"], Float[Array, "T N H"]]:
        gates = nn.Dense(3 * self.width, name="input")(x)
        recurrent = self.param("recurrent", _orthogonal_gates, (self.width, 3 * self.width))
        bias = self.param("candidate_bias", nn.initializers.zeros_init(), (self.width,))

        def step(hidden, inputs):
            gates, reset = inputs
            hidden = jnp.where(reset[:, None], 0.0, hidden)
            r_in, z_in, n_in = jnp.split(gates, 3, axis=-1)
            r_h, z_h, n_h = jnp.split(hidden @ recurrent, 3, axis=-1)
            r, z = nn.sigmoid(r_in + r_h), nn.sigmoid(z_in + z_h)
            candidate = nn.tanh(n_in + r * (n_h + bias))
            hidden = (1 - z) * candidate + z * hidden
            return hidden, hidden

        return jax.lax.scan(step, hidden, (gates, reset))


class ActorCritic(nn.Module):
    """Recurrent actor-critic: sequences of observations to action logits and values.

    Args:
        widths: layer widths.
        partners: number of policies among which the critic distinguishes the partner (BRDiv, Rahman et al. 2023,
            Sec. 5); 0 for a critic without that input. The actor never has it.
        critic: False for policies that only act; their values are 0.
    """

    widths: Widths = Widths()
    partners: int = 0
    critic: bool = True

    @nn.compact
    def __call__(
        self,
        hidden: Float[Array, "N H"],
        obs: Integer[Array, "T N 5 5 C"],
        reset: Bool[Array, "T N"],
        partner: Integer[Array, " N"] | None = None,
    ) -> tuple[Float[Array, "N H"], Float[Array, "T N 6"], Float[Array, "T N"]]:
        """Applies the network to T steps of N sequences.

        Args:
            hidden: recurrent state before the first step.
            obs: observations.
            reset: whether an episode starts at a step; the recurrent state is zero there.
            partner: number of the partner's policy, for a critic with `partners`.

        Returns:
            The recurrent state after the last step, action logits, values.
        """
        features = ObservationEncoder(self.widths, name="encoder")(obs)
        hidden, states = GRU(self.widths.gru, name="gru")(hidden, features, reset)
        actor = nn.relu(_dense(self.widths.head, 2.0, "actor_hidden")(states))
        logits = _dense(len(ACTIONS), 0.01, "actor")(actor)
        if not self.critic:
            return hidden, logits, jnp.zeros(logits.shape[:2])
        if self.partners:
            number = jnp.zeros(hidden.shape[0], int) if partner is None else partner
            one_hot = jnp.broadcast_to(jax.nn.one_hot(number, self.partners), (*states.shape[:2], self.partners))
            states = jnp.concatenate([states, one_hot], axis=-1)
        critic = nn.relu(_dense(self.widths.head, 2.0, "critic_hidden")(states))
        value = _dense(1, 1.0, "critic")(critic)
        return hidden, logits, value[..., 0]

    def untrained(self, key: Array, channels: int) -> Any:
        """Returns initial parameters for observations 5 x 5 x channels."""
        obs = jnp.zeros((1, 1, WINDOW, WINDOW, channels), jnp.uint8)
        return self.init(key, self.initial_hidden(1), obs, jnp.ones((1, 1), bool))

    def initial_hidden(self, batch: int) -> Float[Array, "N H"]:
        """Returns the recurrent state at the start of an episode: zeros."""
        return jnp.zeros((batch, self.widths.gru), jnp.float32)


def _dense(width: int, scale: float, name: str | None = None) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(scale), name=name)


def _orthogonal_gates(key: Array, shape: tuple[int, int], dtype=jnp.float32) -> Array:
    one = nn.initializers.orthogonal()
    return jnp.concatenate([one(k, (shape[0], shape[0]), dtype) for k in jax.random.split(key, 3)], axis=1)
