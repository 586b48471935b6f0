"""The one trainer (paper, App. E.4): any method on any batches; exact resume, accumulation, data-parallel.

Step i is a function of the state before it and of batch i, which is a function of (seed, i): a run that was killed goes
on from its last checkpoint to the same parameters and the same log as one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from baselines.methods.method import Method
from baselines.training.plots import plot_run
from baselines.training.run_folder import (
    CURVES,
    METRICS,
    TENSORBOARD,
    TIMING,
    Checkpoints,
    append,
    forget_after,
    open_run,
    versions,
)
from baselines.training.tensorboard import Events, check_installed
from icrl4aht_data.errors import OptionError
from icrl4aht_data.sampling.batches import Batches

PARTS = "data"
"""The mesh's one axis: rows of a batch."""


@dataclass(frozen=True)
class TrainOptions:
    """How a model is trained; the defaults are the paper's (App. E.5)."""

    steps: int = 20_000
    batch_size: int = 1024  # over all devices and processes
    context: int = 500  # steps of a window, or transitions of a context
    learning_rate: float = 1e-3
    warmup: float = 0.05  # share of the steps
    weight_decay: float = 0.0
    clip: float = 1.0  # of the gradient's global norm
    accumulate: int = 1  # parts that a batch is computed in, one after the other
    seed: int = 0
    log_every: int = 50
    validate_every: int = 1000
    validation_batches: int = 2
    save_every: int = 1000

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "context", "accumulate", "log_every", "validate_every", "save_every"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: expected at least 1")
        for name in ("learning_rate", "clip"):
            if getattr(self, name) <= 0:
                raise OptionError(f"{name} = {getattr(self, name)}: expected a positive number")
        if not 0 <= self.warmup <= 1:
            raise OptionError(f"warmup = {self.warmup}: expected a share of the steps, 0 to 1")
        if self.weight_decay < 0 or self.validation_batches < 0:
            raise OptionError("weight_decay and validation_batches: expected 0 or more")

    @property
    def schedule(self) -> optax.Schedule:
        """The learning rate: linear warm-up, then cosine to 0 (paper, App. E.4)."""
        warmup = round(self.warmup * self.steps)
        return optax.warmup_cosine_decay_schedule(0.0, self.learning_rate, warmup, max(self.steps, warmup + 1))

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """AdamW on clipped gradients."""
        adam = optax.adamw(self.schedule, weight_decay=self.weight_decay)
        return optax.chain(optax.clip_by_global_norm(self.clip), adam)


class Data(NamedTuple):
    """Samplers: sequences of batches, with the methods `batch` and `empty` of `icrl4aht_data.sampling.base.Sampler`."""

    train: Any
    validation: Mapping[str, Any]


class State(NamedTuple):
    """What a checkpoint holds."""

    params: Any
    slow: Any  # a slowly following copy of the parameters, or None
    optimizer: optax.OptState
    step: Int[Array, ""]


class Trainer:
    """A method's training step and validation, compiled for the devices there are.

    Args:
        method: what to train.
        options: how.
        devices: all, over all processes, by default.

    Raises:
        OptionError: if a batch cannot be divided among devices and parts.
    """

    def __init__(self, method: Method, options: TrainOptions, devices: Any = None) -> None:
        devices = jax.devices() if devices is None else devices
        share = len(devices) * options.accumulate
        if options.batch_size % share:
            raise OptionError(
                f"batch_size = {options.batch_size}: expected a multiple of {share}, {len(devices)} devices x "
                f"{options.accumulate} parts"
            )
        self.method, self.options = method, options
        mesh = Mesh(np.asarray(devices), (PARTS,))
        self.rows, self._parts, self.everywhere = (
            NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((PARTS,), (None, PARTS), ())
        )
        same = self.everywhere
        self.step = jax.jit(self._step, in_shardings=(same, self.rows), out_shardings=same, donate_argnums=0)
        self.validate = jax.jit(self._validate, in_shardings=(same, self.rows), out_shardings=same)

    def init(self) -> State:
        """The state before the first step."""
        return jax.jit(self.fresh, out_shardings=self.everywhere)()

    def fresh(self) -> State:
        """The same, wherever it is computed."""
        params = self.method.init(jax.random.key(self.options.seed))
        slow = jax.tree.map(jnp.copy, params) if self.method.slow else None
        return State(params, slow, self.options.optimizer.init(params), jnp.int32(0))

    def _step(self, state: State, batch: Any) -> tuple[State, dict[str, Array]]:
        """One update; what to log."""
        options = self.options
        key = jax.random.fold_in(jax.random.key(options.seed + 1), state.step)
        gradient_of = jax.value_and_grad(self.method.loss, has_aux=True)

        def part(number: Array, rows: Any) -> tuple[Any, dict[str, Array]]:
            (_, log), gradient = gradient_of(state.params, state.slow, rows, jax.random.fold_in(key, number))
            return gradient, log

        if options.accumulate == 1:
            gradient, log = part(jnp.int32(0), batch)
        else:
            parts = jax.tree.map(self._in_parts, batch)
            first = jax.tree.map(lambda leaf: leaf[0], parts)
            zero = jax.tree.map(
                lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(part, jnp.int32(0), first)
            )

            def add(total: Any, numbered: Any) -> tuple[Any, None]:
                return jax.tree.map(jnp.add, total, part(*numbered)), None

            total, _ = jax.lax.scan(add, zero, (jnp.arange(options.accumulate), parts))
            gradient, log = jax.tree.map(lambda leaf: leaf / options.accumulate, total)
        change, optimizer = options.optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, change)
        slow = state.slow
        if self.method.slow:
            slow = optax.incremental_update(params, slow, self.method.slow)
        rate = jnp.asarray(options.schedule(state.step))
        norm = jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(gradient)))
        log |= {"gradient_norm": norm, "learning_rate": rate}
        return State(params, slow, optimizer, state.step + 1), log

    def _in_parts(self, rows: Array) -> Array:
        """(B, ..) -> (accumulate, B / accumulate, ..): every part has rows of every device."""
        parts = rows.reshape(-1, self.options.accumulate, *rows.shape[1:]).swapaxes(0, 1)
        return jax.lax.with_sharding_constraint(parts, self._parts)

    def _validate(self, state: State, batch: Any) -> dict[str, Array]:
        return self.method.loss(state.params, state.slow, batch, None)[1]

    def batches(self, sampler: Any, start: int, stop: int, prefetch: int = 2) -> Batches:
        """Batches on the devices, the next one's transfer running beside a step."""
        return Batches(sampler, start, stop, prefetch=prefetch, device=self.rows)


