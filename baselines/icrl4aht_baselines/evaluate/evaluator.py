"""Evaluation of an ego on tasks under a named protocol (paper, Sec. 4.3).

A task is 100 episodes of 100 steps in sequence. The ego's memory lasts for the task, the teammate's for an episode. An
episode's key is a function of (seed, task_id, episode) alone, so a task's result does not depend on what else is
evaluated in the same batch or process.
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
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.registry import build_teammate, check_theta

from icrl4aht_baselines.agents.host import HostPolicy
from icrl4aht_baselines.evaluate.protocols import Protocol
from icrl4aht_baselines.evaluate.results import Result, find_result, write_result
from icrl4aht_baselines.evaluate.rollout import EpisodeBatch, EvaluationRollout, RolloutState, task_key
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.system import usable_cores

MakeEgo = Callable[[Layout], Policy | HostPolicy]
"""Function from a layout to the ego that plays on it."""


def evaluate(
    agent: str,
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    *,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
    out: Path | None = None,
    details: dict[str, Any] | None = None,
    done: Callable[[int], None] = lambda tasks: None,
    played: Callable[[int], None] = lambda episodes: None,
) -> list[Result]:
    """Evaluate an ego and return one result per task, in the order of `tasks`.

    Args:
        agent: name of the ego in results and reports.
        make_ego: layout -> ego, such as `icrl4aht_baselines.agents.from_host(my_agent)`.
        tasks: the tasks, such as those of `icrl4aht_generation.teammates.instances.published_tasks`.
        protocol: rules of the evaluation, from `get_protocol`.
        seeds: seeds of the episodes; the ego plays every task once per seed.
        suite: folder with the checkpoints of learned teammates, if tasks have any.
        out: folder for one JSON file per task. Results found there under the same settings are not computed again.
        details: further settings that the results depend on, as JSON; stored and compared with the results.
            `trained_on` among them states the training data, which reports compare with the tasks: see
            `icrl4aht_baselines.training.seen.read_trained_on`.
        done: called with the number of tasks finished since the last call, for progress.
        played: called with the number of episodes played since the last call, or found in `out`; by several threads.

    Raises:
        OptionError: if `out` has results of other settings, or the ego's actions are not integers in 0..5.
        TaskFormatError: if a teammate's parameters are impossible; names the task.
    """
    for task in tasks:
        _check_teammate(task, suite)
    settings = {
        "agent": agent,
        "seeds": list(seeds),
        "protocol": asdict(protocol),
        "code_version": version("icrl4aht-data"),
    } | ({"details": details} if details else {})
    stored = {task.task_id: find_result(out, task.task_id, settings) for task in tasks} if out else {}
    results = {task_id: result for task_id, result in stored.items() if result}
    done(len(results))
    played(len(results) * len(seeds) * protocol.episodes)
    groups: dict[tuple[str, str], list[Task]] = defaultdict(list)
    for task in tasks:
        if task.task_id not in results:
            groups[task.layout_name, task.teammate_kind].append(task)

    layouts = {group[0].layout.name: group[0].layout for group in groups.values()}
    egos = {name: make_ego(layout) for name, layout in layouts.items()}

    def run(group: list[Task], stopped: Event) -> list[Result]:
        prepared = prepare_rollout(lambda layout: egos[layout.name], group, protocol, seeds, suite)
        return _evaluate_group(group, prepared, len(seeds), settings, stopped, played)

    # Groups run side by side: one compiles while another plays, and one alone does not use all cores. An ego outside
    # JAX gets a single thread, since its `reset` must come right before its episodes.
    outside = any(isinstance(ego, HostPolicy) for ego in egos.values())
    stopped = Event()
    with ThreadPoolExecutor(1 if outside else min(4, usable_cores())) as pool:
        try:
            for future in as_completed([pool.submit(run, group, stopped) for group in groups.values()]):
                for result in future.result():
                    results[result.task_id] = result
                    if out:
                        write_result(out, result)
                done(len(future.result()))
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)
    return [results[task.task_id] for task in tasks]


def _check_teammate(task: Task, suite: Path | None) -> None:
    try:
        if task.teammate["kind"] == "heuristic":
            check_theta(task.teammate)
        else:
            build_teammate(task.layout, task.teammate, suite=suite)
    except Icrl4ahtError as error:
        error.args = (f"task {task.task_id}: {error}",)
        raise


def _evaluate_group(
    tasks: list[Task],
    prepared: PreparedRollout,
    seeds: int,
    settings: dict[str, Any],
    stopped: Event,
    done: Callable[[int], None],
) -> list[Result]:
    """Return the results of tasks of one layout and teammate family; none if it was stopped."""
    returns = []
    for episode in play_episodes(prepared, prepared.rollout.protocol.episodes):
        if stopped.is_set():
            return []
        ego = episode.actions[..., EGO]
        low, high = int(ego.min()), int(ego.max())
        if low < 0 or high >= len(ACTIONS):
            raise OptionError(f"the ego returned actions {low}..{high} on {tasks[0].layout.name}, expected 0..5")
        returns.append(np.asarray(episode.reward, np.float64).sum(axis=-1))
        done(len(tasks) * seeds)
    per_task = np.stack(returns, axis=-1).reshape(len(tasks), seeds, -1)
    return [Result(task.task_id, settings, rows.tolist()) for task, rows in zip(tasks, per_task, strict=True)]


class PreparedRollout(NamedTuple):
    """Tasks of one layout and teammate family, ready to play.

    Attributes:
        rollout: the rollout of all tasks.
        state: the state before the first episode.
        episode: compiled `EvaluationRollout.episode`.
    """

    rollout: EvaluationRollout
    state: RolloutState
    episode: Callable[..., tuple[RolloutState, EpisodeBatch]]


def prepare_rollout(
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
) -> PreparedRollout:
    """Compile the episodes of tasks that share a layout and a teammate family.

    Raises:
        OptionError: if the ego's action is not one integer for each observation.
    """
    layout = tasks[0].layout
    mates = [build_teammate(layout, task.teammate, TEAMMATE, protocol.noise, suite) for task in tasks]
    rollout = EvaluationRollout(layout, make_ego(layout), [mate for mate in mates for _ in seeds], protocol)
    keys = jnp.stack([task_key(seed, task.task_id) for task in tasks for seed in seeds])
    outside = isinstance(rollout.ego, HostPolicy)
    state = rollout.start(keys) if outside else jax.jit(rollout.start)(keys)
    _check_actions(rollout, state)
    episode = jax.jit(rollout.episode)
    if outside:
        return PreparedRollout(rollout, state, episode)
    compiled = episode.lower(rollout.ego.params, rollout.teammate_params, state).compile()
    return PreparedRollout(rollout, state, compiled)


def _check_actions(rollout: EvaluationRollout, state: RolloutState) -> None:
    """Trace one step of the egos, which yields shape and dtype of their actions without computing any."""
    keys = state.env.key
    ego = rollout.batched_ego
    actions, _ = jax.eval_shape(ego.act, ego.params, state.ego, rollout.ego_view(state), keys)
    if actions.shape != keys.shape or not jnp.issubdtype(actions.dtype, jnp.integer):
        raise OptionError(
            f"the ego's actions are {actions.dtype} of shape {actions.shape} for {keys.shape[0]} observations, "
            f"expected one integer 0..5 for each"
        )


def play_tasks(
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
) -> Iterator[EpisodeBatch]:
    """Play tasks that share a layout and a teammate family.

    Yields:
        One `EpisodeBatch` after another with B = tasks x seeds; seeds vary fastest.
    """
    yield from play_episodes(prepare_rollout(make_ego, tasks, protocol, seeds, suite), protocol.episodes)


def play_episodes(prepared: PreparedRollout, episodes: int) -> Iterator[EpisodeBatch]:
    """Play episodes of prepared tasks.

    Yields:
        One `EpisodeBatch` after another.

    Raises:
        OptionError: if an ego outside JAX fails.
    """
    rollout, state, episode = prepared
    params = rollout.teammate_params
    for _ in range(episodes):
        try:
            state, played = jax.block_until_ready(episode(rollout.ego.params, params, state))
        except jax.errors.JaxRuntimeError as error:  # an exception of an agent outside JAX arrives wrapped
            raise OptionError(f"the ego failed on {rollout.layout.name}: {error}") from error
        yield played
