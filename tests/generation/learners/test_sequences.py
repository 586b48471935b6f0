"""Sequences that a player learns from: which rewards they have."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.learners.ppo import sequences
from icrl4aht_generation.learners.rollout import Choice, Rollout

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE

REWARDS = np.array([-20, -25, -30, -10, -5, 0, 20, 15], np.float32)
"""A wrong delivery, one with one press of a button and with two, presses alone, nothing, a delivery without and with a
press."""


def rollout() -> Rollout:
    """Return steps of two environments with these rewards; agent a has the shaped reward a + 1 in every step."""
    size = (len(REWARDS), 2)
    zeros, choices = jnp.zeros(size), jnp.zeros((len(REWARDS), 4))
    return Rollout(
        record=jnp.zeros((*size, 12), jnp.uint8),
        reset=zeros > 0,
        actions=jnp.zeros((*size, 2), jnp.int32),
        reward=jnp.tile(REWARDS[:, None], (1, 2)),
        shaped=jnp.ones((*size, 2)) * jnp.arange(1, 3),
        done=zeros > 0,
        returns=zeros,
        choices=(Choice(choices, choices, choices),),
    )


def test_a_wrong_delivery_is_forgiven_as_long_as_rewards_are_shaped():
    """A wrong delivery is forgiven for both agents, with or without button presses; presses alone are not."""
    slots = np.arange(4)  # both agents of both environments
    agents = np.repeat([EGO, TEAMMATE], 2)
    for weight, forgiven in ((1.0, 20), (0.25, 5), (0.0, 0)):
        found = sequences(
            lambda records: records,  # type: ignore[arg-type]
            rollout(),
            0,
            slots,
            jnp.zeros((4, 8)),
            jnp.zeros(4),
            jnp.float32(weight),
            forgiveness=20.0,
        )
        expected = REWARDS + np.array([forgiven] * 3 + [0] * 5, np.float32)
        np.testing.assert_allclose(found.reward, expected[:, None] + weight * (agents + 1), atol=1e-5)
