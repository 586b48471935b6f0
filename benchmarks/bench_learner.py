"""Learning speed: `make bench-learner`.

    speed     environment steps/s of an ego that learns with a heuristic teammate, by profile, in turn
    parts     where an update's time goes: each part by itself, and FLOP/s compared with one large matrix product
    peer      self-play with the paper's network compared with JaxMARL's recurrent IPPO: `PEER=file`

One JSON line each. XLA takes the threads that the profiles fix. The peer is JaxMARL's
`baselines/IPPO/ippo_rnn_overcooked_v2.py`, which its package does not contain: give the path of a copy. Both learn on
the same map with the same network, environments and hyper-parameters, in turn in one process.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import jax
import jax.numpy as jnp
import optax
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.encoder import WindowEncoder
from icrl4aht_generation.learners.network import GRU
from icrl4aht_generation.learners.population.fcp import FCP
from icrl4aht_generation.learners.population.population import Population
from icrl4aht_generation.learners.ppo import ppo_optimizer
from icrl4aht_generation.learners.resume import limit_xla_threads, xla_threads
from icrl4aht_generation.learners.rollout import roll_out
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.teammates.registry import build_teammate, heuristic_teammate

from benchmarks.common import compiled_call, elapsed, print_line, rates_in_turn, ratio_facts
from benchmarks.flops import compile_measured
from icrl4aht_data.commands.options import COUNT, LAYOUT
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_UPDATES, _PEER_UPDATES, _CALLS, _MATRIX = 3, 2, 10, 2048


def heuristic_learner(layout: Layout, config: PPOConfig) -> Learner:
    """An ego with these hyper-parameters and teammate H4."""
    mate = build_teammate(layout, heuristic_teammate("utility_greedy", "default", 0), noise="seeded")
    return Learner(Environment(layout), mate, config)


class Runner:
    """A learner that runs; its update is compiled and warm.

    Attributes:
        learner: the learner.
        state: its state.
    """

    def __init__(self, layout: Layout, config: PPOConfig) -> None:
        self.learner = heuristic_learner(layout, config)
        self._update = compiled_update(self.learner)
        self.state = jax.jit(self.learner.init)(jax.random.key(0))
        self.run(2)

    def run(self, updates: int = _UPDATES) -> None:
        """Does some updates and waits for the last one."""
        for _ in range(updates):
            self.state, _, _ = self._update(self.state)
        jax.block_until_ready(self.state.params)


def compare_profiles(layout: Layout, configs: dict[str, PPOConfig], rounds: int) -> None:
    """Print steps/s of every profile's ego; they take turns, so that all meet the same load of the machine."""
    runners = {name: Runner(layout, config) for name, config in configs.items()}
    steps = {name: _UPDATES * config.steps_per_update for name, config in configs.items()}
    rates = [{name: steps[name] / elapsed(runner.run) for name, runner in runners.items()} for _ in range(rounds)]
    first = next(iter(configs))
    for name, config in configs.items():
        print_line(
            "learner",
            part="speed",
            profile=name,
            layout=layout.name,
            threads=xla_threads(),
            encoder=config.widths.encoder,
            environments=config.environments,
            rollout=config.rollout,
            minibatches=config.minibatches,
            epochs=config.epochs,
            steps_per_second=round(statistics.median(rate[name] for rate in rates)),
            **{f"ratio_to_{first}": round(statistics.median(rate[name] / rate[first] for rate in rates), 2)},
        )


class Part(NamedTuple):
    """A part of an update.

    Attributes:
        seconds: in an update.
        flops: floating-point operations of its matrix products in an update.
        calls: how often it is computed in an update.
    """

    seconds: float
    flops: float = 0.0
    calls: int = 1


