"""Positive control: AD and DPT must adapt in two small environments where adaptation in context is possible.

The methods, tokenizers and trainer of the benchmark are used. On Bernoulli bandits, DPT is compared with Thompson
sampling, and AD with the algorithm that it distils. AD also plays Dark Room with goals that are not in its training
data. Each model must fail when its context is cut off, which shows that the environment requires adaptation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from icrl4aht_baselines.agents.egos import PlayMode, trained_policy
from icrl4aht_baselines.control import worlds
from icrl4aht_baselines.methods.ad import ad
from icrl4aht_baselines.methods.dpt import dpt
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import StepProgress, TrainingData, TrainingTask, TrainState, show_steps

BANDIT_MODEL = ModelOptions(layers=2, width=32, heads=2, dropout=0.0)
DARK_ROOM_MODEL = replace(BANDIT_MODEL, width=64, heads=4)


@dataclass(frozen=True)
class ControlExperiment:
    """Sizes of the positive control; the defaults take about ten minutes on two cores.

    Attributes:
        bandit_steps: steps of a bandit task, and of a context.
        room_episodes: episodes of a Dark Room task.
        rows: number of training histories of AD, and of training tasks of DPT.
        tasks: number of tasks in the evaluation.
        updates: training steps of DPT on bandits, AD on bandits, and AD in Dark Room.
        learning_rates: learning rates of the same three training runs.
        batch_size: batch size of all three training runs.
    """

    bandit_steps: int = 100
    room_episodes: int = 20
    rows: int = 20_000
    tasks: int = 200
    updates: tuple[int, int, int] = (1500, 1500, 800)
    learning_rates: tuple[float, float, float] = (1e-3, 1e-3, 2e-3)
    batch_size: int = 32


class ControlCheck(NamedTuple):
    """A measured value of the positive control, and the limit that it has to satisfy.

    Attributes:
        world: name of the environment.
        method: name of the method.
        quantity: name of the measured quantity, followed by "at least" or "at most", the direction of the limit.
        value: the measured value.
        limit: lower or upper limit of the value.
        note: text with values for comparison.
    """

    world: str
    method: str
    quantity: str
    value: float
    limit: float
    note: str

    @property
    def passed(self) -> bool:
        """Whether the value satisfies the limit."""
        return self.value <= self.limit if self.quantity.endswith("at most") else self.value >= self.limit


def run_control(folder: Path, show: Callable[..., None], size: ControlExperiment | None = None) -> list[ControlCheck]:
    """Train and evaluate the three models of the positive control, and return the checks.

    A stopped run of the same size is resumed.

    Args:
        folder: folder of the training runs.
        show: function of `progress_bars` that shows the progress of a training run.
        size: sizes of the control; by default those of `ControlExperiment`.
    """
    size = size or ControlExperiment()
    parts = (dpt_on_bandits, ad_on_bandits, ad_in_dark_room)
    return [
        check
        for part, updates in zip(parts, size.updates, strict=True)
        for check in part(folder / part.__name__, size, show_steps(show, part.__name__, updates))
    ]


def format_checks(checks: list[ControlCheck]) -> str:
    """Return the checks as text, one line for each."""
    lines = [f"{'':4}  {'world':9}  {'method':20}  {'quantity':24}  {'value':>6}  {'limit':>6}"]
    for check in checks:
        world, method, quantity, value, limit, note = check
        verdict = "pass" if check.passed else "FAIL"
        lines.append(f"{verdict}  {world:9}  {method:20}  {quantity:24}  {value:6.2f}  {limit:6.2f}  {note}")
    return "\n".join(lines)


def dpt_on_bandits(folder: Path, size: ControlExperiment, done: StepProgress) -> list[ControlCheck]:
    """Compare the regret of DPT with that of Thompson sampling, which DPT approximates (Lee et al. 2023)."""
    rng, method = np.random.default_rng(0), dpt(BANDIT_MODEL, worlds.bandit().world, finished_episodes_only=False)
    rows = [worlds.dpt_bandit_batch(count, size.bandit_steps, rng) for count in (size.rows, 256)]
    state = _train(method, rows, size, 0, folder, done)
    return _bandit_checks("DPT", ("Thompson sampling", worlds.thompson), method, state, size, rng)


def ad_on_bandits(folder: Path, size: ControlExperiment, done: StepProgress) -> list[ControlCheck]:
    """Compare the regret of AD with that of its source algorithm, upper confidence bounds."""
    rng, method, rows = np.random.default_rng(1), ad(BANDIT_MODEL, worlds.bandit().world), []
    for count in (size.rows, 256):
        played = worlds.play_bandits(worlds.ucb, rng.random((count, worlds.ARMS)), size.bandit_steps, rng)
        rows.append(worlds.ad_batch_of_histories(np.ones((*played[0].shape, 1), np.uint8), *played, 0))
    state = _train(method, rows, size, 1, folder, done)
    return _bandit_checks("AD", ("UCB", worlds.ucb), method, state, size, rng)


def _bandit_checks(
    name: str,
    rival: tuple[str, worlds.BanditAlgorithm],
    method: Method,
    state: TrainState,
    size: ControlExperiment,
    rng: np.random.Generator,
) -> list[ControlCheck]:
    means = rng.random((size.tasks, worlds.ARMS))

    def regret(actions: Any) -> float:
        got = np.take_along_axis(means, np.asarray(actions), axis=1)
        return float((means.max(axis=1, keepdims=True) - got).sum(axis=1).mean())

    def model_regret(context: int) -> float:
        policy = trained_policy(method, state.params, context, PlayMode(greedy=False))
        return regret(worlds.play_small_tasks(worlds.bandit(), policy, jnp.asarray(means), 0, size.bandit_steps)[0])

    rival_regret = regret(worlds.play_bandits(rival[1], means, size.bandit_steps, rng)[0])
    uniform = float((means.max(axis=1) - means.mean(axis=1)).mean()) * size.bandit_steps
    full, cut = model_regret(size.bandit_steps), model_regret(int(name == "AD"))
    note = f"{rival[0]} {rival_regret:.1f}, uniform {uniform:.1f}"
    return [
        ControlCheck("bandits", name, "regret, at most", full, 1.25 * rival_regret, note),
        ControlCheck("bandits", f"{name}, context cut off", "regret, at least", cut, 2.0 * rival_regret, note),
    ]


def ad_in_dark_room(folder: Path, size: ControlExperiment, done: StepProgress) -> list[ControlCheck]:
    """Measure how AD's return rises over the episodes of a Dark Room task, on goals held out from training."""
    rng, small = np.random.default_rng(2), worlds.dark_room()
    goals = np.delete(np.arange(worlds.CELLS), worlds.MIDDLE)
    held_out, known = goals[2::5], np.delete(goals, np.s_[2::5])  # held-out goals are spread over the grid
    method = ad(DARK_ROOM_MODEL, small.world)

    def make_histories(count: int, some: np.ndarray) -> Any:
        cells, actions, rewards = worlds.dark_room_histories(rng.choice(some, count), size.room_episodes, rng)
        return worlds.ad_batch_of_histories(worlds.CELL_OBS[cells], actions, rewards, small.episode)

    rows = [make_histories(size.rows, known), make_histories(512, held_out)]
    state = _train(method, rows, size, 2, folder, done)
    tasks = np.resize(held_out, size.tasks)
    best = worlds.best_return(tasks)
    steps = size.room_episodes * small.episode

    def share_of_best(context: int) -> np.ndarray:
        """Return, for each episode, the return divided by the best possible return, as a mean over the tasks."""
        policy = trained_policy(method, state.params, context, PlayMode(greedy=False))
        _, rewards = worlds.play_small_tasks(small, policy, jnp.asarray(tasks, jnp.int32), 0, steps)
        returns = np.asarray(rewards).reshape(len(tasks), -1, small.episode).sum(axis=-1)
        return (returns / best[:, None]).mean(axis=0)

    full, cut = share_of_best(steps), share_of_best(1)
    few = max(1, size.room_episodes // 5)
    early, late, without = float(full[:few].mean()), float(full[-few:].mean()), float(cut[-few:].mean())
    note = f"share of the best return; first {few} episodes {early:.2f}"
    np.savetxt(folder / "returns.csv", np.stack([full, cut], axis=1), "%.4f", ",", header="full,cut")
    return [
        ControlCheck("dark room", "AD", f"last {few} episodes, at least", late, 0.8, note),
        ControlCheck("dark room", "AD", "gain, at least", late - early, 0.4, note),
        ControlCheck("dark room", "AD, context cut off", f"last {few} episodes, at most", without, 0.4, note),
    ]


def _train(
    method: Method, rows: list[Any], size: ControlExperiment, number: int, folder: Path, done: StepProgress
) -> TrainState:
    """Train on the first data set in `rows` and validate on the second, for `size.updates[number]` steps."""
    updates = size.updates[number]
    options = TrainOptions(
        steps=updates,
        batch_size=size.batch_size,
        context=rows[0][3].shape[1],
        learning_rate=size.learning_rates[number],
        log_every=100,
        validate_every=max(1, updates // 4),
        save_every=updates,
    )
    samplers = [worlds.RowSampler(part, size.batch_size, seed) for seed, part in enumerate(rows)]
    data = TrainingData(samplers[0], {"held out": samplers[1]})
    return TrainingTask(method, data, options, {"control": asdict(size)}).train(folder, done=done)
