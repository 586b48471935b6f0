"""CoMeDi: each new member learns to play well with itself, and badly with its most compatible earlier member.

Source: Sarkar et al. 2023; paper, App. B.1. The first member is trained by self-play, like the members of FCP.

Policy 0 is the new member, which is also its own best response, as in the original. Policy 1 is a frozen member. Each
of four kinds of play has a quarter of the environments:

* self-play (SP): the new member plays both agents;
* cross-play (XP): the new member plays with the frozen member, which is the ego in half of these environments;
* mixed play (MP): the partner is the new member or the frozen member, fixed for each environment; no policy learns
  here, because this play only visits states;
* mixed play from states that the third quarter visited (SMP), which gives J_MP: the new member cannot recognize its
  partner by such states, so it cannot learn to play badly with strangers on purpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from icrl4aht_generation.learners.population.population import Algorithm, Assignment

_SP, _XP, _MP_SELF, _MP_FROZEN = range(4)


@dataclass(frozen=True)
class CoMeDi(Algorithm):
    """CoMeDi: a new member minimizes L = -J_SP + alpha J_XP - beta J_MP (paper, App. B.1, CoMeDi "Training Objective").

    The partner in the mixed play of J_MP is the new member in half of the episodes, and the frozen member in the rest.

    Attributes:
        cross_play_weight: weight alpha of cross-play returns.
        mixed_play_weight: weight beta of mixed-play returns.
    """

    cross_play_weight: float = 1.0
    mixed_play_weight: float = 1.0

    def assignment(self, environments: int) -> Assignment:
        """Assign policies to one member's environments.

        Raises:
            ValueError: if the number of environments is not a multiple of 8.
        """
        if environments % 8:
            raise ValueError(f"environments = {environments}: expected a multiple of 8 for CoMeDi")
        quarter = environments // 4
        new, frozen = np.zeros(quarter, int), np.ones(quarter, int)
        first_half = np.arange(quarter) < quarter // 2
        cross = np.stack([np.where(first_half, frozen, new), np.where(first_half, new, frozen)])
        # Alternate the partners, because the frozen member is the ego in only one half of the environments of `cross`.
        with_self = np.arange(quarter) % 2 == 0
        mixed = np.where(with_self, 0, cross)
        play = np.stack([new, new])
        none = np.full_like(play, -1)
        mixed_term = np.where(with_self, _MP_SELF, np.where(mixed == 0, _MP_FROZEN, -1))
        return Assignment(
            policy=np.concatenate([play, cross, mixed, mixed], axis=1),
            term=np.concatenate([play + _SP, np.where(cross == 0, _XP, -1), none, mixed_term], axis=1),
            group=np.arange(2),
            learning=1,
            starts_from=np.concatenate([np.full(3 * quarter, -1), 2 * quarter + np.arange(quarter)]),
        )

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        # The two kinds of mixed play have equal weights, although play with the frozen member has half as many samples.
        half = self.mixed_play_weight / 2
        return jnp.array([1.0, -self.cross_play_weight, half, half])
