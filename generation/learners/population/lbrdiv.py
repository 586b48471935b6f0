"""LBRDiv: BRDiv as a constrained problem, its weights Lagrange multipliers (Rahman et al. 2024; paper, App. B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from generation.learners.population.brdiv import pairs_seating
from generation.learners.population.population import Seating

_OWN = 0.5


class Multipliers(NamedTuple):
    """[i, j] holds J(pi_i, BR_i) above ... by the tolerance; the diagonals weigh self-play, 1 in all."""

    vertical: Float[Array, "K K"]  # J(pi_j, BR_i): another confederate with i's best response
    horizontal: Float[Array, "K K"]  # J(pi_i, BR_j): confederate i with another's best response
    returns: Float[Array, "K K"]  # the last known J(pi_i, BR_j)
    known: Bool[Array, "K K"]


@dataclass(frozen=True)
class LBRDiv:
    """Maximise sum_i J(pi_i, BR_i) under J(pi_i, BR_i) >= J(pi_j, BR_i) + eps and J(pi_i, BR_i) >= J(pi_i, BR_j) + eps
    (paper, App. B.1, LBRDiv). In the Lagrangian the return of confederate i with its own best response has the weight
    sum_j (vertical_ij + horizontal_ij), and with best response j the weight -(horizontal_ij + vertical_ji); both
    players of a pair share it. Multipliers follow the returns of the episodes that the population itself plays.
    """

    members: int
    tolerance: float = 0.1
    learning_rate: float = 0.01

    def seating(self, environments: int) -> Seating:
        return pairs_seating(self.members, environments)

    def begin(self) -> Multipliers:
        own = _OWN * jnp.eye(self.members)
        nothing = jnp.zeros((self.members, self.members))
        return Multipliers(own, own, nothing, nothing > 0)

    def weights(self, memory: Multipliers) -> Float[Array, " terms"]:
        own = jnp.eye(self.members)
        self_play = (memory.vertical + memory.horizontal).sum(axis=1)
        pairs = own * self_play - (1 - own) * (memory.horizontal + memory.vertical.T)
        return jnp.concatenate([pairs.ravel(), pairs.ravel()])

    def adapt(self, memory: Multipliers, returns, seen) -> Multipliers:
        """Lambda <- max(Lambda - eta (J(pi_i, BR_i) - J(other) - eps), 0.5 on the diagonal, else 0)."""
        k = self.members
        known = memory.known | seen[k:, :k].T  # seat 0 holds the best responses
        latest = jnp.where(seen[k:, :k].T, returns[k:, :k].T, memory.returns)
        fresh = jnp.any(seen)
        own = jnp.diag(latest)[:, None]
        both = jnp.diag(known)[:, None]

        def moved(multipliers, other, other_known):
            step = self.learning_rate * (own - other - self.tolerance)
            changed = jnp.maximum(multipliers - jnp.where(both & other_known & fresh, step, 0.0), 0.0)
            return jnp.where(jnp.eye(k) > 0, _OWN, changed)

        vertical = moved(memory.vertical, latest.T, known.T)
        horizontal = moved(memory.horizontal, latest, known)
        return Multipliers(vertical, horizontal, latest, known)