def update_parts(layout: Layout, config: PPOConfig) -> tuple[float, dict[str, Part]]:
    """Seconds of an update, and its parts.

    Encoder, recurrent layer and all layers are timed forward and backward on a minibatch of a real roll-out, as often
    as in an update, in one program each. What all layers take in addition to the first two are the heads.
    """
    runner = Runner(layout, config)
    learner, state, widths = runner.learner, runner.state, config.widths

    def play(state: Any) -> Any:
        players = learner.players(state.params, state.teammate)
        return roll_out(learner.env, players, state.carry, config.rollout, state.key)[1]

    rollout = jax.jit(play)(state)
    batch, calls = config.environments // config.minibatches, config.epochs * config.minibatches
    seen = jax.tree.map(lambda leaf: leaf[:, :batch], learner.view(rollout.record))
    reset, hidden = rollout.reset[:, :batch], jnp.zeros((batch, widths.gru))
    features = jax.random.normal(jax.random.key(1), (config.rollout, batch, widths.dense))
    encoder = WindowEncoder(
        widths.dense, widths.encoder, widths.pointwise, widths.spatial, normalize=True, view=learner.view
    )
    recurrent, optimizer = GRU(widths.gru), ppo_optimizer(config)

    def encode(params: Any) -> Any:
        encoded: Any = encoder.apply({"params": params}, seen)
        return jnp.vdot(encoded, features)

    def recur(inputs: Any) -> Any:
        params, features = inputs
        states: Any = recurrent.apply({"params": params}, hidden, features, reset)
        return (states[1] ** 2).sum()

    def apply_network(params: Any) -> Any:
        result: Any = learner.network.apply({"params": params}, hidden, seen, reset)
        _, logits, value = result
        return (jax.nn.log_softmax(logits)[..., 0] ** 2).sum() + (value**2).sum()

    def optimise(carry: Any) -> Any:
        params, memory = carry
        change, memory = optimizer.update(params, memory, params)
        return optax.apply_updates(params, change), memory

    params = state.params["params"]
    of_encoder = _time_loop(_descend(encode), params["encoder"], calls)
    of_recurrent = _time_loop(_descend(recur), (params["gru"], features), calls)
    of_network = _time_loop(_descend(apply_network), params, calls)
    others = zip(of_network, of_encoder, of_recurrent, strict=True)
    seconds, flops = (max(0.0, whole - one - other) for whole, one, other in others)
    parts = {
        "roll-out": Part(*_time_call(play, state)),
        "rendering": Part(*_time_call(learner.view, rollout.record)),
        "encoder": Part(*of_encoder, calls),
        "recurrent layer": Part(*of_recurrent, calls),
        "heads": Part(seconds, flops, calls),
        "optimiser": Part(*_time_loop(optimise, (state.params, state.optimizer), calls), calls),
    }
    return min(elapsed(lambda: runner.run(1)) for _ in range(_CALLS)), parts


def print_parts(layout: Layout, name: str, config: PPOConfig) -> None:
    """Print the share of each part of an update, and FLOP/s compared with one large matrix product.

    The line "rest" is what the parts do not explain: shuffling, advantages, the loss itself, and the overhead of many
    small operations.
    """
    matrix = jax.random.normal(jax.random.key(0), (_MATRIX, _MATRIX))
    seconds, flops = _time_call(lambda a: a @ a, matrix)
    print_line(
        "learner", part="matrix product", size=_MATRIX, threads=xla_threads(), gflops=round(flops / seconds / 1e9, 1)
    )
    total, parts = update_parts(layout, config)
    rest = Part(total - sum(part.seconds for part in parts.values()))
    for what, part in (parts | {"rest": rest, "update": Part(total)}).items():
        rate = {"gflops": round(part.flops / part.seconds / 1e9, 1)} if part.flops and part.seconds else {}
        print_line(
            "learner",
            part="parts",
            profile=name,
            layout=layout.name,
            what=what,
            calls=part.calls,
            milliseconds=round(1000 * part.seconds, 3),
            share=round(part.seconds / total, 3),
            **rate,
        )


