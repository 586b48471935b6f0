"""FCP: independent self-play learners that differ by their seeds (Strouse et al. 2021; paper, App. B.1).

With one member this is IPPO, one policy in both seats (paper, App. B.1 "Independent PPO").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from generation.learners.population.population import Seating


@dataclass(frozen=True)
class FCP:
    """Each member plays with itself."""

    members: int

    def seating(self, environments: int) -> Seating:
        member = np.repeat(np.arange(self.members), environments)
        both = np.stack([member, member])
        return Seating(both, both, np.arange(self.members), self.members, np.full(member.size, -1))

    def begin(self) -> Any:
        return ()

    def weights(self, memory: Any):
        return jnp.ones(self.members)

    def adapt(self, memory: Any, returns, seen) -> Any:
        return memory
