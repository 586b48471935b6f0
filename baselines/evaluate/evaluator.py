"""The one evaluator: any ego on any tasks, under a named protocol (paper, Sec. 4.3).

A task is 100 episodes of 100 steps in sequence; the ego's memory lives through the task, the teammate's through an
episode. The key of an episode is a function of (seed, task_id, episode) alone, so a task's result is the same whatever
ran beside it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from baselines.agents.host import HostPolicy
from baselines.evaluate.protocols import Protocol
from baselines.evaluate.results import Result, _store, _stored
from baselines.evaluate.rollout import Episode, EvaluationRollout, RolloutState, task_key
from generation.policy import Policy
from generation.teammates.registry import build, check_theta
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.threads import usable_cores


def evaluate(
    agent: str,
    make_ego: Callable[[Layout], Policy | HostPolicy],
    tasks: Sequence[Task],
    protocol: Protocol,
    *,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
    out: Path | None = None,
    details: dict[str, Any] | None = None,
    done: Callable[[int], None] = lambda tasks: None,
) -> list[Result]:
    """Evaluate an ego.

    Args:
        agent: its name, part of the settings.
        make_ego: the ego for a layout.
        tasks: any tasks; those of one layout and family run together.
        protocol: see `PROTOCOLS`.
        seeds: each plays every task once, all in one batch.
        suite: the folder that learned teammates' checkpoints are in.
        out: a folder for one JSON per task; results of the same settings found there are taken instead of run again.
        details: what else the ego's results depend on, part of the settings.
        done: called with the number of tasks finished, for progress.

    Returns:
        One result per task, in the order of `tasks`.

    Raises:
        OptionError: if `out` holds results of other settings, or the ego's action is not one integer.
        TaskFormatError: for a teammate whose parameters are not possible; names the task.
    """
    for task in tasks:
        _check_teammate(task, suite)
    settings = {
        "agent": agent,
        "seeds": list(seeds),
        "protocol": asdict(protocol),
        "code_version": version("icrl4aht-data"),
    } | ({"details": details} if details else {})
    results = {task.task_id: found for task in tasks if (found := _stored(out, task, settings))}
    done(len(results))
    groups: dict[tuple[str, str], list[Task]] = defaultdict(list)
    for task in tasks:
        if task.task_id not in results:
            groups[task.layout_name, task.teammate_kind].append(task)

    layouts = {group[0].layout.name: group[0].layout for group in groups.values()}
    egos = {name: make_ego(layout) for name, layout in layouts.items()}
    outside = any(isinstance(ego, HostPolicy) for ego in egos.values())

    def run(group: list[Task], stopped: Event) -> list[Result]:
        game = prepare_rollout(lambda layout: egos[layout.name], group, protocol, seeds, suite)
        return _run_group(group, game, len(seeds), settings, stopped)

    for found in _side_by_side(run, list(groups.values()), threads=1 if outside else min(4, usable_cores())):
        for result in found:
            results[result.task_id] = result
            _store(out, result)
        done(len(found))
    return [results[task.task_id] for task in tasks]


def _check_teammate(task: Task, suite: Path | None) -> None:
    """Before any long work."""
    try:
        if task.teammate["kind"] == "heuristic":
            check_theta(task.teammate)
        else:
            build(task.layout, task.teammate, suite=suite)
    except Icrl4ahtError as error:
        raise type(error)(f"task {task.task_id}: {error}") from error


def _side_by_side(
    run: Callable[[list[Task], Event], list[Result]], groups: Sequence[list[Task]], threads: int
) -> Iterator[list[Result]]:
    """The groups' results as they come: one compiles while another plays, and a game alone does not fill a machine.

    An ego outside JAX gets one thread: its `reset` must come right before its game.
    """
    stopped = Event()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for future in as_completed([pool.submit(run, group, stopped) for group in groups]):
                yield future.result()
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


def _run_group(tasks: list[Task], game: Game, seeds: int, settings: dict[str, Any], stopped: Event) -> list[Result]:
    returns = []
    for played in play(game, game.rollout.protocol.episodes):
        if stopped.is_set():
            return []
        ego = played.actions[..., EGO]
        low, high = int(ego.min()), int(ego.max())
        if low < 0 or high >= len(ACTIONS):
            raise OptionError(f"the ego returned actions {low}..{high} on {tasks[0].layout.name}, expected 0..5")
        returns.append(np.asarray(played.reward, np.float64).sum(axis=-1))
    per_task = np.stack(returns, axis=-1).reshape(len(tasks), seeds, -1)
    return [Result(task.task_id, settings, rows.tolist()) for task, rows in zip(tasks, per_task, strict=True)]


class Game(NamedTuple):
    """Tasks of one layout and family, ready to play."""

    rollout: EvaluationRollout
    tables: RolloutState  # before the first episode
    episode: Callable[..., tuple[RolloutState, Episode]]  # compiled


def prepare_rollout(
    make_ego: Callable[[Layout], Policy | HostPolicy],
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
) -> Game:
    """Compile the game of tasks that share a layout and a teammate family."""
    layout = tasks[0].layout
    mates = [build(layout, task.teammate, TEAMMATE, protocol.noise, suite) for task in tasks]
    rollout = EvaluationRollout(layout, make_ego(layout), [mate for mate in mates for _ in seeds], protocol)
    keys = jnp.stack([task_key(seed, task.task_id) for task in tasks for seed in seeds])
    outside = isinstance(rollout.ego, HostPolicy)
    tables = rollout.start(keys) if outside else jax.jit(rollout.start)(keys)
    _check_ego(rollout, tables)
    episode = jax.jit(rollout.episode)
    if outside:
        return Game(rollout, tables, episode)
    return Game(rollout, tables, episode.lower(rollout.ego.params, rollout.teammate_params, tables).compile())


def play_tasks(
    make_ego: Callable[[Layout], Policy | HostPolicy],
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
) -> Iterator[Episode]:
    """Episode after episode of tasks that share a layout and a teammate family.

    Yields:
        `Episode` with B = tasks x seeds, seeds varying fastest.
    """
    yield from play(prepare_rollout(make_ego, tasks, protocol, seeds, suite), protocol.episodes)


def play(game: Game, episodes: int) -> Iterator[Episode]:
    """Episode after episode."""
    rollout, tables, episode = game
    params = rollout.teammate_params
    for _ in range(episodes):
        try:
            tables, played = jax.block_until_ready(episode(rollout.ego.params, params, tables))
        except jax.errors.JaxRuntimeError as error:  # what an agent outside JAX raised comes wrapped
            raise OptionError(f"the ego failed on {rollout.layout.name}: {error}") from error
        yield played


def _check_ego(rollout: EvaluationRollout, tables: RolloutState) -> None:
    """One traced step says whether the egos' actions have the right shape and type."""
    keys = tables.env.key
    actions, _ = jax.eval_shape(rollout._ego.act, rollout.ego.params, tables.ego, rollout.ego_view(tables), keys)
    if actions.shape != keys.shape or not jnp.issubdtype(actions.dtype, jnp.integer):
        raise OptionError(
            f"the ego's actions are {actions.dtype} of shape {actions.shape} for {keys.shape[0]} observations, "
            f"expected one integer 0..5 for each"
        )
