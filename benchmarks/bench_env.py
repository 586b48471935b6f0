"""Steps/s of environments and of learning in them compared with JaxMARL's OvercookedV2: `make bench-env`.

    steps    environments alone
    ippo     IPPO on our environment behind JaxMARL's interface and on JaxMARL's own

Part `steps`: both run the same jitted loop: random actions, auto-reset, both agents' 5 x 5 observations of every step
written into a donated buffer. The peer and ours take turns, round by round; a ratio is the median over rounds of the
ratio within a round. One JSON line per layout, number of environments, and content of the buffer:

    uint8    observations as uint8 (the peer's int32 ones are cast as they are written)
    float32  observations as float32
    state    state records of ours, from which observations are rendered where used; the peer's observations as uint8

Part `ippo`: the same learner does 10 updates, compiled with either environment, in turn. It is that of
`benchmarks.ippo`, whose network is small, or with `PEER=ippo_rnn_overcooked_v2.py` JaxMARL's own, unchanged, see
`benchmarks.peers`. Where the network takes most of the time, a faster environment makes little difference.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
from icrl4aht_generation.adapters.jaxmarl_env import JaxMARLEnv
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig

from benchmarks.common import compiled_call, print_line, rates_in_turn, ratio_facts
from benchmarks.ippo import train_ippo
from benchmarks.peers import jaxmarl_environment, jaxmarl_training
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_LAYOUTS = ("coord_simple", "coord_ring", "demo_wide")
ENVIRONMENTS = (64, 1024)
WRITTEN = ("uint8", "state", "float32")
STEPS = 51_200  # in one call, of all environments together
PARTS_OF_ENVIRONMENT = ("steps", "ippo")
UPDATES = 10  # of a learner, in one call

StepEnvironments = Callable[[Any, Any, Any], tuple[Any, Any, Any]]
"""(key, state, actions int32 (N, 2)) -> state, array to write (N, ...), reward float32 (N,)."""


def our_game(layout: Layout, n: int, written: str) -> tuple[Any, StepEnvironments]:
    """Initial state and step function of n environments of ours."""
    env = Environment(layout)

    def step(key, state, actions):
        outcome = env.step(state, actions)
        if written == "state":
            return outcome.state, outcome.state.record, outcome.reward
        obs = env.observe(outcome.state)
        return outcome.state, obs.astype(jnp.float32) if written == "float32" else obs, outcome.reward

    return env.init(jax.random.split(jax.random.key(0), n)), step


def peer_game(layout: Layout, n: int, written: str) -> tuple[Any, StepEnvironments]:
    """Initial state and step function of n environments of JaxMARL's."""
    env = jaxmarl_environment(layout)
    dtype = jnp.float32 if written == "float32" else jnp.uint8

    def step(key, state, actions):
        named = {"agent_0": actions[:, 0], "agent_1": actions[:, 1]}
        obs, state, reward, _, _ = jax.vmap(env.step)(jax.random.split(key, n), state, named)
        both = jnp.stack([obs["agent_0"], obs["agent_1"]], axis=1).astype(dtype)
        return state, both, reward["agent_0"]

    return jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), n))[1], step


def rollout(game: tuple[Any, StepEnvironments], n: int) -> Callable[[], None]:
    """A compiled call that plays `STEPS` steps with random actions and waits for them; each continues from the last."""
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

    play()  # compiles
    return play


def compare_ippo(layout: Layout, config: PPOConfig, rounds: int, script: Path | None) -> None:
    """Print steps/s of one learner on our environment and on JaxMARL's, and the ratio."""
    environments = JaxMARLEnv(layout.name), jaxmarl_environment(layout)
    if script is None:
        ours, peer = (compiled_call(train_ippo(env, config), jax.random.PRNGKey(0)) for env in environments)
    else:
        ours, peer = (jaxmarl_training(script, env, config, config.updates) for env in environments)
    sizes = {name: getattr(config, name) for name in ("updates", "environments", "rollout")}
    facts = ratio_facts(rates_in_turn(ours, peer, config.total_steps, rounds), "jaxmarl", ratio_digits=2)
    learner = "benchmarks.ippo" if script is None else script.name
    print_line("env", part="ippo", layout=layout.name, learner=learner, **sizes, **facts)


@click.command()
@click.option(
    "--part",
    "parts",
    multiple=True,
    type=click.Choice(PARTS_OF_ENVIRONMENT),
    default=PARTS_OF_ENVIRONMENT,
    show_default=True,
)
@click.option("--layout", "layouts", multiple=True, default=_LAYOUTS, show_default=True)
@click.option("--environments", multiple=True, type=COUNT, default=ENVIRONMENTS, show_default=True)
@click.option("--written", multiple=True, type=click.Choice(WRITTEN), default=WRITTEN, show_default=True)
@click.option(
    "--ippo-environments", "learners", type=COUNT, default=64, show_default=True, help="Environments of `ippo`."
)
@click.option("--rollout", "steps", type=COUNT, default=64, show_default=True, help="Steps of a roll-out of `ippo`.")
@click.option("--rounds", type=COUNT, default=7, show_default=True)
@click.option(
    "--peer",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="The learner of `ippo`: a copy of JaxMARL's ippo_rnn_overcooked_v2.py.",
)
def main(
    parts: tuple[str, ...],
    layouts: tuple[str, ...],
    environments: tuple[int, ...],
    written: tuple[str, ...],
    learners: int,
    steps: int,
    rounds: int,
    peer: Path | None,
) -> None:
    """Compare steps/s of environments, and of learning in them, with JaxMARL's; one JSON line per setting."""
    if "steps" in parts:
        for name, n, what in itertools.product(layouts, environments, written):
            layout = get_layout(name)
            ours, theirs = (rollout(game(layout, n, what), n) for game in (our_game, peer_game))
            facts = ratio_facts(rates_in_turn(ours, theirs, STEPS // n * n, rounds), "jaxmarl")
            print_line("env", part="steps", layout=layout.name, environments=n, written=what, **facts)
    if "ippo" in parts:
        total, minibatches = UPDATES * learners * steps, min(learners, 8)
        config = PPOConfig(total, learners, steps, minibatches=minibatches, warmup=0.05)
        for name in layouts:
            compare_ippo(get_layout(name), config, rounds, peer)


if __name__ == "__main__":
    main()
