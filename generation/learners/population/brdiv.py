"""BRDiv: confederates that only their own best response can play with (Rahman et al. 2023; paper, App. B.1).

Policies 0..K-1 are the confederates, in the teammate's seat; K..2K-1 their best responses, in the ego's. Confederate i
has three quarters of its tables with its own best response, and the others with the rest in turn: returns are means
of their terms, so this share only says which of them are known well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from generation.learners.population.population import Seating


def pairs_seating(members: int, environments: int) -> Seating:
    """The tables of confederates and best responses; terms: K * K of the confederates, then K * K of the responses.

    Raises:
        ValueError: if a confederate has fewer tables for cross-play than there are other best responses.
    """
    if environments // 4 < members - 1:
        raise ValueError(f"environments = {environments}: {members} members need at least {4 * members - 4}")
    table = np.tile(np.arange(environments), members)
    conf = np.repeat(np.arange(members), environments)
    with_own = table < environments - environments // 4 if members > 1 else np.ones(table.size, bool)
    shift = np.where(with_own, 0, 1 + table % max(members - 1, 1))
    response = (conf + shift) % members
    pair = conf * members + response
    return Seating(
        policy=np.stack([members + response, conf]),
        term=np.stack([members**2 + pair, pair]),
        kin=np.tile(np.arange(members), 2),
        learning=2 * members,
        starts_from=np.full(table.size, -1),
    )


@dataclass(frozen=True)
class BRDiv:
    """L(pi_k) = -w_SP J(pi_k, BR_k) + w_XP sum_{j != k} J(pi_k, BR_j), with w_SP = 1 + 2 w_XP (paper, App. B.1, BRDiv
    "Training Objective"); best responses maximise their return with their own confederate only."""

    members: int
    cross_play_weight: float = 0.5

    def seating(self, environments: int) -> Seating:
        return pairs_seating(self.members, environments)

    def begin(self) -> Any:
        return ()

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        own = np.eye(self.members)
        confederates = own * (1 + 2 * self.cross_play_weight) - (1 - own) * self.cross_play_weight
        return jnp.asarray(np.concatenate([confederates.ravel(), own.ravel()]), jnp.float32)

    def adapt(self, memory: Any, returns, seen) -> Any:
        return memory
