"""Record histories of source `agent`: a trained agent plays with a release's teammates, and its steps are labelled.

The agent keeps its memory during a history, like during a task in an evaluation. The probability of a random action may
fall over a history's episodes, as in noise distillation (Zisman et al. 2024). `expert_actions` are the agent's choices
before the noise, or those of another trained agent or of the script `search` in the same history, as in on-policy
imitation (DAgger, Ross et al. 2011). `oracle_actions` are those of the scripted oracle. The teammate may change within
a history, as under the protocol `swap`.

Shapes: `B` histories that are played in parallel, `E` episodes, `T` steps of an episode, `S` bytes of a state record.
"""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.collection.curate import oracle_labels, search_labels
from icrl4aht_generation.collection.scripted_rollout import noise_schedules
from icrl4aht_generation.experts.search import searcher
from icrl4aht_generation.learners.resume import xla_threads
from icrl4aht_generation.policy import Policy, randomize_action
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from jaxtyping import Array, Float, Int, Int8

from icrl4aht_baselines.agents.egos import SCRIPTED, NamedEgo
from icrl4aht_baselines.evaluate.evaluator import prepare_rollout
from icrl4aht_baselines.evaluate.protocols import get_protocol, segment_lengths
from icrl4aht_baselines.evaluate.rollout import ProgramCache
from icrl4aht_baselines.online.teammates import tasks_on_layouts
from icrl4aht_baselines.training.run_folder import check_same_settings
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, make_task, teammate_id
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.fetch import Remote
from icrl4aht_data.format.checkpoints import checkpoint_files
from icrl4aht_data.format.provenance import ExpertLabels, LabelView, Provenance, ReferenceEgos, TeammateSwaps
from icrl4aht_data.format.schema import TEAMMATES, curve_ends, episode_ends
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.files import read_json, write_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.progress import bar_updater
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import check_target

SOURCE = "agent"

FIRST_SEED = 3_000_000
"""Seed of the first task of source `agent`; ten collections fit below the seeds of source `search`."""

_SEEDS = 100_000
"""Size of the range of task seeds that is reserved for one collection."""


class NoisyMemory(NamedTuple):
    """Memory of an agent that sometimes acts at random.

    Attributes:
        own: memory of the agent without noise.
        chance: float32 (), probability of a random action in this episode.
        steps: int32 (), number of steps so far.
        labels: int8 (T,), the labeller's choices in the last T steps.
        labeller: the labeller's memory; None if the agent labels its own histories.
    """

    own: Any
    chance: Float[Array, ""]
    steps: Int[Array, ""]
    labels: Int8[Array, " T"]
    labeller: Any = None


def with_noise(policy: Policy, length: int, labeller: Policy | None = None) -> Policy:
    """Return an agent that sometimes acts at random, and whose memory holds the labels of its last steps.

    Args:
        policy: the agent.
        length: T, number of steps of an episode.
        labeller: another agent with the same inputs, whose actions become the labels; by default the labels are the
            agent's actions without noise.

    Raises:
        OptionError: if the labeller takes other inputs than the agent.
    """
    if labeller is not None and labeller.sees != policy.sees:
        raise OptionError(
            f"the labeller's input is {labeller.sees}, expected the agent's input {policy.sees}; choose a labeller "
            f"with the same input"
        )
    params = policy.params, None if labeller is None else labeller.params

    def init(params: Any, key: Any) -> NoisyMemory:
        labels = jnp.zeros(length, jnp.int8)
        other = None if labeller is None else labeller.init(params[1], key)
        return NoisyMemory(policy.init(params[0], key), jnp.float32(0), jnp.int32(0), labels, other)

    def act(params: Any, memory: NoisyMemory, view: Any, key: Any) -> tuple[Any, NoisyMemory]:
        clean, own = policy.act(params[0], memory.own, view, key)
        label, other = clean, None
        if labeller is not None:
            label, other = labeller.act(params[1], memory.labeller, view, jax.random.fold_in(key, 2))
        action = randomize_action(jax.random.fold_in(key, 1), memory.chance, clean).astype(jnp.int32)
        labels = memory.labels.at[memory.steps % length].set(label.astype(jnp.int8))
        return action, NoisyMemory(own, memory.chance, memory.steps + 1, labels, other)

    return Policy(params, init, act, policy.sees)


