"""Measure the speed of learning, training and evaluation on a GPU: `make bench-gpu`. On a CPU, sizes are tiny.

    device:    machine, software and settings
    product:   TFLOP/s of one large matrix product; float32 products use TF32 on a GPU by default, see `measure_product`
    learner:   steps/s of PPO training of an ego with teammate H4, with the paper's network, in 1,024 environments
    train:     seconds of an AD training step (B = 1024, L = 500 for the paper's small size), and wait for the loader
    act:       steps/s of the evaluator with cached acting, on the tasks of one layout

One JSON line is printed for each case, with the error if the case fails. At the time limit the process ends, with a
line for each case without a result. Learners use XLA's deterministic operations, as in `generate`. Models are
untrained.

`mfu` is the model FLOP utilization: matrix-product operations per second of a step, including the backward pass, see
`benchmarks.harness.product_flops`, divided by the speed of the large product with the same dtype. The encoder `words`
computes equal observations of a batch once, but its operations are counted as if all observations differed.
`program_gib` is the memory that the compiler planned for a program, `process_peak_gib` the process's peak memory since
the first case, and `accumulate` the number of parts into which a batch is divided, so that it fits into memory.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, partial
from itertools import islice
from pathlib import Path
from threading import Timer
from typing import Any

import click
import jax
import jax.numpy as jnp
from icrl4aht_baselines.agents.egos import trained_policy
from icrl4aht_baselines.evaluate.evaluator import play_episodes, prepare_rollout
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.methods.ad import dropped_steps
from icrl4aht_baselines.methods.options import SIZES
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import Trainer
from icrl4aht_generation.learners.config import EncoderKind, PPOConfig, Widths
from icrl4aht_generation.learners.ego import Learner, compiled_update
from icrl4aht_generation.learners.resume import software_versions
from icrl4aht_generation.teammates.instances import published_tasks
from jax.extend.backend import get_backend

from benchmarks.bench_learn import ad_method, heuristic_learner
from benchmarks.harness import compile_and_measure, elapsed, print_line
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.system import usable_cores

_LAYOUT = "demo_wide"
_OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"


@dataclass(frozen=True)
class Sizes:
    """Sizes and durations of all measurements, by default those for a GPU.

    Attributes:
        product: side length of the square matrices in the benchmark of matrix multiplication.
        ppo: hyper-parameters of the learner, except the encoder of its network.
        batch: B, batch size in training.
        length: upper limit of L in training and of K in acting.
        episode_steps: steps of an episode in acting.
        tasks: largest number of tasks in acting.
        seconds: minimum duration of a measurement, after compilation.
    """

    product: int = 8192
    ppo: PPOConfig = field(default_factory=PPOConfig)
    batch: int = 1024
    length: int = 500
    episode_steps: int = 100
    tasks: int = 20
    seconds: float = 4.0

    def mfu(self, flops: float, seconds: float, dtype: str) -> float:
        """Return the model FLOP utilization: `flops / seconds` relative to the speed of the large product."""
        return round(flops / seconds / product_tflops(self.product, dtype, None, self.seconds / 4) / 1e12, 4)


FULL_SIZES = Sizes()
SMALL_SIZES = Sizes(
    product=256,
    ppo=PPOConfig(environments=4, rollout=8, minibatches=2),
    batch=2,
    length=16,
    episode_steps=10,
    tasks=2,
    seconds=0.05,
)


def device_memory() -> dict[str, float]:
    """Return the device memory in GiB: in use, peak of this process, and limit; empty on a CPU."""
    found = jax.local_devices()[0].memory_stats() or {}
    names = {"bytes_in_use": "in_use_gib", "peak_bytes_in_use": "process_peak_gib", "bytes_limit": "limit_gib"}
    return {name: gib(found[key]) for key, name in names.items() if key in found}


def gib(count: int) -> float:
    """Convert a number of bytes to GiB."""
    return round(count / 2**30, 3)


def call_durations(call: Callable[[], Any], seconds: float, least: int = 3) -> list[float]:
    """Call a function once for warm-up, then repeatedly for `seconds`. Return the durations of the repeated calls."""
    jax.block_until_ready(call())
    found: list[float] = []
    while len(found) < least or sum(found) < seconds:
        found.append(elapsed(lambda: jax.block_until_ready(call())))
    return found


@cache
def product_tflops(size: int, dtype: str, precision: str | None, seconds: float) -> float:
    """Return the TFLOP/s of the product of two random square matrices."""
    one, two = jax.random.normal(jax.random.key(0), (2, size, size), dtype)
    multiply = jax.jit(partial(jnp.matmul, precision=precision))

    def multiply_repeatedly() -> Any:
        return [multiply(one, two) for _ in range(5)]  # five products per call, so that overhead is negligible

    return 5 * 2 * size**3 / min(call_durations(multiply_repeatedly, seconds)) / 1e12


def describe_device(sizes: Sizes) -> dict[str, Any]:
    """Return a description of the machine, the software and the settings."""
    devices = jax.devices()
    root = Path(__file__).resolve().parent
    commit = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return {
        "device": devices[0].device_kind,
        "devices": len(devices),
        "platform_version": " ".join(get_backend().platform_version.split()),
        **software_versions(),
        "commit": commit.stdout.strip() or None,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cores": usable_cores(),
        "sizes": "full" if sizes.product == FULL_SIZES.product else "small",
        **device_memory(),
    }


def measure_product(sizes: Sizes) -> dict[str, Any]:
    """Return TFLOP/s of the large product in default float32, exact float32 and bfloat16."""
    size, seconds = sizes.product, sizes.seconds / 4
    kinds = {"float32": ("float32", None), "float32_highest": ("float32", "highest"), "bfloat16": ("bfloat16", None)}
    found = {f"tflops_{name}": product_tflops(size, *kind, seconds) for name, kind in kinds.items()}
    return {"size": size, **{name: round(value, 3) for name, value in found.items()}}


def measure_learner(sizes: Sizes, encoder: EncoderKind) -> dict[str, Any]:
    """Measure environment steps/s of PPO updates of an ego with teammate H4."""
    learner = ego_learner(sizes, encoder)
    config = learner.config
    state = jax.jit(learner.init)(jax.random.key(0))
    program = compile_and_measure(compiled_update(learner), state, xla_gpu_deterministic_ops=True)

    def update() -> Any:
        nonlocal state
        state, _, metrics = program.call(state)
        return metrics

    seconds = statistics.median(call_durations(update, sizes.seconds))
    return {
        **{name: getattr(config, name) for name in ("environments", "rollout", "minibatches", "epochs")},
        "steps_per_second": round(config.steps_per_update / seconds, 1),
        "update_seconds": round(seconds, 4),
        "compile_seconds": round(program.compile_seconds, 1),
        "mflop_per_step": round(program.flops / config.steps_per_update / 1e6, 2),
        "mfu": sizes.mfu(program.flops, seconds, "float32"),
        "program_gib": gib(program.bytes),
        **device_memory(),
    }


def measure_training(sizes: Sizes, size: str, encoder: EncoderKind, dtype: str) -> dict[str, Any]:
    """Measure training steps of AD; a batch is divided into more parts (`accumulate`) until it fits into memory."""
    parts, reason = 1, ""
    while sizes.batch % parts == 0:
        try:
            return _measure_training_steps(sizes, size, encoder, dtype, parts)
        except (jax.errors.JaxRuntimeError, MemoryError) as error:
            if not isinstance(error, MemoryError) and _OUT_OF_MEMORY not in str(error):
                raise
            reason = str(error)
        parts *= 2  # outside the except block, which keeps the arrays of the failed attempt in memory
    raise MemoryError(f"the batch does not fit into memory, even if divided into more parts: {reason}")


def _measure_training_steps(sizes: Sizes, size: str, encoder: EncoderKind, dtype: str, parts: int) -> dict[str, Any]:
    length = context_length(sizes, size)
    dataset = load_icrl4aht(split="train", source="ppo", layout=_LAYOUT, obs="state")
    options = TrainOptions(batch_size=sizes.batch, context=length, accumulate=parts)
    method = ad_method(size, dataset.layouts, encoder=encoder, bfloat16=dtype == "bfloat16")
    trainer = Trainer(method, options)
    state = trainer.init()
    with trainer.batches(dataset.ad(batch_size=sizes.batch, length=length, seed=0), 0, sys.maxsize) as batches:
        batch = next(batches)
        program = compile_and_measure(trainer.step, state, batch)
        limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", program.bytes)
        if program.bytes > limit:
            raise MemoryError(f"a batch in {parts} parts needs {gib(program.bytes)} GiB, expected at most {gib(limit)}")

        def step(take: Callable[[], Any]) -> Any:
            nonlocal state
            state, log = program.call(state, take())
            return log

        seconds = statistics.median(call_durations(partial(step, lambda: batch), sizes.seconds))
        before = batches.waited
        loaded = call_durations(partial(step, partial(next, batches)), sizes.seconds)
        waited = (batches.waited - before) / (len(loaded) + 1)
    transitions = sizes.batch * length
    return {
        "batch": sizes.batch,
        "length": length,
        "accumulate": parts,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(state.params)),
        "step_seconds": round(seconds, 4),
        "transitions_per_second": round(transitions / seconds),
        "step_seconds_with_loader": round(statistics.median(loaded), 4),
        "loader_wait_seconds_per_step": round(waited, 4),
        "compile_seconds": round(program.compile_seconds, 1),
        "mflop_per_transition": round(program.flops / transitions / 1e6, 2),
        "mfu": sizes.mfu(program.flops, seconds, dtype),
        "program_gib": gib(program.bytes),
        **device_memory(),
    }


def measure_acting(sizes: Sizes, size: str, encoder: EncoderKind, seeds: int) -> dict[str, Any]:
    """Measure the evaluator's speed with full windows: steps/s of all tasks and seeds, and milliseconds per step."""
    context = context_length(sizes, size)
    layout = get_layout(_LAYOUT)
    tasks = h4_tasks()[: sizes.tasks]
    method = ad_method(size, [layout], encoder=encoder)
    policy = trained_policy(method, method.init(jax.random.key(0)), context)
    protocol = replace(PROTOCOLS["seeded"], steps=sizes.episode_steps, episodes=sys.maxsize)
    started = time.perf_counter()
    prepared = prepare_rollout(lambda layout: policy, tasks, protocol, range(seeds))
    compile_seconds = time.perf_counter() - started
    episodes = play_episodes(prepared)
    filling, shortest = -(-context // sizes.episode_steps), 2 * -(-dropped_steps(context) // sizes.episode_steps)
    for _ in islice(episodes, filling):  # fill the windows; a full window drops a fifth of its steps
        pass
    seconds = call_durations(partial(next, episodes), sizes.seconds, least=max(3, shortest))
    streams, episode_seconds = len(tasks) * seeds, statistics.mean(seconds)
    return {
        "context": context,
        "streams": streams,
        "steps_per_second": round(streams * sizes.episode_steps / episode_seconds, 1),
        "milliseconds_per_step": round(1e3 * episode_seconds / sizes.episode_steps, 4),
        "compile_seconds": round(compile_seconds, 1),
        **device_memory(),
    }


def h4_tasks() -> list[Task]:
    """Return the test tasks with H4 teammates on the measured layout."""
    tasks = published_tasks("teammate")
    return [task for task in tasks if task.layout.name == _LAYOUT and task.teammate_family == "H4"]


def ego_learner(sizes: Sizes, encoder: EncoderKind) -> Learner:
    """Return the learner of an ego with teammate H4, with the paper's network but the given encoder."""
    return heuristic_learner(get_layout(_LAYOUT), replace(sizes.ppo, widths=Widths(encoder=encoder)))


def context_length(sizes: Sizes, size: str) -> int:
    """Return AD's window length for a named model size: L in training, K in acting."""
    return min(sizes.length, SIZES[size].train["context"])


CASES: dict[str, Callable[[Sizes], dict[str, Any]]] = {
    "device": describe_device,
    "product": measure_product,
    "learner/paper": partial(measure_learner, encoder="paper"),
    "learner/words": partial(measure_learner, encoder="words"),
    "learner/mlp": partial(measure_learner, encoder="mlp"),
    "train/small/paper/bfloat16": partial(measure_training, size="small", encoder="paper", dtype="bfloat16"),
    "train/small/paper/float32": partial(measure_training, size="small", encoder="paper", dtype="float32"),
    "act/small": partial(measure_acting, size="small", encoder="paper", seeds=1),
    "act/tiny": partial(measure_acting, size="tiny", encoder="mlp", seeds=1),
    "train/small/words/bfloat16": partial(measure_training, size="small", encoder="words", dtype="bfloat16"),
    "train/small/words/float32": partial(measure_training, size="small", encoder="words", dtype="float32"),
    "train/tiny/mlp/bfloat16": partial(measure_training, size="tiny", encoder="mlp", dtype="bfloat16"),
    "train/tiny/mlp/float32": partial(measure_training, size="tiny", encoder="mlp", dtype="float32"),
    "act/tiny/16": partial(measure_acting, size="tiny", encoder="mlp", seeds=16),
}
"""Name of a case, "part" or "part/..", -> function that measures it, in running order, least important last."""

PARTS = tuple(dict.fromkeys(name.split("/")[0] for name in CASES))


def run_case(name: str, sizes: Sizes) -> bool:
    """Measure a case, and print its line. Return whether it succeeded."""
    try:
        facts = CASES[name](sizes)
    except Exception as error:  # a failed case does not prevent the others
        print_case(name, {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"[:400]})
        return False
    print_case(name, facts)
    return True


def print_case(case: str, facts: Mapping[str, Any]) -> None:
    """Print the JSON line of a case."""
    print_line("gpu", case=case, **facts)
    sys.stdout.flush()


def stop_at_limit(pending: Sequence[str]) -> None:
    """Print an error line for each unfinished case, and end the process, since a running case cannot be interrupted."""
    for name in pending:
        print_case(name, {"error": "no time left"})
    os._exit(1)


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS), default=PARTS, help="Measure these parts.")
@click.option("--case", "cases", multiple=True, type=click.Choice(list(CASES)), help="Measure these cases only.")
@click.option("--minutes", type=float, default=9.0, show_default=True, help="Time limit of the command.")
@click.option("--small", is_flag=True, help="Use tiny sizes, as always on a CPU.")
@click.option("--seconds", type=float, help="Least time of a measurement.  [default: 4, or 0.05 for tiny sizes]")
def main(parts: tuple[str, ...], cases: tuple[str, ...], minutes: float, small: bool, seconds: float | None) -> None:
    """Measure the speed of learning, training and evaluation on a GPU, and print a JSON line for each case."""
    if "XLA_PYTHON_CLIENT_MEM_FRACTION" not in os.environ:  # JAX accepts only this variable or the next one
        os.environ.setdefault("XLA_CLIENT_MEM_FRACTION", "0.92")  # share of the GPU's memory, above JAX's default
    pending = [name for name in CASES if (name in cases if cases else name.split("/")[0] in parts)]
    limit = Timer(60 * minutes, stop_at_limit, [pending])
    limit.daemon = True  # an interrupted command does not wait for a daemon thread
    limit.start()
    sizes = FULL_SIZES
    if small or jax.default_backend() == "cpu":
        sizes = SMALL_SIZES
        jax.config.update("jax_disable_most_optimizations", True)  # optimizing would take nearly all of the time
    sizes = replace(sizes, seconds=sizes.seconds if seconds is None else seconds)
    failed = False
    while pending:
        failed |= not run_case(pending[0], sizes)
        del pending[0]  # only now, so that `stop_at_limit` prints a line for a case that is still running
    limit.cancel()
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
