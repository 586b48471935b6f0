"""CoMeDi: members one after the other, each good with itself and bad with the one it resembles most (Sarkar et al.
2023; paper, App. B.1).

Policy 0 is the new member, in both seats: its best response is itself, as in the original. Policy 1 is a frozen member.
A quarter of the tables each: self-play (SP); cross-play with the frozen member (XP), which sits in either seat; mixed
play (MP), where the new member meets itself or the frozen one, by table instead of by a draw per episode, and from
which nothing is learned; mixed play whose episodes start from states that the former went through (SMP), which gives
J_MP and keeps the new member from telling partners apart by such states and sabotaging.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from generation.learners.population.population import Seating

_SP, _XP, _MP_SELF, _MP_FROZEN = range(4)


@dataclass(frozen=True)
class CoMeDi:
    """L = -J_SP + alpha J_XP - beta J_MP (paper, App. B.1, CoMeDi "Training Objective"), where the partner of J_MP is
    the new member or the frozen one, each in half of the episodes."""

    cross_play_weight: float = 1.0  # alpha
    mixed_play_weight: float = 1.0  # beta

    def seating(self, environments: int) -> Seating:
        """Raises ValueError: if the tables do not divide by eight."""
        if environments % 8:
            raise ValueError(f"environments = {environments}: CoMeDi needs a multiple of 8")
        quarter = environments // 4
        new, old = np.zeros(quarter, int), np.ones(quarter, int)
        left = np.arange(quarter) < quarter // 2
        cross = np.stack([np.where(left, old, new), np.where(left, new, old)])
        alone = np.arange(quarter) % 2 == 0
        mixed = np.where(alone, 0, cross)
        play = np.stack([new, new])
        nothing = np.full_like(play, -1)
        mixed_term = np.where(alone, _MP_SELF, np.where(mixed == 0, _MP_FROZEN, -1))
        return Seating(
            policy=np.concatenate([play, cross, mixed, mixed], axis=1),
            term=np.concatenate([play + _SP, np.where(cross == 0, _XP, -1), nothing, mixed_term], axis=1),
            kin=np.arange(2),
            learning=1,
            starts_from=np.concatenate([np.full(3 * quarter, -1), 2 * quarter + np.arange(quarter)]),
        )

    def begin(self) -> Any:
        return ()

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        half = self.mixed_play_weight / 2
        return jnp.array([1.0, -self.cross_play_weight, half, half])

    def adapt(self, memory: Any, returns, seen) -> Any:
        return memory