class RecordedHistories(NamedTuple):
    """Recorded histories of some tasks, as NumPy arrays.

    Attributes:
        state: uint8 (B, E * T, S), state records before each step.
        actions: int8 (B, E * T), the agent's actions.
        teammate_actions: int8 (B, E * T), the teammate's actions.
        rewards: int8 (B, E * T), rewards of the team.
        expert_actions: int8 (B, E * T), the labels.
        episode_end_state: uint8 (B, E, S), state records after each episode.
    """

    state: np.ndarray
    actions: np.ndarray
    teammate_actions: np.ndarray
    rewards: np.ndarray
    expert_actions: np.ndarray
    episode_end_state: np.ndarray


def record_histories(
    make_ego: Callable[[Layout], Policy],
    tasks: Sequence[Task],
    config: NoiseConfig,
    suite: Path | None = None,
    played: Callable[[int], None] = lambda episodes: None,
    make_labeller: Callable[[Layout], Policy] | None = None,
    swaps: Mapping[str, TeammateSwaps] = MappingProxyType({}),
) -> RecordedHistories:
    """Play `config.histories` histories of each task, in the order of the tasks.

    Args:
        make_ego: function from a layout to the agent, as for `evaluate`.
        tasks: tasks with one layout and teammate family; their seeds determine the noise schedules and the episodes.
        config: number, length and noise of the histories.
        suite: folder of learned teammates, if tasks have any.
        played: function for progress, called with the number of episodes played since the last call.
        make_labeller: function from a layout to another agent that labels the histories; `searcher` for the script
            `search`, which may label histories of any agent.
        swaps: task id -> changes of the teammate, see `plan_swaps`; by default the teammate never changes.

    Raises:
        OptionError: if an agent does not fit the layout, or the labeller takes other inputs than the agent.
    """
    chances = np.concatenate([noise_schedules(config, task.seed) for task in tasks])
    seeds, searched = range(config.histories), make_labeller is searcher

    @cache  # all segments share one compiled program only if the agent is the same object
    def noisy_agent(layout: Layout) -> Policy:
        own = None if make_labeller is None or searched else make_labeller(layout)
        return with_noise(make_ego(layout), KEPT_STEPS, own)

    every = next((one.every for one in swaps.values()), None)
    protocol = replace(get_protocol("seeded", config.episodes), swap_every=every)
    programs, prepared, parts = ProgramCache(), None, list[tuple[np.ndarray, ...]]()
    for length in segment_lengths(protocol):  # within a segment, teammates do not change
        mates = [swaps[one.task_id].teammate(len(parts)) if one.task_id in swaps else one.teammate for one in tasks]
        playing = [replace(task, teammate=mate) for task, mate in zip(tasks, mates, strict=True)]
        prepared = prepare_rollout(noisy_agent, playing, protocol, seeds, suite, programs=programs, earlier=prepared)
        for _ in range(length):
            rollout, state, episode = prepared
            state = state._replace(ego=state.ego._replace(chance=jnp.asarray(chances[:, len(parts)])))
            state, one = episode(rollout.ego.params, rollout.teammate_params, state)
            prepared = prepared._replace(state=state)
            actions = np.asarray(one.actions, np.int8)
            rewards, labels = np.asarray(one.reward, np.int8), np.asarray(state.ego.labels)
            record, end = np.asarray(one.record), np.asarray(one.end)[:, None]
            parts.append((record, actions[..., EGO], actions[..., TEAMMATE], rewards, labels, end))
            played(len(chances))
    found = RecordedHistories(*(np.concatenate(field, axis=1) for field in zip(*parts, strict=True)))
    if searched:
        found = found._replace(expert_actions=search_labels(tasks[0].layout, found.state, found.actions))
    return found


