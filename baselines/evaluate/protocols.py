"""TODO."""

from __future__ import annotations

from dataclasses import dataclass

from generation.policy import Noise
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.errors import unknown


@dataclass(frozen=True)
class Protocol:
    """How tasks are evaluated.

    Args:
        noise: of heuristic teammates, see `generation.policy.Noise`.
        four_recipes: whether Track 2 draws from four recipes, as the published numbers do, or from its layouts' two.
    """

    name: str
    noise: Noise
    four_recipes: bool
    episodes: int = 100
    steps: int = KEPT_STEPS


PROTOCOLS = {
    "published": Protocol("published", noise="fixed", four_recipes=True),
    "seeded": Protocol("seeded", noise="seeded", four_recipes=False),
}
"""`published` compares with the paper's numbers; `seeded`, the default, is what to report."""


def get_protocol(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if name not in PROTOCOLS:
        raise unknown("protocol", name, PROTOCOLS)
    return PROTOCOLS[name]
