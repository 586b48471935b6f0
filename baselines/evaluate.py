"""The one evaluator: any ego on any tasks, under a named protocol (paper, Sec. 4.3).

A task is 100 episodes of 100 steps in sequence; the ego's memory lives through the task, the teammate's through an
episode. The key of an episode is a function of (seed, task_id, episode) alone, so a task's result is the same whatever
ran beside it.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from baselines.agents import HostPolicy, Percept
from generation.env import Environment, EnvState
from generation.teammates.base import Noise, Policy, stacked
from generation.teammates.registry import build, check_theta
from icrl4aht_data.benchmark import ACTIONS, EGO, KEPT_STEPS, TEAMMATE, track_of, unknown
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.files import file_in_place_of, json_hash
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.tasks import Task
from icrl4aht_data.threads import usable_cores

_FOUR_RECIPES = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))


@dataclass(frozen=True)
class Protocol:
    """How tasks are evaluated.

    Args:
        noise: of heuristic teammates, see `generation.teammates.base.Noise`.
        four_recipes: whether Track 2 draws from four recipes, as the published numbers do, or from its layouts' two.
    """

    name: str
    noise: Noise
    four_recipes: bool
    episodes: int = 100
    steps: int = KEPT_STEPS


PROTOCOLS = {
    "published": Protocol("published", noise="fixed", four_recipes=True),
    "seeded": Protocol("seeded", noise="seeded", four_recipes=False),
}
"""`published` compares with the paper's numbers; `seeded`, the default, is what to report."""


def get_protocol(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if name not in PROTOCOLS:
        raise unknown("protocol", name, PROTOCOLS)
    return PROTOCOLS[name]


class Tables(NamedTuple):
    """What a step carries into the next. B tasks of one layout and family."""

    env: EnvState
    ego: Any  # memories, batched
    before: Percept  # what preceded the coming step, but for `obs`


class Played(NamedTuple):
    """One episode of T steps of B tasks."""

    record: UInt8[Array, "B T S"]  # before each step
    actions: Int[Array, "B T 2"]
    reward: Float[Array, "B T"]  # the team's


@dataclass(frozen=True, eq=False)
class Rollout:
    """Episodes of B tasks that share a layout and a teammate family, compiled once."""

    layout: Layout
    ego: Policy | HostPolicy
    teammates: Sequence[Policy]
    protocol: Protocol

    @cached_property
    def env(self) -> Environment:
        four = self.protocol.four_recipes and track_of(self.layout.name) == "layout"
        recipes = np.array([self.layout.recipe_item(r) for r in _FOUR_RECIPES], np.uint8) if four else None
        return Environment(self.layout, self.protocol.steps, recipes)

    @property
    def teammate_params(self) -> Any:
        """Of all tasks, stacked on a leading axis."""
        return stacked(mate.params for mate in self.teammates)

    def start(self, keys: jax.Array) -> Tables:
        """Task keys (B,) -> tables before the first episode; nothing precedes a task's first step."""
        batch = keys.shape[0]
        egos = self._ego.init(self.ego.params, _fold_all(keys, EGO))
        zero = jnp.zeros(batch, jnp.int32)
        nothing = Percept(jnp.zeros((batch, 0)), zero, jnp.zeros(batch), zero, jnp.zeros(batch, bool))
        return Tables(self.env.init(keys), egos, nothing)

    @cached_property
    def _ego(self) -> HostPolicy:
        """The ego as batched functions."""
        if isinstance(self.ego, HostPolicy):
            return self.ego
        init, act = jax.vmap(self.ego.init, in_axes=(None, 0)), jax.vmap(self.ego.act, in_axes=(None, 0, 0, 0))
        return HostPolicy(self.ego.params, init, act, self.ego.sees)

    def episode(self, ego_params: Any, mate_params: Any, tables: Tables) -> tuple[Tables, Played]:
        """One episode of every task. Jit it once."""
        mate = self.teammates[0]
        keys = self.env.episode_key(tables.env)
        memories = jax.vmap(mate.init)(mate_params, _fold_all(keys, TEAMMATE))
        ego_keys, mate_keys = _fold_all(keys, 2), _fold_all(keys, 3)

        def step(carry, t):
            tables, memories = carry
            now = tables.env
            mine, egos = self._ego.act(ego_params, tables.ego, self.ego_view(tables), _fold_all(ego_keys, t))
            theirs, memories = jax.vmap(mate.act)(
                mate_params, memories, self._view(mate.sees, now, TEAMMATE), _fold_all(mate_keys, t)
            )
            after = self.env.step(now, jnp.stack([mine, theirs], axis=-1))
            before = tables.before._replace(
                prev_action=mine, prev_reward=after.reward, prev_teammate_action=theirs, prev_done=after.done
            )
            played = Played(now.record, jnp.stack([mine, theirs], axis=-1), after.reward)
            return (Tables(after.state, egos, before), memories), played

        (tables, _), played = jax.lax.scan(step, (tables, memories), jnp.arange(self.protocol.steps))
        return tables, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), played)

    def ego_view(self, tables: Tables) -> Any:
        """What the egos are given now, batched."""
        if self.ego.sees == "percept":
            return tables.before._replace(obs=self._view("observation", tables.env, EGO))
        return self._view(self.ego.sees, tables.env, EGO)

    def _view(self, sees: str, state: EnvState, seat: int) -> jax.Array:
        return state.record if sees == "state" else self.env.observe_one(state, seat)


