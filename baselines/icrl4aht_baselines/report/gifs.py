"""GIFs of episodes that an agent plays with a teammate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrl4aht_baselines.agents.egos import AGENTS, find_agent
from icrl4aht_baselines.evaluate.evaluator import MakeEgo, play_tasks
from icrl4aht_baselines.evaluate.protocols import Protocol, controlled_name
from icrl4aht_baselines.report.results import EvaluationRun, ResultCell, ResultSource
from icrl4aht_baselines.report.scores import known_headroom
from icrl4aht_baselines.training.seen import describe_overlap
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.progress import bar_updater
from icrl4aht_data.utils.system import usable_cores


class ShownEpisode(NamedTuple):
    """Episode that is drawn as a GIF.

    Attributes:
        number: number of the episode in its task, from 1.
        earned: return of the team in the episode.
        path: path of the GIF.
    """

    number: int
    earned: float
    path: Path


class EpisodePair(NamedTuple):
    """First and last episode of a task that an agent played with a teammate of one family.

    Attributes:
        cell: layout, family and kind of the task.
        title: text with agent, teammate and layout.
        caption: text with the task and the overlap with training data, and the reason if episodes could not be drawn.
        episodes: first and last episode; only one if the task has one episode, none if the agent cannot be restored.
    """

    cell: ResultCell
    title: str
    caption: str
    episodes: tuple[ShownEpisode, ...] = ()


def save_episode_gifs(
    paths: Mapping[int, Path],
    task: Task,
    make_ego: MakeEgo,
    protocol: Protocol,
    *,
    seed: int = 0,
    cell: int = 32,
    suite: Path | None = None,
    forget: bool = False,
) -> tuple[ShownEpisode, ...]:
    """Play a task, and write some of its episodes as GIFs. The returns equal those that `evaluate` stores.

    Args:
        paths: path of the GIF of each episode to write, by the episode's number, counted from 1. Play ends after the
            last of these episodes.
        task, make_ego, protocol, seed, suite, forget: see `evaluator.play_tasks`.
        cell: width and height of a map cell in pixels.
    """
    shown = []
    shortened = dataclasses.replace(protocol, episodes=max(paths))
    played = play_tasks(make_ego, [task], shortened, [seed], suite, forget)
    for number, episode in enumerate(played, start=1):
        if number in paths:
            record, reward = np.asarray(episode.record[0]), np.asarray(episode.reward[0])
            save_episode(paths[number], task.layout, record, reward, cell=cell)
            shown.append(ShownEpisode(number, float(reward.sum()), paths[number]))
    return tuple(shown)


def family_gifs(
    runs: Sequence[EvaluationRun], folder: Path, suite: Path | None, progress: Callable[..., None]
) -> list[EpisodePair]:
    """Write GIFs of the first and last episode of a task, for each agent and family of teammates.

    The task is on a layout on which the family has headroom, if the results have such a layout.

    Args:
        runs: results of the agents.
        folder: folder for the GIFs.
        suite: folder of learned teammates' checkpoints.
        progress: function for progress, called with (description, tasks drawn, number of tasks).

    Returns:
        The episodes of each run in turn, with families in the paper's order. If an agent cannot be restored, the
        caption says why.
    """
    chosen: list[tuple[EvaluationRun, ResultCell]] = []
    for run in runs:
        headroom = known_headroom(run.protocol)
        ordered = sorted(run.cells, key=lambda cell: (cell.order[1:], not headroom.get(cell)))
        chosen += [(run, cells[0]) for cells in grouped(ordered, lambda cell: cell[1:]).values()]
    advance = bar_updater(progress, "episodes of the report", len(chosen))
    with ThreadPoolExecutor(min(4, usable_cores())) as pool:  # threads compile in parallel
        drawn = [pool.submit(_draw_result, *each, folder / str(number), suite) for number, each in enumerate(chosen)]
        for _ in as_completed(drawn):
            advance(1)
    return [future.result() for future in drawn]


def _draw_result(run: EvaluationRun, cell: ResultCell, prefix: Path, suite: Path | None) -> EpisodePair:
    source, task = run.source(cell), run.tasks(cell)[0]
    protocol, seed = Protocol(**source.settings["protocol"]), source.settings["seeds"][0]
    # Titles name the kind of tasks, because "H1/t0" alone means a published test teammate.
    kind = "" if cell.kind == "test" else f" ({cell.kind})"
    title = f"{run.label} with {cell.family}/t{task.teammate['theta_id']}{kind} on {cell.layout}"
    origin = f"Task {task.task_id}, protocol {protocol.name}, seed {seed}. {describe_overlap(run.overlaps([cell]))}"
    try:
        paths = {number: prefix.with_name(f"{prefix.name}-{number}.gif") for number in (1, protocol.episodes)}
        if source.detail("swapped"):
            raise OptionError(
                "results with swapped teammates have no GIFs, because another teammate played the earlier episodes"
            )
        ego, forget = restore_ego(source), bool(source.detail("forget"))
        shown = save_episode_gifs(paths, task, ego, protocol, seed=seed, cell=24, suite=suite, forget=forget)
        return EpisodePair(cell, title, origin, shown)
    except Icrl4ahtError as error:
        return EpisodePair(cell, title, f"No picture: {error}. {origin}")


def restore_ego(source: ResultSource) -> MakeEgo:
    """Return the ego that was evaluated, as a function from a layout to the ego's policy.

    Raises:
        OptionError: if the ego is neither a reference ego nor a trained model, or the model is missing or has
            changed.
    """
    name, details = source.settings["agent"], dict(source.settings.get("details", {}))
    name = name.removesuffix(controlled_name("", "cleared")) if details.pop("forget", None) else name
    if name in AGENTS:
        return AGENTS[name]
    folder = details.get("model") or (source.trained or {}).get("run")
    if folder is None:
        raise OptionError(f"{name} is neither a reference ego, nor a bundled model, nor a model with a run folder")
    if "model" not in details and not Path(folder).is_dir():
        raise OptionError(f"the run folder {folder} of {name} is missing")
    agent = find_agent(folder, acting=details.get("acting"), greedy=not details.get("sampled"))
    if agent.details != details:
        raise OptionError(f"{folder} holds another model: expected {details} as in the results, found {agent.details}")
    return agent.make
