"""Training and acting speed of AD: `make bench-train`.

    train     steps/s and transitions/s of every size and encoder on state records, compared with the paper's encoder
              on float32 observations that a reader of the published format makes; in turn, ratios within each round
    act       the evaluator's steps/s with `cached` compared with `exact` acting, in turn
    all       minutes of all 160 test tasks with `cached` acting, compiling included, and the CPU seconds of the process

One JSON line each. Models are untrained: speed does not depend on what they know.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Generator
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, get_args

import click
import h5py
import jax
import numpy as np
from icrl4aht_baselines.agents.egos import Acting, PlayMode, learned
from icrl4aht_baselines.evaluate.evaluator import PreparedRollout, evaluate, play_episodes, prepare_rollout
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, Protocol
from icrl4aht_baselines.methods.ad import dropped_steps
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.options import SIZES, ModelOptions, ModelSize
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import plain_view
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import Trainer
from icrl4aht_generation.learners.config import EncoderKind
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_tasks

from benchmarks.common import elapsed, print_line
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import TRACKS, track_of
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.sampling.ad import ADBatch, ADSampler
from icrl4aht_data.writing.published import FROM_PUBLISHED, HISTORIES_H5, to_published

_TARGET_RATIO, _TARGET_MINUTES = 20, 6


class TrainingPlan(NamedTuple):
    """Settings of a comparison of ways to train.

    Attributes:
        encoders: kinds of encoders on state records.
        dtype: of the arithmetic, "float32" or "bfloat16".
        steps: training steps of each way in a round.
        rounds: number of rounds, after one that compiles.
    """

    encoders: tuple[EncoderKind, ...]
    dtype: str
    steps: int
    rounds: int


_print = partial(print_line, "train")


def published_batches(folder: Path, draw: ADSampler) -> Generator[ADBatch]:
    """Batches of the windows that `draw` draws, read like the published code: float32, gzip chunks of 4096 steps."""
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
        "is_first": np.arange(start, start + length) == 0,
    }


def compare_training(dataset: Dataset, size: str, options: TrainOptions, plan: TrainingPlan) -> None:
    """Train AD of a size in all ways in turn, some steps of each in every round, and print their speeds.

    One way is the paper's encoder on observations from a reader of the published format, the others are encoders on
    batches of state records.
    """
    encoders: dict[str, EncoderKind] = {"published": "paper"}
    encoders.update({name: name for name in plan.encoders})
    trainers = {}
    for way, encoder in encoders.items():
        model = ModelOptions(**SIZES[size].model | {"encoder": encoder, "bfloat16": plan.dtype == "bfloat16"})
        world = overcooked_world(dataset.layouts, encoder, plain_view if way == "published" else None)
        trainers[way] = Trainer(get_method("ad")(model, world), options)
    sampler = dataset.ad(batch_size=options.batch_size, length=options.context, seed=1)
    states: dict[str, Any] = {way: trainer.init() for way, trainer in trainers.items()}
    rates: dict[str, list[float]] = {way: [] for way in trainers}
    waited, log = dict.fromkeys(trainers, 0.0), {}
    batches = (len(trainers) - 1) * (plan.rounds * plan.steps + 1)
    with TemporaryDirectory() as folder, trainers["published"].batches(sampler, 0, batches) as ours:
        to_published(dataset, Path(folder) / "published", states=False)
        theirs = published_batches(Path(folder) / "published", sampler)
        for number in range(plan.rounds + 1):  # the first compiles
            for way, trainer in trainers.items():
                started, before = time.perf_counter(), ours.waited
                for _ in range(plan.steps if number else 1):
                    batch = next(ours) if way != "published" else jax.device_put(next(theirs), trainer.rows)
                    states[way], log[way] = jax.block_until_ready(trainer.step(states[way], batch))
                if number:
                    rates[way].append(plan.steps / (time.perf_counter() - started))
                    waited[way] += ours.waited - before
        theirs.close()
    for way, found in rates.items():
        steps_per_second = statistics.median(found)
        _print(
            part="train",
            size=size,
            way=way,
            dtype=plan.dtype,
            batch=options.batch_size,
            length=options.context,
            parameters=sum(leaf.size for leaf in jax.tree.leaves(states[way].params)),
            steps_per_second=round(steps_per_second, 4),
            transitions_per_second=round(steps_per_second * options.batch_size * options.context, 1),
            ratio_to_published=round(
                statistics.median(a / b for a, b in zip(found, rates["published"], strict=True)), 2
            ),
            loader_wait_seconds=round(waited[way], 3),
            **{name: round(float(value), 3) for name, value in log[way].items() if name == "distinct_observations"},
        )


def untrained_ad(layout: Layout, model: ModelOptions) -> tuple[Method, Any]:
    """AD for a layout's observations, and its initial parameters."""
    method = get_method("ad")(model, overcooked_world([layout], model.encoder))
    return method, method.init(jax.random.key(0))