def plan_swaps(tasks: Sequence[Task], episodes: int, every: int) -> dict[str, TeammateSwaps]:
    """Return the sequence of teammates in each task's histories, by task id.

    A sequence begins with the task's teammate. The teammates of all other tasks with the same layout, track, split
    and kind of teammate follow, in the cyclic order of `tasks`. No validation teammate plays in a training history,
    because splits are not mixed. Tasks without another teammate to swap with are left out.

    Args:
        tasks: the tasks.
        episodes: number of episodes of each history.
        every: number of episodes after which the next teammate plays.

    Raises:
        OptionError: if `every` is not between 1 and `episodes` - 1, or no task has another teammate to swap with.
    """
    if not 0 < every < episodes:
        raise OptionError(f"swap = {every}: expected 1 to {episodes - 1}, since a history has {episodes} episodes")
    groups: dict[Any, dict[str, dict[str, Any]]] = defaultdict(dict)
    for task in tasks:
        groups[_swap_group(task)].setdefault(teammate_id(task.teammate), task.teammate)
    found = {}
    for task in tasks:
        group = groups[_swap_group(task)]
        if len(group) > 1:
            first = list(group).index(teammate_id(task.teammate))
            in_turn = [*group.values()][first:] + [*group.values()][:first]
            found[task.task_id] = TeammateSwaps(every, in_turn[: -(-episodes // every)])
    if not found:
        raise OptionError(
            f"swap = {every}: expected at least 2 teammates of the same kind, split and layout, found 1, as in "
            f"{tasks[0].task_id}; select more histories, or give a --manifest"
        )
    return found


def _swap_group(task: Task) -> tuple[str, ...]:
    return task.layout.name, task.track, task.split, task.teammate_kind


class Teammates(NamedTuple):
    """Tasks with the teammates of a release, and recorded returns of reference egos.

    Attributes:
        tasks: one task for each teammate, with seeds of source `agent`.
        references: task id -> returns of reference egos, if the release states them.
        suite: folder of the checkpoints of learned teammates.
        root: folder or address of the release.
    """

    tasks: list[Task]
    references: dict[str, ReferenceEgos]
    suite: Path
    root: str | Path


def release_teammates(dataset: Dataset, number: int = 0, tasks: Sequence[Task] = ()) -> Teammates:
    """Return one task for each teammate in a selection of histories or in other tasks.

    Args:
        dataset: selection of histories.
        number: number of the collection, from 0, which determines the seeds of the tasks.
        tasks: tasks with additional heuristic teammates; tasks on layouts without selected histories are left out.

    Raises:
        NotStoredError: if the release was made without its tasks.
        OptionError: if one of `tasks` has a learned teammate.
    """
    history_of = dict(zip(dataset.column("task_id").tolist(), dataset.ids.tolist(), strict=True))
    wanted = {dataset.history_task(history_id).task_id for history_id in history_of.values()}
    known = [task for task in dataset.tasks.values() if task.task_id in wanted]
    found: dict[tuple[str, str], Task] = {}
    references = {}
    for task in known + tasks_on_layouts(tasks, dataset.layouts):
        if task.teammate_key in found:
            continue
        seed = FIRST_SEED + number * _SEEDS + len(found)
        played = make_task(task.track, task.split, task.layout.name, task.teammate, seed, task.recipes)
        found[task.teammate_key] = played
        made = dataset.provenance.get(task.task_id)
        if made is not None and made.references is not None:
            references[played.task_id] = made.references
    suite = dataset.origin.fetch_folder(TEAMMATES)
    root = str(dataset.origin) if isinstance(dataset.origin, Remote) else dataset.root
    return Teammates(list(found.values()), references, suite, root)


def collect_release(
    agent: NamedEgo,
    teammates: Teammates,
    config: NoiseConfig,
    out: Path,
    *,
    labeller: NamedEgo | None = None,
    swap: int | None = None,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Path:
    """Record histories of an agent with every teammate, and write them as a release of source `agent`.

    Until the release is complete, finished groups of tasks are stored in a folder with the name of `out` and the ending
    `.parts`. The same call resumes from this folder.

    Args:
        agent: agent that plays.
        teammates: tasks to play, see `release_teammates`.
        config: number, length and noise of each task's histories.
        out: folder of the release.
        labeller: another agent, whose choices become the expert actions; by default the agent's choices before noise.
        swap: number of episodes after which the teammate changes, see `plan_swaps`; None for no changes.
        overwrite: whether to replace a release at `out`.
        progress: function for progress, called with (description, episodes played, number of episodes).

    Raises:
        OptionError: if `out` may not be written, an agent does not fit a layout, the labeller takes other inputs than
            the agent, the stored parts have other settings, or `swap` is invalid, see `plan_swaps`.
    """
    out = out.resolve()
    check_target(out, overwrite, [teammates.root])
    swaps = {} if swap is None else plan_swaps(teammates.tasks, config.episodes, swap)
    views: dict[Layout, LabelView] = {}
    for layout in dict.fromkeys(task.layout for task in teammates.tasks):
        policy, other = agent.make(layout), None if labeller is None else labeller.make(layout)
        if labeller is None or labeller.make is not searcher:  # `search` labels the histories of any agent
            with_noise(policy, KEPT_STEPS, other)
        views[layout] = (other or policy).label_view
    parts = out.with_name(f"{out.name}.parts")
    settings = {
        "agent": agent.name,
        "details": agent.details,
        "labeller": labeller and [labeller.name, labeller.details],
        "noise": asdict(config),
        "swap": swap,
        "tasks": [task.task_id for task in teammates.tasks],
        "xla_threads": xla_threads(),
        "code_version": version("icrl4aht-data"),
    }
    if (begun := parts / "settings.json").exists():
        check_same_settings(read_json(begun), settings, f"{parts}: holds parts")
    parts.mkdir(parents=True, exist_ok=True)
    write_json(begun, settings)
    total = len(teammates.tasks) * config.histories * config.episodes
    show, label = bar_updater(progress, f"{agent.name}: episodes", total), labeller and labeller.make
    by = f"{agent.name}, before the noise" if labeller is None else f"{labeller.name}, in histories of {agent.name}"
    new = []
    # A script reads the dish from the recipes of its layout, so the tasks of a group must have the same recipes.
    scripted = agent.make in SCRIPTED
    for group, tasks in grouped(
        teammates.tasks, lambda task: (task.layout.name, task.teammate_kind, task.layout.recipes if scripted else ())
    ).items():
        folder = parts / "-".join([*group[:2], *("".join(map(str, recipe)) for recipe in group[2])])
        if folder.is_dir():
            show(len(tasks) * config.histories * config.episodes)
        else:
            _save_part(folder, record_histories(agent.make, tasks, config, teammates.suite, show, label, swaps))
        for number, task in enumerate(tasks):
            labels = ExpertLabels(policy_sha256=None, action=by, view=views[task.layout])
            new.append(_agent_task(task, number, folder, labels, config, teammates, swaps.get(task.task_id)))
    write_release(out, "lite", new, data_version="1.0.0", overwrite=overwrite, sources=[teammates.root])
    shutil.rmtree(parts)
    return out


def _save_part(folder: Path, recorded: RecordedHistories) -> None:
    """Write the arrays of a group of tasks into a folder, which is created atomically."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # left by a killed run
    partial.mkdir()
    for name, array in recorded._asdict().items():
        np.save(partial / f"{name}.npy", array)
    partial.rename(folder)


def _agent_task(
    task: Task,
    number: int,
    folder: Path,
    labels: ExpertLabels,
    config: NoiseConfig,
    teammates: Teammates,
    swaps: TeammateSwaps | None,
) -> NewTask:
    """Return a task whose histories are read from a group's folder when the release is written."""
    rows = slice(number * config.histories, (number + 1) * config.histories)
    rewards = np.load(folder / "rewards.npy", mmap_mode="r")[rows]
    returns = rewards.reshape(config.histories, config.episodes, -1).sum(axis=-1, dtype=np.float64)

    def load() -> Iterator[NewHistory]:
        arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r")[rows] for name in RecordedHistories._fields}
        for stream in range(config.histories):
            of_history = {name: array[stream] for name, array in arrays.items()}
            of_history["dones"] = episode_ends(rewards.shape[1], KEPT_STEPS)
            if made.is_oracle_useful(curve_ends(returns)[1].mean()):
                of_history["oracle_actions"] = oracle_labels(task.layout, of_history["state"], of_history["actions"])
            yield NewHistory(stream, of_history)

    made = Provenance(
        code_version=version("icrl4aht-data"),
        jax_version=jax.__version__,
        platform=jax.default_backend(),
        xla_threads=xla_threads(),
        seed=task.seed,
        source=SOURCE,
        noise=json.loads(json.dumps(asdict(config))),
        references=teammates.references.get(task.task_id),
        teammate={"slot": TEAMMATE, "noise": "seeded"},
        streams_recorded=config.histories,
        streams_kept=config.histories,
        expert=labels,
        swaps=swaps,
    )
    files: dict[str, Path] = {}
    for one in made.played_tasks(task):
        files |= checkpoint_files(teammates.suite, one)
    return NewTask(task, made, config.histories, load, files)
