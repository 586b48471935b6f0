"""Evaluation of an ego on tasks under a named protocol (paper, Sec. 4.3).

A task is 100 episodes of 100 steps in sequence. The ego's memory lasts for the task, the teammate's for an episode. An
episode's key is a function of (seed, task_id, episode) alone, so a task's result does not depend on what else is
evaluated in the same batch or process.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
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

from icrl4aht_baselines.agents.egos import SCRIPTED
from icrl4aht_baselines.agents.host import HostPolicy
from icrl4aht_baselines.evaluate.protocols import Protocol, get_protocol
from icrl4aht_baselines.evaluate.results import Result, find_results, write_result
from icrl4aht_baselines.evaluate.rollout import EpisodeBatch, EvaluationRollout, RolloutState, task_key
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.channels import channel_names
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.progress import counted, progress_bars
from icrl4aht_data.utils.system import usable_cores

MakeEgo = Callable[[Layout], Policy | HostPolicy]
"""Function from a layout to the ego that plays on it."""


def evaluate(
    agent: str,
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol | str = "seeded",
    *,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
    out: Path | None = None,
    details: dict[str, Any] | None = None,
    done: Callable[[int], None] | None = None,
    played: Callable[[int], None] | None = None,
) -> list[Result]:
    """Evaluate an ego and return one result per task, in the order of `tasks`.

    Shows progress, unless `done` or `played` is given: a bar, or a line a minute where stderr is no terminal.

    Args:
        agent: name of the ego in results and reports.
        make_ego: layout -> ego, such as `icrl4aht_baselines.from_host(my_agent)`.
        tasks: the tasks, such as `icrl4aht_baselines.test_tasks("teammate")`.
        protocol: rules of the evaluation, "seeded" or "published", or with fewer episodes those of `get_protocol`.
        seeds: seeds of the episodes, such as (0, 1, 2); the ego plays every task once with each of them.
        suite: folder with the checkpoints of learned teammates, if tasks have any.
        out: folder for one JSON file per task. Results found there under the same settings are not computed again.
        details: further settings that the results depend on, as JSON; stored and compared with the results.
            `trained_on` among them states the training data, which reports compare with the tasks: see
            `icrl4aht_baselines.training.seen.read_trained_on`.
        done: called with the number of tasks finished since the last call, for progress.
        played: called with the number of episodes played since the last call, or found in `out`; by several threads.

    Raises:
        OptionError: if `out` has results of other settings or other files, seeds are not different integers from 0,
            or the ego's actions are not integers in 0..5.
        UnknownNameError: if there is no such protocol.
        TaskFormatError: if a teammate's parameters are impossible; names the task.
    """
    rules = protocol if isinstance(protocol, Protocol) else get_protocol(protocol)
    seeds = _checked_seeds(seeds)
    if not callable(make_ego):
        raise OptionError(f"make_ego = {make_ego!r}: expected a function layout -> ego, such as from_host(my_agent)")
    for task in tasks:
        _check_teammate(task, suite)
    settings = {
        "agent": agent,
        "seeds": seeds,
        "protocol": asdict(rules),
        "code_version": version("icrl4aht-data"),
    } | ({"details": details} if details else {})
    results = {} if out is None else find_results(out, tasks, settings)
    missing = [task for task in tasks if task.task_id not in results]
    with ExitStack() as stack:
        if played is None and done is None:
            show = stack.enter_context(progress_bars(unit="episodes"))
            played = counted(show, f"{agent}, {rules.name}", len(tasks) * len(seeds) * rules.episodes)
        count_tasks, count_episodes = (count or (lambda number: None) for count in (done, played))
        count_tasks(len(results))
        count_episodes(len(results) * len(seeds) * rules.episodes)
        for found in _evaluate_groups(make_ego, missing, rules, seeds, suite, settings, count_episodes):
            for result in found:
                results[result.task_id] = result
                if out is not None:
                    write_result(out, result)
            count_tasks(len(found))
    return [results[task.task_id] for task in tasks]


def _checked_seeds(seeds: Sequence[int]) -> list[int]:
    if not isinstance(seeds, Sequence) or isinstance(seeds, str) or not seeds:
        raise OptionError(f"seeds = {seeds!r}: expected a sequence of integers, such as (0, 1, 2)")
    found = [check_int("seeds", seed, 0) for seed in seeds]
    if len(set(found)) < len(found):
        raise OptionError(f"seeds = {found}: expected different ones; with equal seeds the ego plays equal episodes")
    return found


def _evaluate_groups(
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int],
    suite: Path | None,
    settings: dict[str, Any],
    played: Callable[[int], None],
) -> Iterator[list[Result]]:
    """Yield the results of groups of tasks that share a compiled program, in the order in which they finish."""
    egos = {layout: make_ego(layout) for layout in dict.fromkeys(task.layout for task in tasks)}
    groups = _by_program(make_ego, egos, tasks)

    def run(group: list[Task]) -> list[Result]:
        prepared = prepare_rollout(
            make_ego if make_ego in SCRIPTED else egos.__getitem__, group, protocol, seeds, suite
        )
        return _evaluate_group(group, prepared, len(seeds), settings, stopped, played)

    # Groups run at the same time: one compiles while another plays, and one alone does not use all cores. An ego
    # outside JAX gets a single thread, since its `reset` must come right before its episodes.
    outside = any(isinstance(ego, HostPolicy) for ego in egos.values())
    stopped = Event()
    with ThreadPoolExecutor(1 if outside else min(4, usable_cores())) as pool:
        try:
            for future in as_completed([pool.submit(run, group) for group in groups]):
                yield future.result()
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


def count_programs(make_ego: MakeEgo, tasks: Sequence[Task]) -> int:
    """Return the number of programs that an evaluation of these tasks compiles, see `evaluate`."""
    return len(_by_program(make_ego, {task.layout: make_ego(task.layout) for task in tasks}, tasks))


def _by_program(
    make_ego: MakeEgo, egos: Mapping[Layout, Policy | HostPolicy], tasks: Sequence[Task]
) -> list[list[Task]]:
    """Return the groups of tasks that one compiled program plays."""
    groups: dict[Any, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[_program(task, egos[task.layout], make_ego)].append(task)
    return list(groups.values())


def _program(task: Task, ego: Policy | HostPolicy, make_ego: MakeEgo) -> tuple[Any, ...]:
    """Return what tasks share that one compiled program plays: all that it is made of but tables and parameters."""
    kind, heuristic = task.teammate_kind, task.teammate["kind"] == "heuristic"
    if make_ego in SCRIPTED and heuristic:
        return kind, make_ego
    if isinstance(ego, HostPolicy) or ego.sees in ("state", "observation") or not heuristic:
        return kind, task.layout
    # A model of own channels takes the observations of layouts whose channels have equal names.
    names = channel_names(task.layout) if ego.sees == "ego_input" else None
    return kind, names, ego.init, ego.act, id(ego.params)


def _check_teammate(task: Task, suite: Path | None) -> None:
    if not isinstance(task, Task):
        raise OptionError(f'tasks: {task!r:.100}: expected tasks, such as those of test_tasks("teammate")')
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
    """Return the results of tasks that share a compiled program; none if it was stopped."""
    returns = []
    for episode in play_episodes(prepared):
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
    """Tasks that share a compiled program, ready to play.

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
    """Compile the episodes of tasks that share a teammate family.

    Tasks on several layouts need an ego whose functions and parameters are the same on all of them, see
    `EvaluationRollout`.

    Raises:
        OptionError: if the ego's action is not one integer for each observation.
    """
    layouts = list(dict.fromkeys(task.layout for task in tasks))
    several = len(layouts) > 1
    mates = [
        build_teammate(None if several else task.layout, task.teammate, TEAMMATE, protocol.noise, suite)
        for task in tasks
        for _ in seeds
    ]
    numbers = np.array([layouts.index(task.layout) for task in tasks for _ in seeds]) if several else None
    ego = make_ego(layouts) if several and make_ego in SCRIPTED else make_ego(layouts[0])
    rollout = EvaluationRollout(layouts if several else layouts[0], ego, mates, protocol, numbers)
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
    actions, _ = jax.eval_shape(rollout.ego_actions, rollout.ego.params, state, keys)
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
    """Play tasks that share a teammate family, see `prepare_rollout`.

    Yields:
        One `EpisodeBatch` after another with B = tasks x seeds; seeds vary fastest.
    """
    yield from play_episodes(prepare_rollout(make_ego, tasks, protocol, seeds, suite))


def play_episodes(prepared: PreparedRollout) -> Iterator[EpisodeBatch]:
    """Play all episodes of prepared tasks.

    Yields:
        One `EpisodeBatch` after another.

    Raises:
        OptionError: if an ego outside JAX fails.
    """
    rollout, state, episode = prepared
    params = rollout.teammate_params
    for _ in range(rollout.protocol.episodes):
        try:
            state, played = jax.block_until_ready(episode(rollout.ego.params, params, state))
        except jax.errors.JaxRuntimeError as error:  # an exception of an agent outside JAX arrives wrapped
            raise OptionError(f"the ego failed on {rollout.layout}: {error}") from error
        yield played
