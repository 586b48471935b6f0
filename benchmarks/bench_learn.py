"""Measure the speed of learning and evaluation: `make bench-learn`.

    ego:     steps/s of PPO training of an ego with teammate H4, for each profile compared with the first profile
    jaxmarl: steps/s of self-play with the paper's network, compared with JaxMARL's recurrent IPPO: `PEER=file`
    ad:      transitions/s of AD training on state records, for each encoder compared with the paper's encoder on
             float32 observations from a reader of the published format
    act:     steps/s of the evaluator with `cached` acting, compared with `exact` acting
    tasks:   minutes to evaluate all 160 test tasks with `cached` acting, including compilation

One JSON line is printed for each measurement. Models are untrained, since speed does not depend on the parameters.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import click
import jax
import numpy as np
from icrl4aht_baselines.agents.egos import Acting, PlayMode, trained_policy
from icrl4aht_baselines.evaluate.evaluator import evaluate, play_episodes, prepare_rollout
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, Protocol
from icrl4aht_baselines.methods.ad import dropped_steps
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import BatchView, plain_view
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import Trainer
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import EncoderKind, PPOConfig
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.population.fcp import FCP
from icrl4aht_generation.learners.population.population import Population
from icrl4aht_generation.learners.resume import limit_xla_threads, xla_threads
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.teammates.instances import published_tasks
from icrl4aht_generation.teammates.registry import build_teammate, heuristic_teammate

from benchmarks.bench_loader import published_reader
from benchmarks.harness import compare_rates, compiled_call, elapsed, measure_rates, print_line
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import TRACKS, layout_track
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.sampling.ad import ADBatch, ADSampler
from icrl4aht_data.utils.system import keep_freed_memory
from icrl4aht_data.writing.published import FROM_PUBLISHED, to_published

_UPDATES, _PEER_UPDATES = 3, 2  # updates per measured call
_print = partial(print_line, "learn")


def heuristic_learner(layout: Layout, config: PPOConfig) -> Learner:
    """Return a PPO learner that trains an ego with teammate H4 and the given hyper-parameters."""
    mate = build_teammate(layout, heuristic_teammate("utility_greedy", "default", 0), noise="seeded")
    return Learner(Environment(layout), mate, config)


def ego_updates(layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """Return a compiled function that updates an ego `_UPDATES` times and waits for the result."""
    learner = heuristic_learner(layout, config)
    update, state = compiled_update(learner), jax.jit(learner.init)(jax.random.key(0))

    def run() -> None:
        nonlocal state
        for _ in range(_UPDATES):
            state, *_ = update(state)
        jax.block_until_ready(state.params)

    run()
    return run


def compare_ego_profiles(layout: Layout, configs: dict[str, PPOConfig], rounds: int) -> None:
    """Print steps/s of training an ego with each profile, and the ratio to the first profile."""
    ways = {name: ego_updates(layout, config) for name, config in configs.items()}
    steps = {name: _UPDATES * config.steps_per_update for name, config in configs.items()}
    rates, first = measure_rates(ways, steps, rounds), next(iter(configs))
    for name, config in configs.items():
        sizes = {size: getattr(config, size) for size in ("environments", "rollout", "minibatches", "epochs")}
        facts = sizes | {"encoder": config.widths.encoder, "threads": xla_threads()} | compare_rates(rates, name, first)
        _print(part="ego", profile=name, layout=layout.name, **facts)


def compare_jaxmarl(script: Path, layout: Layout, environments: int, rounds: int) -> None:
    """Print steps/s of our self-play (the paper's network, encoder `words`), and the ratio to JaxMARL."""
    from benchmarks.peers import jaxmarl_environment, jaxmarl_training  # only this part needs JaxMARL

    config = PPOConfig(environments=environments, rollout=64, minibatches=min(environments, 8), warmup=0.05)
    words = replace(config, widths=replace(config.widths, encoder="words"))
    population = Population(Environment(layout), FCP(1), words)

    def train_to_the_end(key: Any) -> Any:
        start = population.init(key)
        return jax.lax.scan(lambda state, _: population.update(state), start, length=_PEER_UPDATES)

    ways = {
        "ours": compiled_call(train_to_the_end, jax.random.key(0)),
        "jaxmarl": jaxmarl_training(script, jaxmarl_environment(layout), config, _PEER_UPDATES),
    }
    rates = measure_rates(ways, _PEER_UPDATES * config.steps_per_update, rounds)
    sizes = {name: getattr(config, name) for name in ("environments", "rollout", "minibatches")}
    _print(
        part="jaxmarl", layout=layout.name, threads=xla_threads(), **sizes, **compare_rates(rates, "ours", "jaxmarl")
    )


def published_batches(folder: Path, sampler: ADSampler) -> Iterator[ADBatch]:
    """Yield the batches of a sampler, but read their windows from `folder` as the published code does.

    The action and the reward before a window are zeros, since speed does not depend on these values.
    """
    number = {int(history): k for k, history in enumerate(sampler.dataset.ids)}
    read, i = published_reader(folder, sampler.length), 0
    while True:
        ids, starts = sampler.windows(i)
        found = read(np.array([number[history] for history in ids.tolist()]), starts)
        actions, rewards = FROM_PUBLISHED[found["actions"]], found["rewards"].astype(np.float32)
        yield ADBatch(
            obs=found["obs"],
            prev_actions=np.pad(actions, ((0, 0), (1, 0)))[:, :-1],
            prev_rewards=np.pad(rewards, ((0, 0), (1, 0)))[:, :-1],
            target_actions=actions,
            dones=found["dones"].astype(bool),
            attention_mask=np.ones_like(actions, bool),
            is_first=starts[:, None] + np.arange(sampler.length) == 0,
        )
        i += 1


def ad_method(size: str, layouts: Sequence[Layout], view: BatchView | None = None, **changes: Any) -> Method:
    """Return the method AD for some layouts with the options of a model size; `changes` replace single options."""
    model = ModelOptions(**SIZES[size].model | changes)
    return get_method("ad")(model, overcooked_world(layouts, model.encoder, view))


def training_steps(trainer: Trainer, batches: Iterator[Any], steps: int) -> Callable[[], None]:
    """Return a compiled function that runs several training steps and waits for each of them."""
    state = trainer.init()

    def run(count: int = steps) -> None:
        nonlocal state
        for _ in range(count):
            state, _ = jax.block_until_ready(trainer.step(state, next(batches)))

    run(1)
    return run


def compare_training(
    dataset: Dataset, size: str, encoders: Sequence[EncoderKind], options: TrainOptions, steps: int, rounds: int
) -> None:
    """Print transitions/s of AD training for each encoder, and the ratio to the paper's encoder and data format."""
    sampler = dataset.ad(batch_size=options.batch_size, length=options.context, seed=1)
    ways: dict[str, Callable[[], None]] = {}
    loaders = {}
    with TemporaryDirectory() as folder, ExitStack() as opened:
        to_published(dataset, Path(folder) / "published", states=False)
        for way in ("published", *encoders):
            encoder: EncoderKind = "paper" if way == "published" else way
            view = plain_view if way == "published" else None
            trainer = Trainer(ad_method(size, dataset.layouts, view, encoder=encoder), options)
            if way == "published":
                found = published_batches(Path(folder) / "published", sampler)
                batches = (jax.device_put(batch, trainer.rows) for batch in found)
            else:
                batches = loaders[way] = opened.enter_context(trainer.batches(sampler, 0, sys.maxsize))
            ways[way] = training_steps(trainer, batches, steps)
        rates = measure_rates(ways, steps * options.batch_size * options.context, rounds)
    for way in encoders:
        sizes = {"batch": options.batch_size, "length": options.context, "wait_seconds": round(loaders[way].waited, 3)}
        _print(part="ad", size=size, encoder=way, **sizes, **compare_rates(rates, way, "published"))


def untrained_ad(layout: Layout, size: str, acting: Acting) -> Policy:
    """Return an untrained AD model as an ego."""
    method = ad_method(size, [layout])
    return trained_policy(method, method.init(jax.random.key(0)), SIZES[size].train["context"], PlayMode(acting))


def acting_steps(tasks: Sequence[Task], size: str, acting: Acting, steps: int) -> Callable[[], None]:
    """Return a compiled function that plays one episode of every task with full windows."""
    protocol = replace(PROTOCOLS["seeded"], steps=steps, episodes=sys.maxsize)
    policy = untrained_ad(tasks[0].layout, size, acting)
    episodes = play_episodes(prepare_rollout(lambda layout: policy, tasks, protocol))
    # Windows must be full for cached acting, because exact acting always computes all K positions.
    for _ in range(-(-SIZES[size].train["context"] // steps) if acting == "cached" else 1):
        next(episodes)
    return lambda: jax.block_until_ready(next(episodes))


def compare_acting(layout: Layout, size: str, steps: int, rounds: int, most: int) -> None:
    """Print how many steps/s a model plays in acting mode `cached`, and the ratio to the speed of mode `exact`."""
    tasks = [task for task in published_tasks(layout_track(layout.name)) if task.layout == layout][:most]
    dropped = dropped_steps(SIZES[size].train["context"])  # steps after which cached acting recomputes its window
    lengths: dict[Acting, int] = {"cached": dropped * -(-10 * steps // dropped), "exact": steps}
    ways = {acting: acting_steps(tasks, size, acting, n) for acting, n in lengths.items()}
    rates = measure_rates(ways, {acting: n * len(tasks) for acting, n in lengths.items()}, rounds)
    _print(part="act", size=size, tasks=len(tasks), **compare_rates(rates, "cached", "exact"))


def evaluate_all_tasks(size: str, protocol: Protocol) -> None:
    """Print the minutes to compile and evaluate all test tasks, with one untrained AD model for each layout."""
    tasks = [task for track in TRACKS for task in published_tasks(track)]
    seconds = elapsed(lambda: evaluate("AD", lambda layout: untrained_ad(layout, size, "cached"), tasks, protocol))
    _print(part="tasks", size=size, tasks=len(tasks), episodes=protocol.episodes, minutes=round(seconds / 60, 2))


PARTS_OF_LEARNING = ("ego", "jaxmarl", "ad", "act", "tasks")
_ENCODERS: tuple[EncoderKind, ...] = get_args(EncoderKind)


@click.command()
@click.option(
    "--part", "parts", multiple=True, type=click.Choice(PARTS_OF_LEARNING), help="[default: all; jaxmarl needs --peer]"
)
@click.option("--layout", default="demo_wide", show_default=True)
@click.option("--rounds", type=COUNT, default=5, show_default=True)
@click.option("--profile", "profiles", multiple=True, default=("mini", "cpu"), show_default=True, help="For `ego`.")
@click.option("--peer", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="JaxMARL's file.")
@click.option("--environments", type=COUNT, default=32, show_default=True, help="Environments of `jaxmarl`.")
@click.option("--size", "sizes", multiple=True, type=click.Choice(list(SIZES)), default=("tiny",), show_default=True)
@click.option("--encoder", "encoders", multiple=True, type=click.Choice(_ENCODERS), default=_ENCODERS, help="For `ad`.")
@click.option("--batch", type=COUNT, default=16, show_default=True, help="Windows in a batch of `ad`.")
@click.option("--length", type=COUNT, default=200, show_default=True, help="Steps of a window of `ad`.")
@click.option("--steps", type=COUNT, default=2, show_default=True, help="Training steps in a round of `ad`.")
@click.option("--acting-steps", type=COUNT, default=10, show_default=True, help="Exact steps in a round, 10x cached.")
@click.option("--episodes", type=COUNT, default=100, show_default=True, help="Episodes of each of the 160 tasks.")
@click.option("--tasks", type=COUNT, default=5, show_default=True, help="Tasks to compare acting on.")
def main(
    parts: tuple[str, ...],
    layout: str,
    rounds: int,
    profiles: tuple[str, ...],
    peer: Path | None,
    sizes: tuple[str, ...],
    encoders: tuple[EncoderKind, ...],
    **numbers: int,
) -> None:
    """Measure the speed of training egos and of training and evaluating sequence models; print JSON lines."""
    if "jaxmarl" in parts and not peer:
        raise click.UsageError("--part jaxmarl: expected --peer FILE, a copy of JaxMARL's ippo_rnn_overcooked_v2.py")
    keep_freed_memory()  # as all commands do
    parts, here = parts or tuple(part for part in PARTS_OF_LEARNING if peer or part != "jaxmarl"), get_layout(layout)
    loaded = {profile.name: profile for profile in map(load_profile, profiles)}
    threads = [profile.xla_threads for profile in loaded.values() if profile.xla_threads]
    if threads and set(parts) == {"ego"}:  # the other parts of this benchmark need all cores
        limit_xla_threads(threads[-1])
    if "ego" in parts:
        compare_ego_profiles(here, {name: profile.ego for name, profile in loaded.items()}, rounds)
    if "jaxmarl" in parts and peer:
        compare_jaxmarl(peer, here, numbers["environments"], rounds)
    dataset = load_icrl4aht(split="train", source="ppo", layout=here.name, obs="state")[:8]
    options = TrainOptions(batch_size=numbers["batch"], context=numbers["length"])
    for size in sizes:
        if "ad" in parts:
            compare_training(dataset, size, encoders, options, numbers["steps"], rounds)
        if "act" in parts:
            compare_acting(here, size, numbers["acting_steps"], rounds, numbers["tasks"])
        if "tasks" in parts:
            evaluate_all_tasks(size, replace(PROTOCOLS["seeded"], episodes=numbers["episodes"]))


if __name__ == "__main__":
    main()
