"""Profile of a learner's update: environment and teammate, the ego's forward pass, learning."""

from __future__ import annotations

import time
from typing import Any

import jax

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_generation.learners.ego import Learner
from icrl4aht_generation.learners.rollout import init_rollout, random_player, roll_out

_ROUNDS = 3


def learner_speed(learner: Learner, seed: int = 0) -> dict[str, float]:
    """Measure steps/s of complete updates, and the share of each part, after compiling.

    Three programs are timed: roll-outs of the environment with the teammate and a random ego, roll-outs with the ego's
    network, complete updates; each share is the difference to the program before.
    """
    config = learner.config
    state = jax.jit(learner.init)(jax.random.key(seed))
    key = jax.random.key(seed + 1)
    players = learner.players(state.params, state.teammate)
    random_players = [random_player(EGO, config.environments), players[TEAMMATE]]
    start = init_rollout(learner.env, random_players, jax.random.split(key, config.environments))
    env_only = jax.jit(lambda carry: roll_out(learner.env, random_players, carry, config.rollout, key)[0])
    with_forward = jax.jit(lambda carry: roll_out(learner.env, players, carry, config.rollout, key))
    environment = _seconds(env_only, start)
    forward = _seconds(with_forward, state.carry)
    update = _seconds(jax.jit(learner.update), state)
    return {
        "steps_per_second": round(config.steps_per_update / update, 1),
        "environment_share": round(environment / update, 4),
        "forward_share": round((forward - environment) / update, 4),
        "update_share": round((update - forward) / update, 4),
    }


def _seconds(function: Any, *arguments: Any) -> float:
    """Return the time of the fastest of a few calls, after one that compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(_ROUNDS):
        started = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - started)
    return min(times)
