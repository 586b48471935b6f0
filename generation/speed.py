"""Where a learner's time goes: environment and teammate, the ego's forward pass, the update."""

from __future__ import annotations

import time
from typing import Any

import jax

from generation.learners.ppo import Learner, Seats

_ROUNDS = 3


def learner_speed(learner: Learner, seed: int = 0) -> dict[str, float]:
    """Measured steps/s of whole updates, and the share of each part, in this process after compiling.

    The parts are timed as roll-outs of the environment with the teammate and a random ego, then roll-outs with the
    ego's network, then whole updates; each share is the difference to the one before.
    """
    state = jax.jit(learner.init)(jax.random.key(seed))
    key = jax.random.key(seed + 1)

    def tables_only(seats: Seats) -> Any:
        def step(seats: Seats, key):
            ego = jax.random.randint(key, seats.ended.shape, 0, 6)
            return learner.take_turn(seats, ego, seats.hidden, key)[0], None

        return jax.lax.scan(step, seats, jax.random.split(key, learner.config.rollout))[0]

    tables = _seconds(jax.jit(tables_only), state.seats)
    forward = _seconds(jax.jit(lambda params, seats: learner.roll_out(params, seats, key)), state.params, state.seats)
    whole = _seconds(jax.jit(learner.update), state)
    return {
        "steps_per_second": round(learner.config.steps_per_update / whole, 1),
        "environment_share": round(tables / whole, 4),
        "forward_share": round((forward - tables) / whole, 4),
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
