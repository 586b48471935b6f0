"""Trainer of all methods (paper, App. E.4), with exact resume, gradient accumulation and data parallelism.

Step i is a function of the previous state and of batch i, which is a function of (seed, i). A killed run that resumes
from its last checkpoint therefore ends with the same parameters and the same log as an uninterrupted run.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from icrl4aht_generation.learners.resume import METRICS, Checkpoints, RunLog, SaveInterval, run_lock, xla_threads
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.plotting import plot_training_log
from icrl4aht_baselines.training.loggers import check_loggers, open_loggers, write_lines
from icrl4aht_baselines.training.options import SAVE_MINUTES, TrainOptions
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, RUN_CURVES, format_versions, open_run
from icrl4aht_baselines.training.stopping import TrainingStopped, stop_signals
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import can_draw
from icrl4aht_data.sampling.batches import Batches

BATCH_AXIS = "data"
"""Name of the only axis of the device mesh, along which the rows of a batch are divided."""


StepProgress = Callable[[int, float | None], None]
"""Function for progress, called with (number of finished steps, last logged loss or None)."""


def format_loss(loss: float | None) -> str:
    """Return the loss as text for a progress bar; an empty string for None."""
    return "" if loss is None else f"loss {loss:.3f}"


def show_steps(show: Callable[..., None], name: str, steps: int) -> StepProgress:
    """Return a `StepProgress` that updates a progress bar with `show`, the function that `progress_bars` yields."""
    return lambda step, loss: show(name, step, steps, format_loss(loss))


class TrainingData(NamedTuple):
    """Samplers of a training run, with the methods `batch` and `empty` of `icrl4aht_data.sampling.base.Sampler`.

    Attributes:
        train: sampler of the batches to train on.
        validation: name of a held-out part -> sampler of its batches.
    """

    train: Any
    validation: Mapping[str, Any]


class TrainState(NamedTuple):
    """State of a training run, which is the content of a checkpoint.

    Attributes:
        params: pytree of float32 arrays.
        slow: exponential moving average of the parameters, or None.
        optimizer: state of the optimizer.
        step: int32 scalar, number of steps so far.
    """

    params: Any
    slow: Any
    optimizer: optax.OptState
    step: Int[Array, ""]


def learning_rate_schedule(options: TrainOptions) -> optax.Schedule:
    """Return the schedule of the learning rate: linear warm-up, then cosine decay to 0 (paper, App. E.4)."""
    warmup = round(options.warmup * options.steps)
    return optax.warmup_cosine_decay_schedule(0.0, options.learning_rate, warmup, max(options.steps, warmup + 1))


def training_optimizer(options: TrainOptions) -> optax.GradientTransformation:
    """Return the optimizer: AdamW on gradients that are clipped by their global norm."""
    adam = optax.adamw(learning_rate_schedule(options), weight_decay=options.weight_decay)
    return optax.chain(optax.clip_by_global_norm(options.clip), adam)


class Trainer:
    """A method's training step and validation, compiled for all devices of all processes.

    Args:
        method: method to train.
        options: settings of the training.

    Raises:
        OptionError: if `batch_size` is not a multiple of the number of devices times `accumulate`.
    """

    def __init__(self, method: Method, options: TrainOptions) -> None:
        devices = jax.devices()
        share = len(devices) * options.accumulate
        if options.batch_size % share:
            raise OptionError(
                f"batch_size = {options.batch_size}: expected a multiple of {share}, the number of devices "
                f"({len(devices)}) x accumulate ({options.accumulate})"
            )
        self.method, self.options, self._optimizer = method, options, training_optimizer(options)
        self._learning_rate = learning_rate_schedule(options)
        mesh = Mesh(np.asarray(devices), (BATCH_AXIS,))
        # Data parallelism: each device has the complete state and a share of the rows.
        # XLA averages the gradients over devices, because the result is declared to be the same on every device.
        self.rows, self._parts, self.everywhere = (
            NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((BATCH_AXIS,), (None, BATCH_AXIS), ())
        )
        same = self.everywhere
        # The state is donated, because memory may not suffice for two copies of parameters and optimizer.
        self.step = jax.jit(self._step, in_shardings=(same, self.rows), out_shardings=same, donate_argnums=0)
        self.validate = jax.jit(
            lambda state, batch: method.loss(state.params, state.slow, batch, None)[1],
            in_shardings=(same, self.rows),
            out_shardings=same,
        )

    def init(self) -> TrainState:
        """Return the state before the first training step, on the trainer's devices."""
        return jax.jit(self._initial_state, out_shardings=self.everywhere)()

    def state_like(self) -> Any:
        """Return the shapes, dtypes and shardings of the state, for restoring a checkpoint."""
        shapes = jax.eval_shape(self._initial_state)
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=self.everywhere), shapes)

    def _initial_state(self) -> TrainState:
        params = self.method.init(jax.random.key(self.options.seed))
        slow = jax.tree.map(jnp.copy, params) if self.method.slow else None
        return TrainState(params, slow, self._optimizer.init(params), jnp.int32(0))

    def _step(self, state: TrainState, batch: Any) -> tuple[TrainState, dict[str, Array]]:
        """Update the parameters on a batch. Return the new state, and the numbers to log."""
        # Dropout depends on the seed and the step only, so that a resumed run equals an uninterrupted one.
        key = jax.random.fold_in(jax.random.key(self.options.seed + 1), state.step)
        gradient, log = self._gradient(state, batch, key)
        change, optimizer = self._optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, change)
        slow = state.slow
        if self.method.slow:
            slow = optax.incremental_update(params, slow, self.method.slow)
        rate = jnp.asarray(self._learning_rate(state.step))
        norm = jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(gradient)))
        log |= {"gradient_norm": norm, "learning_rate": rate}
        return TrainState(params, slow, optimizer, state.step + 1), log

    def _gradient(self, state: TrainState, batch: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        """Return the gradient and the numbers to log, as means over a batch's parts, which are computed in turn."""
        parts = self.options.accumulate
        gradient_of = jax.value_and_grad(self.method.loss, has_aux=True)

        def part_gradient(number: Array, rows: Any) -> tuple[Any, dict[str, Array]]:
            (_, log), gradient = gradient_of(state.params, state.slow, rows, jax.random.fold_in(key, number))
            return gradient, log

        def split_rows(rows: Array) -> Array:
            """Split rows of shape (B, ..) into micro-batches of shape (parts, B / parts, ..).

            The micro-batches are interleaved, so each has rows on every device.
            """
            rows = rows.reshape(-1, parts, *rows.shape[1:]).swapaxes(0, 1)
            return jax.lax.with_sharding_constraint(rows, self._parts)

        if parts == 1:
            return part_gradient(jnp.int32(0), batch)
        # A scan stores the activations of one micro-batch at a time.
        # All rows have equal weight in the loss, so the mean gradient of micro-batches is the gradient of the batch.
        split = jax.tree.map(split_rows, batch)
        first = jax.tree.map(lambda leaf: leaf[0], split)
        shapes = jax.eval_shape(part_gradient, jnp.int32(0), first)
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        def add_part(total: Any, numbered: Any) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, part_gradient(*numbered)), None

        total, _ = jax.lax.scan(add_part, zero, (jnp.arange(parts), split))
        return jax.tree.map(lambda leaf: leaf / parts, total)

    def batches(self, sampler: Any, start: int, stop: int, prefetch: int = 2) -> Batches:
        """Return the batches on the devices; the next batch is transferred while a step runs."""
        return Batches(sampler, start, stop, prefetch=prefetch, device=self.rows)

    def validation_lines(self, state: TrainState, samplers: Mapping[str, Any], step: int) -> list[dict[str, Any]]:
        """Return a log line for each held-out part, with the means of all logged numbers over its first batches."""
        lines = []
        for name, sampler in samplers.items():
            with self.batches(sampler, 0, self.options.validation_batches, prefetch=0) as batches:
                logs = [_as_floats(self.validate(state, batch)) for batch in batches]
            if logs:
                means = {key: float(np.mean([log[key] for log in logs])) for key in logs[0]}
                lines.append({"step": step, "part": name, **means})
        return lines


