"""Training and acting speed of AD: `make bench-train`.

    train     steps/s and transitions/s on state records rendered in the step, beside the same model and trainer fed
              float32 observations that a reader of the published format makes; in turn, the ratio within each round
    act       the evaluator's steps/s with `cached` beside `exact` acting, in turn
    all       what all 160 test tasks take with `cached`, compiling included

One JSON line each. Models are untrained: speed does not depend on what they know.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Generator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import h5py
import jax
import numpy as np

from baselines.agents.egos import Acting, learned
from baselines.evaluate.evaluator import PreparedRollout, evaluate, play_episodes, prepare_rollout
from baselines.evaluate.protocols import PROTOCOLS, Protocol
from baselines.methods.method import Method
from baselines.methods.options import ModelOptions
from baselines.methods.registry import get_method, overcooked_world
from baselines.methods.tokens import plain_view
from baselines.training.options import TrainOptions
from baselines.training.trainer import Trainer
from generation.policy import Policy
from generation.teammates.instances import published_tasks
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import TRACKS, track_of
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.sampling.ad import ADBatch, ADSampler
from icrl4aht_data.writing.published import FROM_PUBLISHED, HISTORIES_H5, to_published

_TARGET_RATIO, _TARGET_MINUTES = 20, 30


def say(**facts: Any) -> None:
    click.echo(json.dumps({"benchmark": "train", **facts}))


def published_batches(folder: Path, draw: ADSampler) -> Generator[ADBatch]:
    """The windows that `draw` draws, read as the published code reads: float32 observations, gzip chunks of 4096."""
    number = {int(history): k for k, history in enumerate(draw.dataset.ids)}
    length, i = draw.length, 0
    with h5py.File(folder / HISTORIES_H5, "r", rdcc_nbytes=512 * 2**20) as file:
        while True:
            rows = [
                _window(file[f"/{number[history]}"], start, length)
                for history, start in zip(*(drawn.tolist() for drawn in draw.windows(i)), strict=True)
            ]
            stacked = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
            yield ADBatch(**stacked, prev_teammate_actions=None, layouts=None)
            i += 1


def _window(group: Any, start: int, length: int) -> dict[str, np.ndarray]:
    before = max(start - 1, 0)
    actions = FROM_PUBLISHED[group["actions"][before : start + length]]
    rewards = group["rewards"][before : start + length].astype(np.float32)
    if start == 0:
        actions, rewards = np.append(np.int32(0), actions), np.append(np.float32(0), rewards)
    return {
        "obs": group["obs"][start : start + length],
        "prev_actions": actions[:-1],
        "prev_rewards": rewards[:-1],
        "target_actions": actions[1:],
        "dones": group["dones"][start : start + length].astype(bool),
        "attention_mask": np.ones(length, bool),
    }


def compare_training(dataset: Dataset, model: ModelOptions, options: TrainOptions, steps: int, rounds: int) -> None:
    """Both ways in turn: some steps of each in every round."""
    trainers = [
        Trainer(get_method("ad")(model, overcooked_world(dataset.layouts, view)), options)
        for view in (None, plain_view)
    ]
    sampler = dataset.ad(batch_size=options.batch_size, length=options.context, seed=1)
    states: list[Any] = [trainer.init() for trainer in trainers]
    rates: list[list[float]] = [[], []]
    with TemporaryDirectory() as folder, trainers[0].batches(sampler, 0, (rounds + 1) * steps) as ours:
        to_published(dataset, Path(folder) / "published", states=False)
        theirs = published_batches(Path(folder) / "published", sampler)
        waited = 0.0
        for number in range(rounds + 1):  # the first compiles
            for way, batches in enumerate((ours, theirs)):
                started, before = time.perf_counter(), ours.waited
                for _ in range(steps if number else 1):
                    batch = next(batches) if way == 0 else jax.device_put(next(batches), trainers[way].rows)
                    states[way], _ = jax.block_until_ready(trainers[way].step(states[way], batch))
                if number:
                    rates[way].append(steps / (time.perf_counter() - started))
                    waited += ours.waited - before
        theirs.close()
    median = [statistics.median(rate) for rate in rates]
    per_step = options.batch_size * options.context
    say(
        part="train",
        batch=options.batch_size,
        length=options.context,
        parameters=sum(leaf.size for leaf in jax.tree.leaves(states[0].params)),
        steps_per_second=round(median[0], 4),
        transitions_per_second=round(median[0] * per_step, 1),
        published_steps_per_second=round(median[1], 4),
        published_transitions_per_second=round(median[1] * per_step, 1),
        ratio=round(statistics.median(a / b for a, b in zip(*rates, strict=True)), 2),
        loader_wait_seconds=round(waited, 3),
    )


def untrained(layout: Layout, model: ModelOptions) -> tuple[Method, Any]:
    """AD for a layout's observations, and its parameters."""
    method = get_method("ad")(model, overcooked_world([layout]))
    return method, method.init(jax.random.key(0))