def _fold_all(keys: jax.Array, data: Any) -> jax.Array:
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, data)


def task_key(seed: int, task_id: str) -> jax.Array:
    """The key that all of a task's episodes come from."""
    digest = hashlib.sha256(task_id.encode()).digest()
    return jax.random.fold_in(jax.random.key(seed), int.from_bytes(digest[:4], "big"))


@dataclass(frozen=True)
class Result:
    """One task's outcome."""

    task_id: str
    settings: dict[str, Any]
    returns: list[list[float]]  # team return of each episode, by seed

    def to_json(self) -> dict[str, Any]:
        return {"settings_hash": json_hash(self.settings), **asdict(self)}


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
        game = set_up(lambda layout: egos[layout.name], group, protocol, seeds, suite)
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

    rollout: Rollout
    tables: Tables  # before the first episode
    episode: Callable[..., tuple[Tables, Played]]  # compiled


def set_up(
    make_ego: Callable[[Layout], Policy | HostPolicy],
    tasks: Sequence[Task],
    protocol: Protocol,
    seeds: Sequence[int] = (0,),
    suite: Path | None = None,
) -> Game:
    """Compile the game of tasks that share a layout and a teammate family."""
    layout = tasks[0].layout
    mates = [build(layout, task.teammate, TEAMMATE, protocol.noise, suite) for task in tasks]
    rollout = Rollout(layout, make_ego(layout), [mate for mate in mates for _ in seeds], protocol)
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
) -> Iterator[Played]:
    """Episode after episode of tasks that share a layout and a teammate family.

    Yields:
        `Played` with B = tasks x seeds, seeds varying fastest.
    """
    yield from play(set_up(make_ego, tasks, protocol, seeds, suite), protocol.episodes)


def play(game: Game, episodes: int) -> Iterator[Played]:
    """Episode after episode."""
    rollout, tables, episode = game
    params = rollout.teammate_params
    for _ in range(episodes):
        try:
            tables, played = jax.block_until_ready(episode(rollout.ego.params, params, tables))
        except jax.errors.JaxRuntimeError as error:  # what an agent outside JAX raised comes wrapped
            raise OptionError(f"the ego failed on {rollout.layout.name}: {error}") from error
        yield played


def _check_ego(rollout: Rollout, tables: Tables) -> None:
    """One traced step says whether the egos' actions have the right shape and type."""
    keys = tables.env.key
    actions, _ = jax.eval_shape(rollout._ego.act, rollout.ego.params, tables.ego, rollout.ego_view(tables), keys)
    if actions.shape != keys.shape or not jnp.issubdtype(actions.dtype, jnp.integer):
        raise OptionError(
            f"the ego's actions are {actions.dtype} of shape {actions.shape} for {keys.shape[0]} observations, "
            f"expected one integer 0..5 for each"
        )


def _path(out: Path, task_id: str) -> Path:
    return out / "tasks" / f"{task_id}.json"


def _stored(out: Path | None, task: Task, settings: dict[str, Any]) -> Result | None:
    if out is None or not _path(out, task.task_id).exists():
        return None
    path = _path(out, task.task_id)
    result = read_result(path)
    if result.settings != settings:
        raise OptionError(
            f"{path}: holds a result of other settings ({result.settings}), asked for {settings}; give another --out"
        )
    return result


def read_result(path: Path) -> Result:
    """One task's result.

    Raises:
        OptionError: if the file is not a result, or its settings do not match their hash.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        digest = content.pop("settings_hash")
        result = Result(**content)
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise OptionError(f"{path}: not a result: {error!r}; remove it and evaluate again") from error
    if digest != json_hash(result.settings):
        raise OptionError(f"{path}: its settings do not match their hash; remove it and evaluate again")
    return result


def _store(out: Path | None, result: Result) -> None:
    if out is None:
        return
    path = _path(out, result.task_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    with file_in_place_of(path) as partial:
        partial.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
