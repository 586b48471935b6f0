"""FCP: independent self-play learners with different seeds (Strouse et al. 2021; paper, App. B.1).

FCP with one member is IPPO: one policy plays both agents (paper, App. B.1 "Independent PPO").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from icrl4aht_generation.learners.population.population import Algorithm, Assignment


@dataclass(frozen=True)
class FCP(Algorithm):
    """Fictitious co-play: each member plays with itself.

    Attributes:
        members: number of policies.
    """

    members: int

    def assignment(self, environments: int) -> Assignment:
        """Return an assignment in which each member plays both agents of its environments, for its self-play return."""
        member = np.repeat(np.arange(self.members), environments)
        # A member plays both agents and learns from both, because both earn its self-play return.
        both = np.stack([member, member])
        return Assignment(both, both, np.arange(self.members), self.members, np.full(member.size, -1))

    def weights(self, memory: Any):
        return jnp.ones(self.members)
