"""Evaluation speed per teammate family compared with the environment alone: `make bench-eval`.

One JSON line per family: episode-steps/s of the evaluator with the random ego on the family's tasks of one layout, and
of as many bare environments (random actions, no teammate, no observations), measured in turn. The last line has the
seconds of all 160 tasks.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import jax
import jax.numpy as jnp
from icrl4aht_baselines.agents.egos import random
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, task_key
from icrl4aht_generation.env import Environment
from icrl4aht_generation.teammates.instances import published_tasks
from icrl4aht_generation.teammates.registry import build_teammate

from benchmarks.common import elapsed, print_line, rates_in_turn
from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS, track_of
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_EPISODES = 20


def evaluator(layout: Layout, family: str) -> tuple[Any, int]:
    """A function that plays one episode of every task of a family, and the number of tasks."""
    tasks = [t for t in published_tasks(track_of(layout.name)) if (t.layout, t.teammate_kind) == (layout, family)]
    mates = [build_teammate(layout, task.teammate, noise="seeded") for task in tasks]
    rollout = EvaluationRollout(layout, random(layout), mates, replace(PROTOCOLS["seeded"], episodes=_EPISODES))
    play, params = jax.jit(rollout.episode), rollout.teammate_params
    environments = rollout.start(jnp.stack([task_key(0, task.task_id) for task in tasks]))
    return lambda: play((), params, environments), len(tasks)


def bare_environment(layout: Layout, n: int) -> Any:
    """A function that plays one episode of n environments with random actions."""
    env = Environment(layout, PROTOCOLS["seeded"].steps)

    @jax.jit
    def play(state, key):
        def step(state, key):
            outcome = env.step(state, jax.random.randint(key, (n, 2), 0, 6))
            return outcome.state, outcome.reward

        return jax.lax.scan(step, state, jax.random.split(key, env.max_steps))

    state = env.init(jax.random.split(jax.random.key(0), n))
    return lambda: play(state, jax.random.key(1))


def play_episodes_of(play: Callable[[], Any]) -> Callable[[], None]:
    """A function that plays `_EPISODES` episodes one after the other; compiled."""
    jax.block_until_ready(play())

    def play_all() -> None:
        for _ in range(_EPISODES):
            jax.block_until_ready(play())

    return play_all


@click.command()
@click.option("--layout", "layout_name", default="demo_wide", show_default=True)
@click.option("--rounds", type=COUNT, default=5, show_default=True)
def main(layout_name: str, rounds: int) -> None:
    """Print episode-steps/s per teammate family and of the environment alone, then the seconds of all 160 tasks."""
    layout, protocol = get_layout(layout_name), PROTOCOLS["seeded"]
    for family, short in HEURISTIC_KINDS.items():
        play, n = evaluator(layout, family)
        ours, bare = play_episodes_of(play), play_episodes_of(bare_environment(layout, n))
        pairs = rates_in_turn(ours, bare, _EPISODES * n * protocol.steps, rounds)
        print_line(
            "eval",
            layout=layout.name,
            family=short,
            tasks=n,
            steps_per_second=round(statistics.median(a for a, _ in pairs)),
            environment_steps_per_second=round(statistics.median(b for _, b in pairs)),
            share_of_environment_speed=round(statistics.median(a / b for a, b in pairs), 3),
        )
    tasks = [task for track in TRACKS for task in published_tasks(track)]
    seconds = elapsed(lambda: evaluate("random", random, tasks, protocol))  # compiling included
    print_line("eval-all", tasks=len(tasks), seconds=round(seconds, 1))


if __name__ == "__main__":
    main()
