"""Evaluation of an ego on tasks under a named protocol (paper, Sec. 4.3).

A task is a sequence of 100 episodes of 100 steps. An ego keeps its memory for a task, a teammate for an episode.
The random key of an episode is a function of (seed, task_id, episode), so a task's result does not depend on the other
tasks of the same batch or process. Two controls, of memory and of partner, show how much an ego earns by remembering
earlier episodes with the same teammate.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.registry import build_teammate, check_theta, with_equal_parameter_names
from jaxtyping import Float

from icrl4aht_baselines.agents.egos import SCRIPTED
from icrl4aht_baselines.agents.host import HostPolicy
from icrl4aht_baselines.evaluate.protocols import (
    CONTROLS,
    Control,
    PlannedTask,
    Protocol,
    controlled_name,
    get_protocol,
    plan_tasks,
    segment_lengths,
)
from icrl4aht_baselines.evaluate.results import Result, find_results, write_result
from icrl4aht_baselines.evaluate.rollout import (
    EpisodeBatch,
    EpisodeProgram,
    EvaluationRollout,
    ProgramCache,
    RolloutState,
    task_key,
)
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError, check_choice
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.channels import channel_names
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.progress import bar_updater, progress_bars
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
    control: Control | None = None,
    out: Path | None = None,
    details: dict[str, Any] | None = None,
    played: Callable[[int], None] | None = None,
    programs: ProgramCache | None = None,
) -> list[Result]:
    """Evaluate an ego and return one result per task, in the order of `tasks`.

    Unless `played` is given, progress is shown as a bar, or as one line per minute if stderr is not a terminal.

    Args:
        agent: name of the ego in results and reports.
        make_ego: function from a layout to the ego, such as `icrl4aht_baselines.from_host(my_agent)`.
        tasks: the tasks, such as `icrl4aht_baselines.test_tasks("teammate")`.
        protocol: rules of the evaluation: a name in `PROTOCOLS`, or a `Protocol`, such as one with fewer episodes.
        seeds: seeds of the episodes, such as (0, 1, 2); the ego plays every task once with each of them.
        suite: folder with the checkpoints of learned teammates, if tasks have any.
        control: one of `CONTROLS`, to play a control instead of the ego. The control is added to the agent's name in
            results, such as "mine (cleared)". `evaluate_controls` plays the ego and all controls.
        out: folder for one JSON file per task. Stored results with the same settings are not computed again.
        details: further settings that the results depend on, as JSON; stored with the results. The entry `trained_on`
            states the training data, which reports compare with the tasks: see
            `icrl4aht_baselines.training.seen.parse_training_record`.
        played: function for progress, called by several threads with the number of episodes played or found in `out`
            since the last call.
        programs: compiled programs of earlier evaluations of the ego; new programs are added.

    Raises:
        OptionError: if `out` has results of other settings or other files, seeds are negative or repeated, the ego's
            actions are not integers in 0..5, or a task has no partner for the control or the protocol.
        UnknownNameError: if the protocol or the control is unknown.
        TaskFormatError: if a teammate's parameters are invalid; the message names the task.
    """
    rules = protocol if isinstance(protocol, Protocol) else get_protocol(protocol)
    seeds = _checked_seeds(seeds)
    if not callable(make_ego):
        raise OptionError(f"make_ego = {make_ego!r}: expected a function layout -> ego, such as from_host(my_agent)")
    for task in tasks:
        _check_teammate(task, suite)
    if control is not None:
        check_choice("control", control, CONTROLS)
        agent, details = controlled_name(agent, control), (details or {}) | {CONTROLS[control]: True}
    settings = {
        "agent": agent,
        "seeds": seeds,
        "protocol": rules.settings,
        "code_version": version("icrl4aht-data"),
    } | ({"details": details} if details else {})
    planned = plan_tasks(tasks, rules, control)
    results = {} if out is None else find_results(out, planned, settings)
    missing = [plan for plan in planned if plan.task.task_id not in results]
    programs = ProgramCache() if programs is None else programs
    evaluation = _Evaluation(make_ego, rules, control, seeds, suite, settings, programs)
    with progress_bars(quiet=played is not None, unit="episodes") as show:
        played = played or bar_updater(show, f"{agent}, {rules.name}", len(tasks) * len(seeds) * rules.episodes)
        played(len(results) * len(seeds) * rules.episodes)
        with closing(evaluation.play(missing, played)) as found:  # an error while writing stops all queued groups
            for result in found:
                results[result.task_id] = result
                if out is not None:
                    write_result(out, result)
    return [results[task.task_id] for task in tasks]


def _checked_seeds(seeds: Sequence[int]) -> list[int]:
    if not isinstance(seeds, Sequence) or isinstance(seeds, str) or not seeds:
        raise OptionError(f"seeds = {seeds!r}: expected a sequence of integers, such as (0, 1, 2)")
    found = [check_int("seeds", seed, 0) for seed in seeds]
    if len(set(found)) < len(found):
        raise OptionError(f"seeds = {found}: expected different seeds; with equal seeds the ego plays equal episodes")
    return found


@dataclass(frozen=True)
class _Evaluation:
    """Settings that all groups of tasks of an evaluation share."""

    make_ego: MakeEgo
    protocol: Protocol
    control: Control | None
    seeds: Sequence[int]
    suite: Path | None
    settings: dict[str, Any]
    programs: ProgramCache

    def play(self, planned: Sequence[PlannedTask], played: Callable[[int], None]) -> Generator[Result, None, None]:
        """Yield the results of each group of tasks that share compiled programs, as soon as the group is finished."""
        layouts = dict.fromkeys(task.layout for plan in planned for task in plan.played)
        egos = {layout: self.make_ego(layout) for layout in layouts}
        groups: dict[Any, list[PlannedTask]] = defaultdict(list)
        for plan in planned:
            groups[tuple(_program_key(task, egos[task.layout], self.make_ego) for task in plan.played)].append(plan)
        stopped, make = Event(), self.make_ego if self.make_ego in SCRIPTED else egos.__getitem__
        # Groups run in parallel: one group compiles while another plays, and one alone does not use all cores. An ego
        # outside JAX needs a single thread, because the episodes of a group must directly follow its `reset`.
        outside = any(isinstance(ego, HostPolicy) for ego in egos.values())
        with ThreadPoolExecutor(1 if outside else min(4, usable_cores())) as pool:
            try:
                futures = [pool.submit(self._play_group, group, make, stopped, played) for group in groups.values()]
                for future in as_completed(futures):
                    yield from future.result()
            finally:
                stopped.set()
                pool.shutdown(cancel_futures=True)

    def _play_group(
        self, group: list[PlannedTask], make_ego: MakeEgo, stopped: Event, played: Callable[[int], None]
    ) -> list[Result]:
        """Return the results of a group of tasks that share compiled programs; an empty list if `stopped` is set."""
        returns, count = [], len(group) * len(self.seeds)
        for episode in self._play_segments(group, make_ego):
            if stopped.is_set():
                return []
            ego = episode.actions[..., EGO]
            low, high = int(ego.min()), int(ego.max())
            if low < 0 or high >= len(ACTIONS):
                name = group[0].task.layout.name
                raise OptionError(f"the ego returned actions {low}..{high} on {name}, expected 0..5")
            returns.append(np.asarray(episode.reward, np.float64).sum(axis=-1))
            played(count)
        per_task = np.stack(returns, axis=-1).reshape(len(group), len(self.seeds), -1)
        return [
            Result(plan.task.task_id, self.settings, rows.tolist(), list(plan.partners))
            for plan, rows in zip(group, per_task, strict=True)
        ]

    def _play_segments(self, group: list[PlannedTask], make_ego: MakeEgo) -> Iterator[EpisodeBatch]:
        """Play all segments of a group of tasks. The egos keep their memory from one segment to the next."""
        lengths, prepared = segment_lengths(self.protocol, self.control), None
        for number, episodes in enumerate(lengths):
            tasks = [plan.played[number] for plan in group]
            prepared = prepare_rollout(
                make_ego, tasks, self.protocol, self.seeds, self.suite, programs=self.programs, earlier=prepared
            )
            state = yield from play_episodes(prepared, episodes, forget=self.control == "cleared")
            prepared = prepared._replace(state=state)


def _program_key(task: Task, ego: Policy | HostPolicy, make_ego: MakeEgo) -> tuple[Any, ...]:
    """Return the key of the compiled program that plays a task; tasks with equal keys are played together."""
    kind, heuristic = task.teammate_kind, task.teammate["kind"] == "heuristic"
    if make_ego in SCRIPTED and heuristic:
        return kind, make_ego
    if isinstance(ego, HostPolicy) or ego.sees in ("state", "observation") or not heuristic:
        return kind, task.layout
    # A model trained on a layout's own channels can play every layout that has channels of the same names.
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


class PreparedRollout(NamedTuple):
    """A group of tasks with the compiled program that plays them.

    Attributes:
        rollout: the rollout of all tasks of the group.
        state: the state before the first episode.
        episode: the compiled `EvaluationRollout.episode`.
    """

    rollout: EvaluationRollout
    state: RolloutState
    episode: EpisodeProgram


def prepare_rollout(
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
    *,
    programs: ProgramCache | None = None,
    earlier: PreparedRollout | None = None,
) -> PreparedRollout:
    """Compile the programs that play tasks of one teammate family.

    Tasks on several layouts need an ego whose functions and parameters are the same on all of them, see
    `EvaluationRollout`.

    Args:
        make_ego, tasks, protocol, seeds, suite: see `evaluate`.
        programs: compiled programs to reuse; new programs are added.
        earlier: finished rollout of the same tasks with other teammates. The new rollout continues from its last state.
            None for the first episodes.

    Raises:
        OptionError: if the ego's action is not one integer for each observation.
    """
    layouts = list(dict.fromkeys(task.layout for task in tasks))
    several = len(layouts) > 1
    mates = [
        build_teammate(None if several else task.layout, entry, TEAMMATE, protocol.noise, suite)
        for task, entry in zip(tasks, with_equal_parameter_names([task.teammate for task in tasks]), strict=True)
        for _ in seeds
    ]
    numbers = np.array([layouts.index(task.layout) for task in tasks for _ in seeds]) if several else None
    every: Any = layouts if several and make_ego in SCRIPTED else layouts[0]
    ego = make_ego(every)
    rollout = EvaluationRollout(layouts if several else layouts[0], ego, mates, protocol, numbers)
    if earlier is None:
        keys = jnp.stack([task_key(seed, task.task_id) for task in tasks for seed in seeds])
        state = rollout.start(keys) if isinstance(ego, HostPolicy) else jax.jit(rollout.start)(keys)
    else:
        before = earlier.rollout
        is_same = rollout.layout == before.layout and np.array_equal(rollout.numbers, before.numbers)  # type: ignore[arg-type]
        state = earlier.state if is_same else jax.jit(rollout.move_to_layouts)(earlier.state)
    programs = ProgramCache() if programs is None else programs
    return PreparedRollout(rollout, state, programs.episode(rollout, state))


def play_tasks(
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
    forget: bool = False,
) -> Iterator[EpisodeBatch]:
    """Play tasks that share a teammate family, see `prepare_rollout`.

    Args:
        make_ego, tasks, protocol, seeds, suite: see `evaluate`.
        forget: whether the egos' memory is cleared before each episode.

    Yields:
        An `EpisodeBatch` for each episode, with B = tasks x seeds rows; seeds vary fastest.

    Raises:
        OptionError: if the protocol changes teammates within these episodes, which only `evaluate` supports.
    """
    if len(segment_lengths(protocol)) > 1:
        raise OptionError(
            f"protocol {protocol.name}: expected at most {protocol.swap_every} episodes, after which the teammate "
            f"changes, found {protocol.episodes}; use `evaluate`"
        )
    yield from play_episodes(prepare_rollout(make_ego, tasks, protocol, seeds, suite), forget=forget)


def play_episodes(
    prepared: PreparedRollout, episodes: int | None = None, *, forget: bool = False
) -> Generator[EpisodeBatch, None, RolloutState]:
    """Play episodes of prepared tasks.

    Args:
        prepared: the tasks, see `prepare_rollout`.
        episodes: number of episodes; by default that of the protocol.
        forget: whether the egos' memory is cleared before each episode.

    Yields:
        An `EpisodeBatch` for each episode.

    Returns:
        The state after the last episode.

    Raises:
        OptionError: if an ego outside JAX fails.
    """
    rollout, state, episode = prepared
    clear = rollout.clear_memory if isinstance(rollout.ego, HostPolicy) else jax.jit(rollout.clear_memory)
    for _ in range(rollout.protocol.episodes if episodes is None else episodes):
        if forget and state.env.episode.any():  # the memory is empty before the first episode
            state = clear(state)
        try:
            state, played = jax.block_until_ready(episode(rollout.ego.params, rollout.teammate_params, state))
        except jax.errors.JaxRuntimeError as error:  # JAX wraps exceptions of agents outside JAX
            raise OptionError(f"the ego failed on {rollout.layout}: {error}") from error
        yield played
    return state


class ControlledResults(NamedTuple):
    """Results of an ego and of its controls on U tasks with S seeds, all with the same random keys.

    Attributes:
        plain: results of the ego without a control.
        cleared: results with the ego's memory cleared before each episode.
        swapped: results with another task's teammate in all episodes but the last ones.
        last: number of episodes at the end of a task that the task's own teammate plays under the control `swapped`.
    """

    plain: list[Result]
    cleared: list[Result]
    swapped: list[Result]
    last: int

    @property
    def memory(self) -> Float[np.ndarray, "U S"]:
        """Benefit M of memory: mean return, minus the mean return with the memory cleared before each episode."""
        return (_stacked_returns(self.plain) - _stacked_returns(self.cleared)).mean(axis=-1)

    @property
    def partner(self) -> Float[np.ndarray, "U S"]:
        """Benefit P of the right context: mean return of the last episodes, minus their return in `swapped`."""
        return (_stacked_returns(self.plain) - _stacked_returns(self.swapped))[..., -self.last :].mean(axis=-1)


def _stacked_returns(results: Sequence[Result]) -> Float[np.ndarray, "U S E"]:
    return np.array([result.returns for result in results], np.float64)


def evaluate_controls(
    agent: str,
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol | str = "seeded",
    *,
    out: Path | None = None,
    **options: Any,
) -> ControlledResults:
    """Evaluate an ego and its controls, see `protocols.CONTROLS`.

    Args:
        agent, make_ego, tasks, protocol: see `evaluate`.
        out: folder of the ego's results; results of the controls are in its subfolders `cleared` and `swapped`.
        options: further arguments of `evaluate`: `seeds`, `suite`, `details` and `programs`.

    Raises:
        OptionError: for the reasons of `evaluate`, if the protocol swaps teammates or has fewer than 2 episodes, or if
            a task has no partner.
    """
    rules = protocol if isinstance(protocol, Protocol) else get_protocol(protocol)
    plan_tasks(tasks, rules, "swapped")  # reports a task without a partner task now, not after hours
    # Only equal functions share compiled programs, and some `make_ego` return new functions in each call.
    make = make_ego if make_ego in SCRIPTED else cache(make_ego)
    options = {"programs": ProgramCache()} | options
    results = {
        control: evaluate(agent, make, tasks, rules, control=control, out=out and out / (control or ""), **options)
        for control in (None, *CONTROLS)
    }
    return ControlledResults(results[None], results["cleared"], results["swapped"], rules.last_episodes)