def compare_acting(layout: Layout, size: ModelSize, steps: int, rounds: int, most: int) -> None:
    """Play some tasks of a layout in both ways in turn, some steps of each in every round, and print their speeds.

    The cached window is full, so that the time includes computing it again. Exact acting computes all K positions from
    the first step on.
    """
    method, params = untrained_ad(layout, ModelOptions(**size.model))
    context = size.context
    tasks = [task for task in published_tasks(track_of(layout.name)) if task.layout == layout][:most]
    dropped = dropped_steps(context)  # a full window is computed again after so many steps
    ways: dict[Acting, int] = {"cached": dropped * -(-10 * steps // dropped), "exact": steps}
    seconds: dict[Acting, list[float]] = {"cached": [], "exact": []}
    prepared = {}
    for acting, n in ways.items():
        protocol = dataclasses.replace(PROTOCOLS["seeded"], episodes=1, steps=n)
        prepared[acting] = prepare_rollout(_ego(method, params, context, acting), tasks, protocol)
        elapsed(lambda acting=acting: _play_episode(prepared[acting]))  # compiles
        for _ in range(-(-context // n) if acting == "cached" else 0):
            prepared[acting] = _after_episode(prepared[acting])
    for acting, n in list(ways.items()) * rounds:
        seconds[acting].append(elapsed(lambda acting=acting: _play_episode(prepared[acting])) / n)
    cached, exact = (len(tasks) / statistics.median(taken) for taken in seconds.values())
    _print(
        part="act",
        context=context,
        tasks=len(tasks),
        cached_steps_per_second=round(cached, 1),
        exact_steps_per_second=round(exact, 2),
        ratio=round(statistics.median(e / c for c, e in zip(*seconds.values(), strict=True)), 1),
        target=_TARGET_RATIO,
    )


def _ego(method: Method, params: Any, context: int, acting: Acting) -> Any:
    policy = learned(method, params, context, PlayMode(acting))
    return lambda layout: policy


def _after_episode(prepared: PreparedRollout) -> PreparedRollout:
    rollout, state, episode = prepared
    return prepared._replace(state=episode(rollout.ego.params, rollout.teammate_params, state)[0])


def _play_episode(prepared: PreparedRollout) -> None:
    for played in play_episodes(prepared, 1):
        jax.block_until_ready(played)


def evaluate_all_tasks(size: str, protocol: Protocol) -> None:
    """Print the minutes of all 160 tasks with an untrained AD for each layout, compiling included."""
    model, context = ModelOptions(**SIZES[size].model), SIZES[size].context
    tasks = [task for track in TRACKS for task in published_tasks(track)]

    def make(layout: Layout) -> Policy:
        return _ego(*untrained_ad(layout, model), context, "cached")(layout)

    cpu = time.process_time()
    seconds = elapsed(lambda: evaluate("AD", make, tasks, protocol))
    _print(
        part="all",
        size=size,
        context=context,
        tasks=len(tasks),
        episodes=protocol.episodes,
        minutes=round(seconds / 60, 2),
        cpu_seconds=round(time.process_time() - cpu, 1),
        target_minutes=_TARGET_MINUTES,
    )


PARTS_OF_TRAINING = ("train", "act", "all")
_ENCODERS: tuple[EncoderKind, ...] = get_args(EncoderKind)


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS_OF_TRAINING), default=PARTS_OF_TRAINING)
@click.option("--layout", "layout_name", default="demo_wide", show_default=True)
@click.option(
    "--size",
    "sizes",
    multiple=True,
    type=click.Choice(list(SIZES)),
    default=("tiny", "small"),
    show_default=True,
    help="Sizes to train; all tasks are played with the first one, acting is compared with the last one.",
)
@click.option("--encoder", "encoders", multiple=True, type=click.Choice(_ENCODERS), default=_ENCODERS)
@click.option("--dtype", "dtypes", multiple=True, type=click.Choice(["float32", "bfloat16"]), default=("float32",))
@click.option("--histories", type=COUNT, default=8, show_default=True, help="Bundled histories to train on.")
@click.option("--batch", type=COUNT, default=16, show_default=True)
@click.option("--length", type=COUNT, default=200, show_default=True, help="L in training.")
@click.option("--steps", type=COUNT, default=2, show_default=True, help="Training steps of each way in a round.")
@click.option("--acting-steps", type=COUNT, default=10, show_default=True, help="Exact steps in a round, 10x cached.")
@click.option("--episodes", type=COUNT, default=100, show_default=True, help="Episodes of each of the 160 tasks.")
@click.option("--tasks", type=COUNT, default=5, show_default=True, help="Tasks to compare acting on.")
@click.option("--rounds", type=COUNT, default=3, show_default=True)
def main(
    parts: tuple[str, ...],
    layout_name: str,
    sizes: tuple[str, ...],
    encoders: tuple[EncoderKind, ...],
    dtypes: tuple[str, ...],
    rounds: int,
    **numbers: int,
) -> None:
    """Compare ways of training, and cached with exact acting, and time all 160 tasks."""
    layout = get_layout(layout_name)
    if "train" in parts:
        dataset = load_icrl4aht(split="train", source="ppo", layout=layout.name, obs="state")
        dataset = dataset.select(dataset.ids[: numbers["histories"]])
        options = TrainOptions(batch_size=numbers["batch"], context=numbers["length"])
        for size, dtype in product(sizes, dtypes):
            compare_training(dataset, size, options, TrainingPlan(encoders, dtype, numbers["steps"], rounds))
    if "act" in parts:
        compare_acting(layout, SIZES[sizes[-1]], numbers["acting_steps"], rounds, numbers["tasks"])
    if "all" in parts:
        evaluate_all_tasks(sizes[0], dataclasses.replace(PROTOCOLS["seeded"], episodes=numbers["episodes"]))


if __name__ == "__main__":
    main()