def _time_call(function: Callable[..., Any], *arguments: Any) -> tuple[float, float]:
    """Seconds of a call, the fastest of some, and the floating-point operations of its matrix products."""
    program = compile_measured(jax.jit(function), *arguments)
    calls = [elapsed(lambda: jax.block_until_ready(program.call(*arguments))) for _ in range(_CALLS)]
    return min(calls), program.flops


def _time_loop(step: Callable[[Any], Any], carry: Any, calls: int) -> tuple[float, float]:
    """Seconds and operations of calls that each take the result of the one before, in one program."""
    return _time_call(lambda carry: jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=calls)[0], carry)


def _descend(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A step down the gradient, which makes every call depend on the one before."""
    return lambda point: jax.tree.map(lambda x, slope: x - 1e-6 * slope, point, jax.grad(function)(point))


def our_training(layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """A compiled call of our training: initialisation and `_PEER_UPDATES` updates."""
    population = Population(Environment(layout), FCP(1), config)

    def train_through(key):
        state = population.init(key)
        return jax.lax.scan(lambda state, _: population.update(state), state, length=_PEER_UPDATES)

    return compiled_call(train_through, jax.random.key(0))


def compare_peer(peer: Path, layout: Layout, config: PPOConfig, rounds: int) -> None:
    """Print steps/s of self-play learning with the paper's network, ours with encoder `words`, and the ratio."""
    from benchmarks.peers import jaxmarl_environment, jaxmarl_training  # only the peer needs JaxMARL

    words = replace(config, widths=replace(config.widths, encoder="words"))
    ours = our_training(layout, words)
    theirs = jaxmarl_training(peer, jaxmarl_environment(layout), config, _PEER_UPDATES)
    pairs = rates_in_turn(ours, theirs, _PEER_UPDATES * config.steps_per_update, rounds)
    sizes = {name: getattr(config, name) for name in ("environments", "rollout", "minibatches")}
    print_line(
        "learner",
        part="peer",
        layout=layout.name,
        threads=xla_threads(),
        **sizes,
        **ratio_facts(pairs, "jaxmarl", 1, 2),
    )


@click.command()
@click.option(
    "--part", "parts", multiple=True, type=click.Choice(["speed", "parts", "peer"]), default=("speed", "parts")
)
@click.option(
    "--profile", "names", multiple=True, default=("mini", "cpu"), show_default=True, help="Profiles to compare."
)
@click.option("--layout", type=LAYOUT, default="demo_wide", show_default=True, help="Layout of `speed` and `parts`.")
@click.option(
    "--peer", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="The peer's file, for `peer`."
)
@click.option("--peer-layout", type=LAYOUT, default="cramped_up", show_default=True, help="Layout of `peer`.")
@click.option("--environments", type=COUNT, default=32, show_default=True, help="Environments of `peer`.")
@click.option("--rounds", type=COUNT, default=5, show_default=True)
def main(
    parts: tuple[str, ...],
    names: tuple[str, ...],
    layout: str,
    peer: Path | None,
    peer_layout: str,
    environments: int,
    rounds: int,
) -> None:
    """Print the speed of learning by profile, where its time goes, and a comparison with JaxMARL's IPPO."""
    if "peer" in parts and not peer:
        raise click.UsageError("--part peer: expected --peer FILE, a copy of JaxMARL's ippo_rnn_overcooked_v2.py")
    profiles = [load_profile(name) for name in names]
    configs = {profile.name: profile.ego for profile in profiles}
    if profiles[-1].xla_threads and set(parts) != {"peer"}:
        limit_xla_threads(profiles[-1].xla_threads)
    if "speed" in parts:
        compare_profiles(get_layout(layout), configs, rounds)
    if "parts" in parts:
        for name, config in configs.items():
            print_parts(get_layout(layout), name, config)
    if "peer" in parts and peer:
        config = replace(PPOConfig(), warmup=0.05, environments=environments, rollout=64, minibatches=8)
        compare_peer(peer, get_layout(peer_layout), config, rounds)


if __name__ == "__main__":
    main()
