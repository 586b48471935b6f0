"""Evaluation speed per teammate family beside the environment alone: `make bench-eval`.

One JSON line per family: episode-steps/s of the evaluator with the random ego on the family's tasks of one layout, and
of the bare environment (random actions, no teammate, nothing observed) with as many tables, taken in turn. A last line
says what all 160 tasks take.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import replace
from typing import Any

import click
import jax
import jax.numpy as jnp

from baselines.agents.egos import random
from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import PROTOCOLS
from baselines.evaluate.rollout import EvaluationRollout, task_key
from generation.env import Environment
from generation.teammates.instances import published_tasks
from generation.teammates.registry import build_teammate
from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS, track_of
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_EPISODES = 20


def evaluator(layout: Layout, family: str) -> tuple[Any, int]:
    """A function that plays one episode of the family's tasks, and the number of tasks."""
    tasks = [t for t in published_tasks(track_of(layout.name)) if (t.layout, t.teammate_kind) == (layout, family)]
    mates = [build_teammate(layout, task.teammate, noise="seeded") for task in tasks]
    rollout = EvaluationRollout(layout, random(layout), mates, replace(PROTOCOLS["seeded"], episodes=_EPISODES))
    play, params = jax.jit(rollout.episode), rollout.teammate_params
    tables = rollout.start(jnp.stack([task_key(0, task.task_id) for task in tasks]))
    return lambda: play((), params, tables), len(tasks)


def bare_environment(layout: Layout, n: int) -> Any:
    """A function that plays one episode of n tables with random actions."""
    env = Environment(layout, PROTOCOLS["seeded"].steps)

    @jax.jit
    def play(state, key):
        def step(state, key):
            outcome = env.step(state, jax.random.randint(key, (n, 2), 0, 6))
            return outcome.state, outcome.reward

        return jax.lax.scan(step, state, jax.random.split(key, env.max_steps))

    state = env.init(jax.random.split(jax.random.key(0), n))
    return lambda: play(state, jax.random.key(1))


def steps_per_second(play: Any, n: int) -> float:
    started = time.perf_counter()
    for _ in range(_EPISODES):
        jax.block_until_ready(play())
    return _EPISODES * n * PROTOCOLS["seeded"].steps / (time.perf_counter() - started)


def whole_benchmark() -> dict[str, Any]:
    """The 160 test tasks of both tracks, 100 episodes each, with the random ego, compiling included."""
    tasks = [task for track in TRACKS for task in published_tasks(track)]
    started = time.perf_counter()
    evaluate("random", random, tasks, PROTOCOLS["seeded"])
    return {"benchmark": "eval-all", "tasks": len(tasks), "seconds": round(time.perf_counter() - started, 1)}


@click.command()
@click.option("--layout", "layout_name", default="demo_wide", show_default=True)
@click.option("--rounds", default=5, show_default=True)
def main(layout_name: str, rounds: int) -> None:
    """Episode-steps/s per teammate family beside the environment alone, one JSON line each, then all 160 tasks."""
    layout = get_layout(layout_name)
    for family, short in HEURISTIC_KINDS.items():
        ours, n = evaluator(layout, family)
        bare = bare_environment(layout, n)
        for warm in (ours, bare):
            jax.block_until_ready(warm())
        pairs = [(steps_per_second(ours, n), steps_per_second(bare, n)) for _ in range(rounds)]
        line = {
            "benchmark": "eval",
            "layout": layout.name,
            "family": short,
            "tasks": n,
            "steps_per_second": round(statistics.median(a for a, _ in pairs)),
            "environment_steps_per_second": round(statistics.median(b for _, b in pairs)),
            "share_of_environment_speed": round(statistics.median(a / b for a, b in pairs), 3),
        }
        click.echo(json.dumps(line))
    click.echo(json.dumps(whole_benchmark()))


if __name__ == "__main__":
    main()
