"""Small populations, and a reference implementation of the update of LBRDiv's Lagrange multipliers."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig, Widths
from icrl4aht_generation.learners.population.lbrdiv import Multipliers
from icrl4aht_generation.learners.population.population import Algorithm, Population

from icrl4aht_data.overcooked.layouts import get_layout

LAYOUT = get_layout("cramped_up")
EPISODE = 6
CONFIG = PPOConfig(
    total_steps=16 * EPISODE * 10,
    environments=16,
    rollout=EPISODE,
    epochs=2,
    minibatches=2,
    learning_rate=0.01,
    widths=Widths(pointwise=(4,), spatial=(4,), dense=8, gru=8, head=8),
)


def population(algorithm: Algorithm, config: PPOConfig = CONFIG, **options: Any) -> Population:
    return Population(Environment(LAYOUT, max_steps=EPISODE), algorithm, config, **options)


def lbrdiv_multipliers(
    old: Multipliers, returns: np.ndarray, seen: np.ndarray, tolerance: float, rate: float
) -> Multipliers:
    """Return LBRDiv's multipliers after one update by the rule of the LBRDiv paper.

    Entry [i, j] belongs to confederate i with best response j.
    """
    k = len(old.vertical)
    vertical, horizontal, latest = (np.array(x, np.float64) for x in old[:3])
    known = np.array(old.known)
    for i, j in product(range(k), range(k)):
        if seen[k + j, i]:
            latest[i, j], known[i, j] = returns[k + j, i], True
    if seen.any():
        for i, j in product(range(k), range(k)):
            if i != j and known[i, i] and known[j, i]:
                vertical[i, j] = max(vertical[i, j] - rate * (latest[i, i] - latest[j, i] - tolerance), 0)
            if i != j and known[i, i] and known[i, j]:
                horizontal[i, j] = max(horizontal[i, j] - rate * (latest[i, i] - latest[i, j] - tolerance), 0)
    return Multipliers(vertical, horizontal, latest, known)  # type: ignore[arg-type]
