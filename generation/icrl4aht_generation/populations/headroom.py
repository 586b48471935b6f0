"""Returns of the reference egos with learned teammates, and of the policy that each teammate was
trained with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.checkpoints import checkpoint_folder
from icrl4aht_data.format.provenance import ReferenceEgos
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.populations.train import RESPONSES
from icrl4aht_generation.teammates.learned import build_learned
from icrl4aht_generation.teammates.references import REFERENCE_EPISODES, reference_egos, reference_returns

_SEED = 12


def learned_headroom(tasks: Sequence[Task], suite: Path) -> dict[str, ReferenceEgos]:
    """Measure how much an ego matters with learned teammates.

    Args:
        tasks: tasks with learned teammates.
        suite: folder of their checkpoints.

    Returns:
        task id -> returns.
    """
    found = {}
    for layout in dict.fromkeys(task.layout for task in tasks):
        own = [task for task in tasks if task.layout == layout]
        folders = [checkpoint_folder(suite, task.teammate) for task in own]
        mates = [build_learned(layout, folder) for folder in folders]
        partners = [build_learned(layout, _partner(folder), "sampled") for folder in folders]
        returns = reference_returns(layout, mates)
        for k, (task, ego, mate) in enumerate(zip(own, partners, mates, strict=True)):
            play = _compiled(layout, ego._replace(params=()), mate._replace(params=()))
            self_play = float(np.asarray(play(ego.params, mate.params)).mean())
            found[task.task_id] = reference_egos(returns, k, self_play)
    return found


def _partner(folder: Path) -> Path:
    """Return the folder of the policy that a checkpoint, m<k>/c<n>, was trained with."""
    response = folder.parent.parent / RESPONSES / folder.parent.name
    return response if response.is_dir() else folder


@lru_cache(maxsize=8)
def _compiled(layout: Layout, ego: Policy, mate: Policy) -> Callable[[Any, Any], jax.Array]:
    """Return a function of both policies' parameters that returns the returns, float32 (REFERENCE_EPISODES,)."""
    env = Environment(layout, KEPT_STEPS)

    @jax.jit
    def play(ego_params: Any, mate_params: Any) -> jax.Array:
        players = [
            policy_player(env, ego, ego_params, EGO, REFERENCE_EPISODES),
            policy_player(env, mate, mate_params, TEAMMATE, REFERENCE_EPISODES),
        ]
        episodes, actions = jax.random.split(jax.random.key(_SEED))
        carry = init_rollout(env, players, jax.random.split(episodes, REFERENCE_EPISODES))
        return roll_out(env, players, carry, KEPT_STEPS, actions)[1].reward.sum(axis=0)

    return play
