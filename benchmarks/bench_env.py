"""Compare steps/s of environments, and of learning in them, with JaxMARL's OvercookedV2: `make bench-env`.

    steps:   environments without learning
    layouts: a different generated layout in each environment, compared with one layout, and with JaxMARL on one layout
    ippo:    JaxMARL's IPPO on our environment and on JaxMARL's environment: `PEER=file`

In the part `steps`, both environments run in the same compiled loop with random actions and automatic resets, which
writes both agents' observations in every step into a donated buffer. One JSON line is printed for each layout, number
of environments, and content of the buffer:

    uint8:   observations as uint8 (JaxMARL's int32 observations are converted)
    float32: observations as float32
    state:   our state records, from which observations can be rendered later; JaxMARL's observations as uint8

In the part `ippo`, JaxMARL's learner (a copy of `ippo_rnn_overcooked_v2.py`) makes 10 updates with either environment,
see `benchmarks.peers`. The learner's network takes most of the time, so a faster environment has less effect.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
from icrl4aht_generation.adapters.jaxmarl_env import JaxMARLEnv
from icrl4aht_generation.env import Environment
from icrl4aht_generation.layouts.families import generate_layouts
from icrl4aht_generation.learners.config import PPOConfig

from benchmarks.harness import compare_rates, measure_rates, print_line
from benchmarks.peers import jaxmarl_environment, jaxmarl_training
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_LAYOUTS = ("coord_simple", "coord_ring", "demo_wide")
_ONE = "asymm_both"  # layout for comparison in the part `layouts`
ENVIRONMENTS = (64, 1024)
WRITTEN = ("uint8", "state", "float32")
STEPS = 51_200  # total steps of all environments per measured call
UPDATES = 10  # updates of the learner per measured call

StepEnvironments = Callable[[Any, Any, Any], tuple[Any, Any, Any]]
"""Function from (key, state, actions int32 (N, 2)) to (state, array to write (N, ...), reward float32 (N,))."""


def our_game(
    layout: Layout | Sequence[Layout], n: int, written: str, canonical: bool = False
) -> tuple[Any, StepEnvironments]:
    """Return the initial state and the step function of n environments of this project, on one or several layouts."""
    env = Environment(layout)

    def step(key, state, actions):
        outcome = env.step(state, actions)
        if written == "state":
            return outcome.state, outcome.state.record, outcome.reward
        obs = env.observe(outcome.state, canonical)
        return outcome.state, obs.astype(jnp.float32) if written == "float32" else obs, outcome.reward

    return env.init(jax.random.split(jax.random.key(0), n)), step


def peer_game(layout: Layout, n: int, written: str) -> tuple[Any, StepEnvironments]:
    """Return the initial state and the step function of n JaxMARL environments on one layout."""
    env = jaxmarl_environment(layout)
    dtype = jnp.float32 if written == "float32" else jnp.uint8

    def step(key, state, actions):
        named = {"agent_0": actions[:, 0], "agent_1": actions[:, 1]}
        obs, state, reward, _, _ = jax.vmap(env.step)(jax.random.split(key, n), state, named)
        both = jnp.stack([obs["agent_0"], obs["agent_1"]], axis=1).astype(dtype)
        return state, both, reward["agent_0"]

    return jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), n))[1], step


def rollout(game: tuple[Any, StepEnvironments], n: int) -> Callable[[], None]:
    """Return a compiled function that plays `STEPS` steps with random actions, continuing from its previous call."""
    state, step = game
    steps = STEPS // n

    @partial(jax.jit, donate_argnums=2)
    def run(key, state, buffer):
        def one_step(t, carry):
            state, buffer, total = carry
            action_key, step_key = jax.random.split(jax.random.fold_in(key, t))
            actions = jax.random.randint(action_key, (n, 2), 0, 6)
            state, written, reward = step(step_key, state, actions)
            return state, jax.lax.dynamic_update_index_in_dim(buffer, written, t, 0), total + reward

        return jax.lax.fori_loop(0, steps, one_step, (state, buffer, jnp.zeros(n)))

    written = jax.eval_shape(step, jax.random.PRNGKey(0), state, jnp.zeros((n, 2), jnp.int32))[1]
    carry, number = (state, jnp.zeros((steps, *written.shape), written.dtype)), 0

    def play() -> None:
        nonlocal carry, number
        state, buffer, total = run(jax.random.PRNGKey(number), *carry)
        carry, number = (state, buffer), number + 1
        jax.block_until_ready(total)

    play()  # the first call compiles
    return play


def compare_many_layouts(n: int, rounds: int) -> None:
    """Print the speed of n environments on n generated layouts and on one layout, and of JaxMARL on this layout.

    Our observations have all canonical channels, which are more channels than this layout needs.
    """
    one = get_layout(_ONE)
    many = generate_layouts("templates", 0, n // 2) + generate_layouts("rooms", 0, n - n // 2)
    ways = {
        "ours": rollout(our_game(many, n, "uint8", canonical=True), n),
        "one": rollout(our_game(one, n, "uint8", canonical=True), n),
        "jaxmarl": rollout(peer_game(one, n, "uint8"), n),
    }
    rates = measure_rates(ways, STEPS // n * n, rounds)
    of_one = compare_rates(rates, "ours", "one")["ratio"]
    facts = {"one_layout": one.name, "ratio_to_one_layout": of_one, **compare_rates(rates, "ours", "jaxmarl")}
    print_line("env", part="layouts", layouts=len(many), environments=n, written="uint8", **facts)


@click.command()
@click.option("--layout", "layouts", multiple=True, default=_LAYOUTS, show_default=True)
@click.option("--environments", multiple=True, type=COUNT, default=ENVIRONMENTS, show_default=True)
@click.option("--written", multiple=True, type=click.Choice(WRITTEN), default=WRITTEN, show_default=True)
@click.option("--rounds", type=COUNT, default=7, show_default=True)
@click.option(
    "--peer",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="A copy of JaxMARL's ippo_rnn_overcooked_v2.py: compare it on both environments instead of the steps.",
)
@click.option("--rollout", "steps", type=COUNT, default=64, show_default=True, help="Steps of a rollout of the peer.")
def main(
    layouts: tuple[str, ...],
    environments: tuple[int, ...],
    written: tuple[str, ...],
    rounds: int,
    peer: Path | None,
    steps: int,
) -> None:
    """Compare steps/s of environments, or of learning in them, with JaxMARL; print one JSON line per setting."""
    if peer is None:
        compare_many_layouts(max(environments), rounds)
    for layout, n in itertools.product(map(get_layout, layouts), environments):
        if peer is None:
            for what in written:
                ways = {
                    "ours": rollout(our_game(layout, n, what), n),
                    "jaxmarl": rollout(peer_game(layout, n, what), n),
                }
                facts = compare_rates(measure_rates(ways, STEPS // n * n, rounds), "ours", "jaxmarl")
                print_line("env", part="steps", layout=layout.name, environments=n, written=what, **facts)
            continue
        config = PPOConfig(UPDATES * n * steps, n, steps, minibatches=min(n, 8), warmup=0.05)
        both = {"ours": JaxMARLEnv(layout.name), "jaxmarl": jaxmarl_environment(layout)}
        ways = {name: jaxmarl_training(peer, env, config, UPDATES) for name, env in both.items()}
        facts = compare_rates(measure_rates(ways, config.total_steps, rounds), "ours", "jaxmarl")
        print_line("env", part="ippo", layout=layout.name, environments=n, rollout=steps, updates=UPDATES, **facts)


if __name__ == "__main__":
    main()
