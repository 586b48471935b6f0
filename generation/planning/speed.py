"""Where a learner's time goes: environment and teammate, the ego's forward pass, the update."""

from __future__ import annotations

import time
from typing import Any

import jax

from generation.learners.ego import Learner
from generation.learners.rollout import init_rollout, random_player, roll_out
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE

_ROUNDS = 3


def learner_speed(learner: Learner, seed: int = 0) -> dict[str, float]:
    """Measured steps/s of whole updates, and the share of each part, in this process after compiling.

    The parts are timed as roll-outs of the environment with the teammate and a random ego, then roll-outs with the
    ego's network, then whole updates; each share is the difference to the one before.
    """
    config = learner.config
    state = jax.jit(learner.init)(jax.random.key(seed))
    key = jax.random.key(seed + 1)
    players = learner.players(state.params, state.teammate)
    by_chance = [random_player(EGO, config.environments), players[TEAMMATE]]
    tables = init_rollout(learner.env, by_chance, jax.random.split(key, config.environments))
    bare = _seconds(jax.jit(lambda seats: roll_out(learner.env, by_chance, seats, config.rollout, key)[0]), tables)
    forward = _seconds(jax.jit(lambda seats: roll_out(learner.env, players, seats, config.rollout, key)), state.seats)
    whole = _seconds(jax.jit(learner.update), state)
    return {
        "steps_per_second": round(config.steps_per_update / whole, 1),
        "environment_share": round(bare / whole, 4),
        "forward_share": round((forward - bare) / whole, 4),
        "update_share": round((whole - forward) / whole, 4),
    }


def _seconds(function: Any, *arguments: Any) -> float:
    """The fastest of a few calls, after one to compile."""
    jax.block_until_ready(function(*arguments))
    best = float("inf")
    for _ in range(_ROUNDS):
        started = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        best = min(best, time.perf_counter() - started)
    return best