def train(
    method: Method,
    data: Data,
    options: TrainOptions,
    folder: Path,
    about: Mapping[str, Any],
    *,
    devices: Any = None,
    tensorboard: bool = False,
    done: Callable[[int, float], None] = lambda step, loss: None,
) -> State:
    """Train, or go on with what is in the folder; to its end.

    Args:
        method: what to train.
        data: batches of `options.batch_size` rows.
        options: how.
        folder: config.json, metrics.jsonl (a function of the settings), timing.jsonl, curves.png, checkpoints/.
        about: the rest of config.json: what the run is of.
        devices: all by default.
        tensorboard: also write the log for TensorBoard, into tensorboard/.
        done: called with a step and its loss whenever they are logged.

    Returns:
        The state after the last step.

    Raises:
        OptionError: if the folder holds a run of other settings, or tensorboardX is not installed.
    """
    if tensorboard:
        check_installed()
    trainer = Trainer(method, options, devices)
    config = {**versions(), "method": method.name, **about, "train": asdict(options)}
    checkpoints, events = Checkpoints(folder), None
    try:
        there = open_run(folder, config) and checkpoints.latest is not None
        state = _restored(checkpoints, trainer) if there else trainer.init()
        first, writes = int(state.step), jax.process_index() == 0
        if writes:
            for name in (METRICS, TIMING):
                forget_after(folder / name, first)
            events = Events(folder / TENSORBOARD, folder / METRICS) if tensorboard else None
        clock = _Clock(first)
        with trainer.batches(data.train, first, options.steps) as batches:
            for number, batch in enumerate(batches, start=first + 1):
                state, log = trainer.step(state, batch)
                last = number == options.steps
                lines = []
                if number % options.log_every == 0 or last:
                    lines.append({"step": number, "part": "train", **_numbers(log)})
                    done(number, lines[0]["loss"])
                if number % options.validate_every == 0 or last:
                    lines += _validation(trainer, state, data.validation, number)
                if writes and lines:
                    append(folder / METRICS, lines)
                    append(folder / TIMING, [clock.line(number, batches.waited)])
                if events and lines:
                    events.add(lines)
                if number % options.save_every == 0 or last:
                    checkpoints.save(number, *_parts_of(state))
    finally:
        checkpoints.close()
        if events:
            events.close()
    if writes:
        plot_run(folder / METRICS, folder / CURVES, method.name)
    return state


def _parts_of(state: State) -> tuple[Any, Any]:
    """What acting needs, and what only training does."""
    rest = {"optimizer": state.optimizer, "step": state.step}
    return state.params, rest if state.slow is None else rest | {"slow": state.slow}


def _restored(checkpoints: Checkpoints, trainer: Trainer) -> State:
    def like(leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=trainer.everywhere)

    fresh = jax.tree.map(like, jax.eval_shape(trainer.fresh))
    found = checkpoints.restore(*_parts_of(fresh))
    return State(found.params, found.rest.get("slow"), found.rest["optimizer"], found.rest["step"])


def _validation(trainer: Trainer, state: State, samplers: Mapping[str, Any], step: int) -> list[dict[str, Any]]:
    """The mean of every logged number over the first batches of each held-out part."""
    lines = []
    for name, sampler in samplers.items():
        with trainer.batches(sampler, 0, trainer.options.validation_batches, prefetch=0) as batches:
            logs = [_numbers(trainer.validate(state, batch)) for batch in batches]
        if logs:
            lines.append(
                {"step": step, "part": name} | {key: float(np.mean([log[key] for log in logs])) for key in logs[0]}
            )
    return lines


def _numbers(log: dict[str, Array]) -> dict[str, float]:
    return {name: float(value) for name, value in jax.device_get(log).items()}


class _Clock:
    """Steps per second since it was last asked."""

    def __init__(self, step: int) -> None:
        self._step, self._time, self._waited = step, time.perf_counter(), 0.0

    def line(self, step: int, waited: float) -> dict[str, Any]:
        now = time.perf_counter()
        seconds = now - self._time
        line = {
            "step": step,
            "steps_per_second": round((step - self._step) / seconds, 4),
            "loader_wait": round((waited - self._waited) / seconds, 4),  # share of the time
        }
        self._step, self._time, self._waited = step, now, waited
        return line
