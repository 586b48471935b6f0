"""LBRDiv: BRDiv as a constrained problem, weighted by Lagrange multipliers (Rahman et al. 2024; paper, App. B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from icrl4aht_generation.learners.population.brdiv import pairs_assignment
from icrl4aht_generation.learners.population.population import Algorithm, Assignment

_SELF_PLAY = 0.5  # diagonal of both multiplier matrices, so each self-play return has at least the weight 1


class Multipliers(NamedTuple):
    """Lagrange multipliers of K members, and the returns that determine the multipliers.

    J(pi_i, BR_j) denotes the return of confederate i with best response j. Multipliers [i, j] belong to the constraints
    that J(pi_i, BR_i) exceeds J(pi_j, BR_i) and J(pi_i, BR_j) by the tolerance.

    Attributes:
        vertical: float32 (K, K), multipliers for J(pi_j, BR_i), another confederate with i's best response.
        horizontal: float32 (K, K), multipliers for J(pi_i, BR_j), confederate i with another best response.
        returns: float32 (K, K), the last known J(pi_i, BR_j).
        known: bool (K, K), whether an episode of the pair has ended yet.
    """

    vertical: Float[Array, "K K"]
    horizontal: Float[Array, "K K"]
    returns: Float[Array, "K K"]
    known: Bool[Array, "K K"]


@dataclass(frozen=True)
class LBRDiv(Algorithm):
    """LBRDiv: maximize sum_i J(pi_i, BR_i) under two constraints for each pair i != j (paper, App. B.1, LBRDiv).

    The constraints are J(pi_i, BR_i) >= J(pi_j, BR_i) + eps and J(pi_i, BR_i) >= J(pi_i, BR_j) + eps. In the
    Lagrangian, the return of confederate i with its own best response has the weight
    sum_j (vertical_ij + horizontal_ij), and with another best response j the weight -(horizontal_ij + vertical_ji).
    Both policies of a pair have the same weight. The multipliers are updated with the returns of training episodes.

    Attributes:
        members: number K of confederates.
        tolerance: eps, in units of return.
        learning_rate: step size of the multipliers.
    """

    members: int
    tolerance: float = 0.1
    learning_rate: float = 0.01

    def assignment(self, environments: int) -> Assignment:
        return pairs_assignment(self.members, environments)

    def init(self) -> Multipliers:
        own = _SELF_PLAY * jnp.eye(self.members)
        nothing = jnp.zeros((self.members, self.members))
        return Multipliers(own, own, nothing, nothing > 0)

    def weights(self, memory: Multipliers) -> Float[Array, " terms"]:
        own = jnp.eye(self.members)
        self_play = (memory.vertical + memory.horizontal).sum(axis=1)
        pairs = own * self_play - (1 - own) * (memory.horizontal + memory.vertical.T)
        return jnp.concatenate([pairs.ravel(), pairs.ravel()])

    def adapt(self, memory: Multipliers, returns, seen) -> Multipliers:
        """Return new multipliers max(multiplier - eta (J(pi_i, BR_i) - J(other pair) - eps), 0).

        Here eta is `learning_rate`, and eps is `tolerance`. Diagonal entries stay the same. The others change only if
        there are new episodes and both returns are known.
        """
        k = self.members
        # `returns` is indexed [ego, teammate]; the egos are the best responses, policies K..2K-1.
        known = memory.known | seen[k:, :k].T
        latest = jnp.where(seen[k:, :k].T, returns[k:, :k].T, memory.returns)
        own = jnp.diag(latest)[:, None]
        own_known = jnp.diag(known)[:, None]
        fresh = jnp.any(seen)  # without new episodes the multipliers do not change

        def updated_multipliers(multipliers, other, other_known):
            step = self.learning_rate * (own - other - self.tolerance)
            changed = jnp.maximum(multipliers - jnp.where(own_known & other_known & fresh, step, 0.0), 0.0)
            return jnp.where(jnp.eye(k) > 0, _SELF_PLAY, changed)

        vertical = updated_multipliers(memory.vertical, latest.T, known.T)
        horizontal = updated_multipliers(memory.horizontal, latest, known)
        return Multipliers(vertical, horizontal, latest, known)