class TrainingTask(NamedTuple):
    """A training run that is set up; `train` runs it in a folder.

    Attributes:
        method: method to train.
        data: samplers of the batches to train on and to validate with; unused by methods that play.
        options: settings of the training.
        about: settings of model and data for config.json.
        trainer: object that computes the steps, with the interface of `Trainer`; None to make a `Trainer`.
    """

    method: Method
    data: TrainingData
    options: TrainOptions
    about: dict[str, Any]
    trainer: Any = None

    def train(
        self,
        folder: Path,
        *,
        params: Any = None,
        log_to: Sequence[str] = (),
        done: StepProgress = lambda step, loss: None,
    ) -> Any:
        """Train up to the last step, from the start or from the last checkpoint in the folder.

        After SIGTERM or SIGINT, the running step is finished, the state is saved, and training ends. A second SIGINT
        ends training at once.

        Args:
            folder: run folder, which receives config.json, metrics.jsonl (a function of the settings), timing.jsonl,
                checkpoints/ and, if matplotlib is installed, curves.png.
            params: initial parameters, such as those of another run; by default random ones that depend on the seed.
            log_to: loggers that also receive the numbers of metrics.jsonl, see `loggers.LOGGER_NAMES`.
            done: function for progress, called after every step.

        Returns:
            The state after the last step, such as a `TrainState`.

        Raises:
            OptionError: if the folder has a run with other settings or another number of XLA threads (which changes the
                results), a batch is larger than the free memory, or the library of a logger is not installed.
            BusyError: if another process trains in the folder.
            TrainingStopped: after SIGTERM or SIGINT; the same call resumes the training with identical results.
        """
        check_loggers(log_to)
        if self.data.train is not None:
            self.data.train.empty()  # a batch larger than the free memory is refused before any file is written
        options, trainer = self.options, self.trainer or Trainer(self.method, self.options)
        config = {**format_versions(), "method": self.method.name, **self.about, "train": asdict(options)}
        with ExitStack() as stack:
            # All processes compute the same state, so only one of them writes files.
            writes = jax.process_index() == 0
            if writes:
                stack.enter_context(run_lock(folder))
            config = open_run(folder, config)
            # Bitwise equal results after a resume need the same number of threads, which determines the order of sums.
            checkpoints = Checkpoints(folder / CHECKPOINTS, config | {"xla_threads": xla_threads()})
            if checkpoints.latest is None:
                state = trainer.init()
                if params is not None:
                    placed = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), params, state.params)
                    slow = {"slow": jax.tree.map(jnp.copy, placed)} if getattr(state, "slow", None) is not None else {}
                    state = state._replace(params=placed, **slow)
            else:
                state = checkpoints.load(trainer.state_like())[0]
            first = int(state.step)
            # Log lines after the checkpoint are dropped, since their steps are computed again.
            log = stack.enter_context(closing(RunLog(folder, lambda line: line["step"] <= first)))
            loggers = stack.enter_context(open_loggers(log_to if writes else (), folder / METRICS, config))
            batches = stack.enter_context(trainer.batches(self.data.train, first, options.steps))
            # Handlers are installed after the setup, so a signal during the setup ends the process.
            stop = stack.enter_context(stop_signals())
            before = first, time.perf_counter()
            save = SaveInterval(options.steps, updates=options.save_every, seconds=60 * SAVE_MINUTES)
            loss: float | None = None
            for step, batch in enumerate(batches, start=first + 1):
                state, numbers = trainer.step(state, batch)
                last, lines = step == options.steps, []
                if step % options.log_every == 0 or last:
                    # Reading numbers waits for the device, so it is done only in steps that are logged.
                    lines.append({"step": step, "part": "train", **_as_floats(numbers)})
                    loss = lines[0]["loss"]
                done(step, loss)
                if self.data.validation and (step % options.validate_every == 0 or last):
                    lines += trainer.validation_lines(state, self.data.validation, step)
                if lines:
                    now = step, time.perf_counter()
                    steps, seconds = np.subtract(now, before)
                    log.write(*lines, timing={"step": step, "steps_per_second": round(steps / seconds, 4)})
                    before = now
                    write_lines(loggers, lines)
                saves, stopped_by = agree_on_stop(save.due(step), stop[0] if stop else 0)
                if saves or stopped_by:
                    log.sync()  # lines before a checkpoint are never computed again, so they must be on disk first
                    checkpoints.save(state, step)
                if stopped_by:
                    name = signal.Signals(stopped_by).name
                    where = f"{folder}: stopped by {name} after step {step} of {options.steps}"
                    raise TrainingStopped(stopped_by, f"{where}; repeat the command to resume from the saved state")
            if writes and can_draw():
                plot_training_log(folder / METRICS, folder / RUN_CURVES, self.method.name)
        return state


def agree_on_stop(save: bool, received: int) -> tuple[bool, int]:
    """Return whether all processes save now, and the number of the signal that stops all of them, or 0.

    All processes must save in the same step, but clocks differ, and a signal may reach only one process. Therefore
    process 0 decides when to save, and a signal to any process stops all. With several processes, this call waits for
    the running step.

    Args:
        save: whether this process is due to save; used only in process 0.
        received: number of the signal that this process received, or 0.
    """
    if jax.process_count() == 1:
        return save, received
    every_process = np.asarray(multihost_utils.process_allgather(np.array([save, received], np.int32)))
    return bool(every_process[0, 0]), int(every_process[:, 1].max())


def _as_floats(log: dict[str, Array]) -> dict[str, float]:
    return {name: float(value) for name, value in jax.device_get(log).items()}
