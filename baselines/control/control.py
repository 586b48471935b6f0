"""The positive control: in two small worlds where adaptation in context is possible, these models adapt.

The methods, token code, trainer and acting of the benchmark, on Bernoulli bandits (DPT beside Thompson sampling, AD
beside the algorithm that it distils) and in Dark Room (AD on goals that it was not trained on). The same model with its
context cut off must fail, or the world would not have asked for adaptation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from baselines.agents.egos import learned
from baselines.control import worlds
from baselines.methods.ad import ad
from baselines.methods.dpt import dpt
from baselines.methods.method import Method, ModelOptions
from baselines.training.trainer import Data, State, TrainOptions, train

MODEL = ModelOptions(layers=2, width=32, heads=2, dropout=0.0)
ROOM_MODEL = replace(MODEL, width=64, heads=4)


@dataclass(frozen=True)
class Size:
    """How large a control is; the defaults take some ten minutes on two cores."""

    bandit_steps: int = 100  # of a task, and of a context
    room_episodes: int = 20
    rows: int = 20_000  # histories, and tasks of DPT
    tasks: int = 200  # that are played
    updates: tuple[int, int, int] = (1500, 1500, 800)  # DPT and AD on bandits, AD in Dark Room
    learning_rates: tuple[float, float, float] = (1e-3, 1e-3, 2e-3)
    batch_size: int = 32


class Check(NamedTuple):
    """One line of the table."""

    world: str
    method: str
    what: str
    value: float
    limit: float
    passed: bool
    note: str


Done = Callable[[str, int, int, float], None]
"""(part, its updates, updates so far, loss)."""


def run_control(folder: Path, size: Size | None = None, done: Done = lambda name, of, step, loss: None) -> list[Check]:
    """Train and play all three; goes on where a stopped run of the same size ended."""
    size = size or Size()
    parts = (dpt_on_bandits, ad_on_bandits, ad_in_dark_room)
    return [
        check
        for part, updates in zip(parts, size.updates, strict=True)
        for check in part(folder / part.__name__, size, partial(done, part.__name__, updates))
    ]


def table(checks: list[Check]) -> str:
    """One line a check."""
    lines = [f"{'':4}  {'world':9}  {'method':20}  {'what':24}  {'value':>6}  {'limit':>6}"]
    for world, method, what, value, limit, passed, note in checks:
        verdict = "pass" if passed else "FAIL"
        lines.append(f"{verdict}  {world:9}  {method:20}  {what:24}  {value:6.2f}  {limit:6.2f}  {note}")
    return "\n".join(lines)


def dpt_on_bandits(folder: Path, size: Size, done: Callable[[int, float], None]) -> list[Check]:
    """DPT's regret beside Thompson sampling's, whose posterior it approximates (Lee et al. 2023)."""
    rng, small = np.random.default_rng(0), worlds.bandit()
    method = dpt(MODEL, small.world, whole_episodes=False)
    rows = [worlds.dpt_rows(count, size.bandit_steps, rng) for count in (size.rows, 256)]
    state = _train(method, MODEL, rows, size, 0, folder, done)
    return _bandit_checks("DPT", "Thompson sampling", worlds.thompson, method, state, size, rng)


def ad_on_bandits(folder: Path, size: Size, done: Callable[[int, float], None]) -> list[Check]:
    """AD's regret beside that of its source, upper confidence bounds."""
    rng, small = np.random.default_rng(1), worlds.bandit()
    method = ad(MODEL, small.world)

    def histories(count: int) -> Any:
        played = worlds.play_bandits(worlds.ucb, rng.random((count, worlds.ARMS)), size.bandit_steps, rng)
        return worlds.ad_rows(np.ones((*played[0].shape, 1), np.uint8), *played, small.episode)

    state = _train(method, MODEL, [histories(size.rows), histories(256)], size, 1, folder, done)
    return _bandit_checks("AD", "UCB", worlds.ucb, method, state, size, rng)


