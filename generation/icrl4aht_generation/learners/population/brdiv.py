"""BRDiv: confederates that only play well with their own best response (Rahman et al. 2023; paper, App. B.1).

K denotes the number of members. Policies 0..K-1 are the confederates, which always play the teammate; policies K..2K-1
are their best responses, which always play the ego. Confederate i plays with its own best response in three quarters of
its environments, and with the other best responses in turn in the rest. Weights apply to mean returns, so this share
only affects how well each mean return is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from icrl4aht_generation.learners.population.population import Algorithm, Assignment


def pairs_assignment(members: int, environments: int) -> Assignment:
    """Return which of K confederates and K best responses play in each environment.

    The return of confederate i with best response j is term i * K + j in the objective of the confederate, and term
    K * K + i * K + j in the objective of the best response.

    Raises:
        ValueError: if a confederate has fewer environments for cross-play than there are other best responses.
    """
    if environments // 4 < members - 1:
        raise ValueError(f"environments = {environments}: expected at least {4 * members - 4} for {members} members")
    # The assignment is fixed, so every pair has a fixed number of samples, and shapes are static.
    env = np.tile(np.arange(environments), members)
    confederate = np.repeat(np.arange(members), environments)
    with_own = env < environments - environments // 4 if members > 1 else np.ones(env.size, bool)
    shift = np.where(with_own, 0, 1 + env % max(members - 1, 1))
    response = (confederate + shift) % members
    pair = confederate * members + response
    return Assignment(
        policy=np.stack([members + response, confederate]),
        term=np.stack([members**2 + pair, pair]),
        group=np.tile(np.arange(members), 2),
        learning=2 * members,
        starts_from=np.full(env.size, -1),
    )


@dataclass(frozen=True)
class BRDiv(Algorithm):
    """BRDiv: confederate k minimizes L(pi_k) = -w_SP J(pi_k, BR_k) + w_XP sum_{j != k} J(pi_k, BR_j).

    The weight w_SP is 1 + 2 w_XP (paper, App. B.1, BRDiv "Training Objective"). Best responses maximize their return
    with their own confederate only.

    Attributes:
        members: number K of confederates.
        cross_play_weight: weight w_XP of cross-play returns.
    """

    members: int
    cross_play_weight: float = 0.5

    def assignment(self, environments: int) -> Assignment:
        return pairs_assignment(self.members, environments)

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        own = np.eye(self.members)
        # A best response learns only with its own confederate.
        confederates = own * (1 + 2 * self.cross_play_weight) - (1 - own) * self.cross_play_weight
        return jnp.asarray(np.concatenate([confederates.ravel(), own.ravel()]), jnp.float32)
