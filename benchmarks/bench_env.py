"""Environment steps/s beside JaxMARL's OvercookedV2: `make bench-env`.

Both run the same jitted loop: random actions, auto-reset, both agents' 5 x 5 observations of every step written into a
donated buffer. The peer and ours take turns, round by round; a ratio is the median over rounds of the ratio within a
round. One JSON line per layout, number of environments and what is written:

    uint8    observations as uint8, by both (the peer's int32 ones are cast as they are written)
    float32  the same as float32
    state    ours the state record, from which observations are rendered where used; the peer's observations as uint8
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import click
import jax
import jax.numpy as jnp

from benchmarks.peers import jaxmarl_environment
from generation.env import Environment
from icrl4aht_data.overcooked.layouts import Layout, get_layout

LAYOUTS = ("coord_simple", "coord_ring", "demo_wide")
ENVIRONMENTS = (64, 1024)
WRITTEN = ("uint8", "state", "float32")
STEPS = 51_200  # of all environments together, in one call

Step = Callable[[Any, Any, Any], tuple[Any, Any, Any]]
"""(key, state, actions (N, 2)) -> state, what to write (N, ...), reward (N,)"""


def our_game(layout: Layout, n: int, written: str) -> tuple[Any, Step]:
    env = Environment(layout)

    def step(key, state, actions):
        outcome = env.step(state, actions)
        if written == "state":
            return outcome.state, outcome.state.record, outcome.reward
        obs = env.observe(outcome.state)
        return outcome.state, obs.astype(jnp.float32) if written == "float32" else obs, outcome.reward

    return env.init(jax.random.split(jax.random.key(0), n)), step


def peer_game(layout: Layout, n: int, written: str) -> tuple[Any, Step]:
    env = jaxmarl_environment(layout)
    dtype = jnp.float32 if written == "float32" else jnp.uint8

    def step(key, state, actions):
        named = {"agent_0": actions[:, 0], "agent_1": actions[:, 1]}
        obs, state, reward, _, _ = jax.vmap(env.step)(jax.random.split(key, n), state, named)
        both = jnp.stack([obs["agent_0"], obs["agent_1"]], axis=1).astype(dtype)
        return state, both, reward["agent_0"]

    return jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), n))[1], step


class Loop:
    """A compiled rollout of one game, callable round by round."""

    def __init__(self, game: tuple[Any, Step], n: int) -> None:
        self.state, step = game
        self.steps = STEPS // n
        self.n = n

        @partial(jax.jit, donate_argnums=2)
        def run(key, state, buffer):
            def one(t, carry):
                state, buffer, total = carry
                acting, playing = jax.random.split(jax.random.fold_in(key, t))
                actions = jax.random.randint(acting, (n, 2), 0, 6)
                state, seen, reward = step(playing, state, actions)
                return state, jax.lax.dynamic_update_index_in_dim(buffer, seen, t, 0), total + reward

            return jax.lax.fori_loop(0, self.steps, one, (state, buffer, jnp.zeros(n)))

        self._run = run
        actions = jnp.zeros((n, 2), jnp.int32)
        seen = jax.eval_shape(step, jax.random.PRNGKey(0), self.state, actions)[1]
        self.buffer = jnp.zeros((self.steps, *seen.shape), seen.dtype)

    def steps_per_second(self, number: int) -> float:
        started = time.perf_counter()
        key = jax.random.PRNGKey(number)
        self.state, self.buffer, total = self._run(key, self.state, self.buffer)
        jax.block_until_ready(total)
        return self.steps * self.n / (time.perf_counter() - started)


def compare(layout: Layout, n: int, written: str, rounds: int) -> dict[str, Any]:
    """One JSON line."""
    ours, peer = Loop(our_game(layout, n, written), n), Loop(peer_game(layout, n, written), n)
    for loop in (ours, peer):
        loop.steps_per_second(0)  # compiles
    pairs = [(ours.steps_per_second(r), peer.steps_per_second(r)) for r in range(1, rounds + 1)]
    ratios = [a / b for a, b in pairs]
    return {
        "benchmark": "env",
        "layout": layout.name,
        "environments": n,
        "written": written,
        "steps_per_second": round(statistics.median(a for a, _ in pairs)),
        "jaxmarl_steps_per_second": round(statistics.median(b for _, b in pairs)),
        "ratio": round(statistics.median(ratios), 1),
        "ratio_min": round(min(ratios), 1),
        "ratio_max": round(max(ratios), 1),
    }


@click.command()
@click.option("--layout", "layouts", multiple=True, default=LAYOUTS, show_default=True)
@click.option("--environments", multiple=True, type=int, default=ENVIRONMENTS, show_default=True)
@click.option("--written", multiple=True, type=click.Choice(WRITTEN), default=WRITTEN, show_default=True)
@click.option("--rounds", default=7, show_default=True)
def main(layouts: tuple[str, ...], environments: tuple[int, ...], written: tuple[str, ...], rounds: int) -> None:
    """Environment steps/s beside JaxMARL's, one JSON line per setting."""
    for name in layouts:
        for n in environments:
            for what in written:
                click.echo(json.dumps(compare(get_layout(name), n, what, rounds)))


if __name__ == "__main__":
    main()
