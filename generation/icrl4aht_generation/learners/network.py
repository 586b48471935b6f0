"""The CNN-GRU actor-critic of teammates and egos (paper, App. B.1 and C.2.1), in a form that is fast on a CPU.

N denotes sequences, T steps. Parameters and outputs equal those of ordinary convolutions and a GRU cell, but the order
of computation differs: the GRU's products with the input are computed for all steps before the scan. For the
convolutions, see `encoder`.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer

from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.cells import WINDOW
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.encoder import CompactView, Seen, WindowEncoder, orthogonal_dense


class GRU(nn.Module):
    """A GRU over time, with the parameters of `flax.linen.GRUCell`; the state is set to zero where `reset` is true."""

    width: int

    @nn.compact
    def __call__(
        self, hidden: Float[Array, "N H"], x: Float[Array, "T N F"], reset: Bool[Array, "T N"]
    ) -> tuple[Float[Array, "N H"], Float[Array, "T N H"]]:
        gates = nn.Dense(3 * self.width, name="input")(x)
        recurrent = self.param("recurrent", _orthogonal_gates, (self.width, 3 * self.width))
        bias = self.param("candidate_bias", nn.initializers.zeros_init(), (self.width,))

        states = recurrent_states(hidden, gates, reset, recurrent, bias)
        return states[-1], states


@jax.custom_vjp
def recurrent_states(
    hidden: Float[Array, "N H"],
    gates: Float[Array, "T N 3*H"],
    reset: Bool[Array, "T N"],
    recurrent: Float[Array, "H 3*H"],
    bias: Float[Array, " H"],
) -> Float[Array, "T N H"]:
    """Return the states of a GRU after every step.

    Args:
        hidden: state before the first step.
        gates: contribution of the input to the reset gate, update gate and candidate.
        reset: whether to set the state to zero before a step.
        recurrent: weights from the state to the reset gate, update gate and candidate.
        bias: bias of the state's contribution to the candidate.
    """
    return _scan_states(hidden, gates, reset, recurrent, bias)[0]


def _scan_states(hidden, gates, reset, recurrent, bias):
    """Return the states of a GRU after every step, and the residuals for the gradient."""
    width = recurrent.shape[0]

    def step(hidden, inputs):
        gates, reset = inputs
        before = jnp.where(reset[:, None], 0.0, hidden)
        # One matrix product for all three gates is faster than three products.
        own = before @ recurrent
        r, z = jnp.split(nn.sigmoid(gates[:, : 2 * width] + own[:, : 2 * width]), 2, axis=-1)
        memory = own[:, 2 * width :] + bias
        candidate = nn.tanh(gates[:, 2 * width :] + r * memory)
        hidden = (1 - z) * candidate + z * before
        return hidden, (hidden, (before, r, z, memory, candidate))

    states, inner = jax.lax.scan(step, hidden, (gates, reset))[1]
    return states, (inner, reset, recurrent)


def _states_gradient(saved, to_states):
    """Return the gradients with respect to all inputs of `recurrent_states`.

    This is up to twice as fast as automatic differentiation. The loop computes only values that depend on the next
    step. Everything else, such as the weights' gradient, is one operation over all steps.
    """
    (before, r, z, memory, candidate), reset, recurrent = saved
    width = recurrent.shape[0]
    to_candidate = (1 - z) * (1 - candidate**2)
    to_z = (before - candidate) * z * (1 - z)
    to_r = memory * r * (1 - r)
    continues = 1.0 - reset[..., None]  # no gradient reaches the episode before a reset

    def step_back(to_hidden, inputs):
        to_state, to_candidate, to_z, to_r, r, z, continues = inputs
        to_hidden = to_hidden + to_state
        to_n = to_hidden * to_candidate
        to_own = jnp.concatenate([to_n * to_r, to_hidden * to_z, to_n * r], axis=-1)
        return (to_hidden * z + to_own @ recurrent.T) * continues, (to_own, to_n)

    inputs = (to_states, to_candidate, to_z, to_r, r, z, continues)
    to_first, (to_own, to_n) = jax.lax.scan(step_back, jnp.zeros_like(to_states[0]), inputs, reverse=True)
    to_gates = jnp.concatenate([to_own[..., : 2 * width], to_n], axis=-1)
    to_recurrent = jnp.einsum("tnh,tng->hg", before, to_own)
    return to_first, to_gates, None, to_recurrent, to_own[..., 2 * width :].sum(axis=(0, 1))


recurrent_states.defvjp(_scan_states, _states_gradient)


class ActorCritic(nn.Module):
    """Recurrent actor-critic that maps sequences of observations to action logits and values.

    Args:
        widths: encoder and layer widths.
        partners: number of partner policies, for a critic that receives the partner as a one-hot vector (BRDiv, Rahman
            et al. 2023, Sec. 5); 0 for a critic without this input. The actor never receives the partner.
        critic: whether to compute values; False for policies that only act, which return the value 0.
        view: view that computes the compact inputs; None if all inputs are observations.
    """

    widths: Widths = Widths()
    partners: int = 0
    critic: bool = True
    view: CompactView | None = None

    @nn.compact
    def __call__(
        self,
        hidden: Float[Array, "N H"],
        obs: Seen,
        reset: Bool[Array, "T N"],
        partner: Integer[Array, " N"] | None = None,
    ) -> tuple[Float[Array, "N H"], Float[Array, "T N 6"], Float[Array, "T N"]]:
        """Apply the network to T steps of N sequences.

        Args:
            hidden: recurrent state before the first step.
            obs: observations of shape (T, N, 5, 5, C), or a compact form of the observations with axes (T, N).
            reset: whether an episode starts at a step; the recurrent state before this step is then zero.
            partner: index of the partner's policy, for a critic with `partners`.

        Returns:
            The recurrent state after the last step, action logits, values.
        """
        widths = self.widths
        features = WindowEncoder(
            features=widths.dense,
            kind=widths.encoder,
            pointwise=widths.pointwise,
            spatial=widths.spatial,
            normalize=True,
            view=self.view,
            name="encoder",
        )(obs)
        hidden, states = GRU(widths.gru, name="gru")(hidden, features, reset)
        actor = nn.relu(orthogonal_dense(widths.head, 2.0, "actor_hidden")(states))
        # Small weights make an untrained policy nearly uniform.
        logits = orthogonal_dense(len(ACTIONS), 0.01, "actor")(actor)
        if not self.critic:
            return hidden, logits, jnp.zeros(logits.shape[:2])
        if self.partners:
            number = jnp.zeros(hidden.shape[0], int) if partner is None else partner
            one_hot = jnp.broadcast_to(jax.nn.one_hot(number, self.partners), (*states.shape[:2], self.partners))
            states = jnp.concatenate([states, one_hot], axis=-1)
        critic = nn.relu(orthogonal_dense(widths.head, 2.0, "critic_hidden")(states))
        value = orthogonal_dense(1, 1.0, "critic")(critic)
        return hidden, logits, value[..., 0]

    def untrained(self, key: Array, channels: int) -> Any:
        """Return random initial parameters for observations of shape (5, 5, channels)."""
        obs = jnp.zeros((1, 1, WINDOW, WINDOW, channels), jnp.uint8)
        return self.init(key, self.initial_hidden(1), obs, jnp.ones((1, 1), bool))

    def initial_hidden(self, batch: int) -> Float[Array, "N H"]:
        """Return the recurrent state at the start of an episode: zeros."""
        return jnp.zeros((batch, self.widths.gru), jnp.float32)


def _orthogonal_gates(key: Array, shape: tuple[int, int], dtype=jnp.float32) -> Array:
    # Each gate's matrix starts orthogonal, as in Flax, so fusing the gates does not change initialization.
    one = nn.initializers.orthogonal()
    return jnp.concatenate([one(k, (shape[0], shape[0]), dtype) for k in jax.random.split(key, 3)], axis=1)