def _bandit_checks(
    name: str, rival: str, choose: worlds.Choose, method: Method, state: State, size: Size, rng: np.random.Generator
) -> list[Check]:
    means = rng.random((size.tasks, worlds.ARMS))

    def regret(actions: Any) -> float:
        got = np.take_along_axis(means, np.asarray(actions), axis=1)
        return float((means.max(axis=1, keepdims=True) - got).sum(axis=1).mean())

    def ours(context: int) -> float:
        policy = learned(method, state.params, context, greedy=False)
        return regret(worlds.play(worlds.bandit(), policy, jnp.asarray(means), 0, size.bandit_steps)[0])

    theirs = regret(worlds.play_bandits(choose, means, size.bandit_steps, rng)[0])
    uniform = float((means.max(axis=1) - means.mean(axis=1)).mean()) * size.bandit_steps
    limit, fails = 1.25 * theirs, 2.0 * theirs
    full, cut = ours(size.bandit_steps), ours(int(name == "AD"))
    note = f"{rival} {theirs:.1f}, uniform {uniform:.1f}"
    return [
        Check("bandits", name, "regret, at most", full, limit, full <= limit, note),
        Check("bandits", f"{name}, context cut off", "regret, at least", cut, fails, cut >= fails, note),
    ]


def ad_in_dark_room(folder: Path, size: Size, done: Callable[[int, float], None]) -> list[Check]:
    """AD's return over the episodes of a task, on goals held out from training."""
    rng, small = np.random.default_rng(2), worlds.dark_room()
    goals = np.delete(np.arange(worlds.CELLS), worlds.MIDDLE)
    held_out, known = goals[2::5], np.delete(goals, np.s_[2::5])  # every fifth, all over the room
    method = ad(ROOM_MODEL, small.world)

    def histories(count: int, some: np.ndarray) -> Any:
        cells, actions, rewards = worlds.search(rng.choice(some, count), size.room_episodes, rng)
        return worlds.ad_rows(worlds.SEEN[cells], actions, rewards, small.episode)

    rows = [histories(size.rows, known), histories(512, held_out)]
    state = _train(method, ROOM_MODEL, rows, size, 2, folder, done)
    tasks = np.resize(held_out, size.tasks)
    best = worlds.best_return(tasks)
    steps = size.room_episodes * small.episode

    def share(context: int) -> np.ndarray:
        """Of the best return, by episode."""
        policy = learned(method, state.params, context, greedy=False)
        _, rewards = worlds.play(small, policy, jnp.asarray(tasks, jnp.int32), 0, steps)
        returns = np.asarray(rewards).reshape(len(tasks), -1, small.episode).sum(axis=-1)
        return (returns / best[:, None]).mean(axis=0)

    full, cut = share(steps), share(1)
    few = max(1, size.room_episodes // 5)
    early, late, without = float(full[:few].mean()), float(full[-few:].mean()), float(cut[-few:].mean())
    note = f"share of the best return; first {few} episodes {early:.2f}"
    np.savetxt(folder / "returns.csv", np.stack([full, cut], axis=1), "%.4f", ",", header="full,cut")
    return [
        Check("dark room", "AD", f"last {few} episodes, at least", late, 0.8, late >= 0.8, note),
        Check("dark room", "AD", "gain, at least", late - early, 0.4, late - early >= 0.4, note),
        Check("dark room", "AD, context cut off", f"last {few} episodes, at most", without, 0.4, without <= 0.4, note),
    ]


def _train(
    method: Method,
    model: ModelOptions,
    rows: list[Any],
    size: Size,
    number: int,
    folder: Path,
    done: Callable[[int, float], None],
) -> State:
    """On rows, beside others that are held out."""
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
    pools = [worlds.Pool(part, size.batch_size, seed) for seed, part in enumerate(rows)]
    about = {"control": asdict(size), "model": asdict(model)}
    return train(method, Data(pools[0], {"held out": pools[1]}), options, folder, about, done=done)