def compare_acting(layout: Layout, model: ModelOptions, context: int, steps: int, rounds: int, most: int) -> None:
    """Tasks of a layout's first family, some steps of each way in every round. Both ways compute over all K places,
    however many of them are filled."""
    method, params = untrained(layout, model)
    tasks = [task for task in published_tasks(track_of(layout.name)) if task.layout == layout][:most]
    ways: dict[Acting, int] = {"cached": 10 * steps, "exact": steps}  # an episode's own cost must not weigh
    games = [
        prepare_rollout(
            _ego(method, params, context, acting), tasks, dataclasses.replace(PROTOCOLS["seeded"], episodes=1, steps=n)
        )
        for acting, n in ways.items()
    ]
    seconds: list[list[float]] = [[], []]
    for number in range(rounds + 1):
        for way, (game, n) in enumerate(zip(games, ways.values(), strict=True)):
            taken = _seconds_per_episode(game, 1) / n
            if number:
                seconds[way].append(taken)
    rates = [len(tasks) / statistics.median(taken) for taken in seconds]
    say(
        part="act",
        context=context,
        tasks=len(tasks),
        cached_steps_per_second=round(rates[0], 1),
        exact_steps_per_second=round(rates[1], 2),
        ratio=round(statistics.median(e / c for c, e in zip(*seconds, strict=True)), 1),
        target=_TARGET_RATIO,
    )


def _ego(method: Method, params: Any, context: int, acting: Acting) -> Any:
    policy = learned(method, params, context, acting)
    return lambda layout: policy


def _seconds_per_episode(game: PreparedRollout, episodes: int) -> float:
    started = time.perf_counter()
    for played in play_episodes(game, episodes):
        jax.block_until_ready(played)
    return (time.perf_counter() - started) / episodes


def whole_benchmark(model: ModelOptions, context: int, protocol: Protocol) -> None:
    """All 160 tasks, an untrained AD for each layout, as the evaluator plays them, compiling included."""
    tasks = [task for track in TRACKS for task in published_tasks(track)]

    def make(layout: Layout) -> Policy:
        return _ego(*untrained(layout, model), context, "cached")(layout)

    started = time.perf_counter()
    evaluate("AD", make, tasks, protocol)
    say(
        part="all",
        context=context,
        tasks=len(tasks),
        episodes=protocol.episodes,
        minutes=round((time.perf_counter() - started) / 60, 2),
        target_minutes=_TARGET_MINUTES,
    )


PARTS = ("train", "act", "all")


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS), default=PARTS, show_default=True)
@click.option("--layout", "layout_name", default="demo_wide", show_default=True)
@click.option("--histories", default=8, show_default=True, help="Of the bundled release, to train on.")
@click.option("--batch", default=32, show_default=True)
@click.option("--length", default=500, show_default=True, help="L, and the K of acting.")
@click.option("--steps", default=2, show_default=True, help="Training steps of each way in a round.")
@click.option("--acting-steps", default=10, show_default=True, help="Exact steps in a round; ten times as many cached.")
@click.option("--episodes", default=100, show_default=True, help="Of each of the 160 tasks.")
@click.option("--tasks", default=5, show_default=True, help="Of a family, to compare acting on.")
@click.option("--rounds", default=3, show_default=True)
@click.option("--layers", default=4, show_default=True)
@click.option("--width", default=256, show_default=True)
def main(
    parts: tuple[str, ...],
    layout_name: str,
    histories: int,
    batch: int,
    length: int,
    steps: int,
    acting_steps: int,
    episodes: int,
    tasks: int,
    rounds: int,
    layers: int,
    width: int,
) -> None:
    """Training beside a reader of the published format, cached beside exact acting, all 160 tasks; JSON lines."""
    layout, model = get_layout(layout_name), ModelOptions(layers, width)
    if "train" in parts:
        dataset = load_icrl4aht(layout=layout.name, obs="state")
        options = TrainOptions(batch_size=batch, context=length)
        compare_training(dataset.select(dataset.ids[:histories]), model, options, steps, rounds)
    if "act" in parts:
        compare_acting(layout, model, length, acting_steps, rounds, tasks)
    if "all" in parts:
        whole_benchmark(model, length, dataclasses.replace(PROTOCOLS["seeded"], episodes=episodes))


if __name__ == "__main__":
    main()
