"""Episodes to look at: an agent beside a teammate, as a GIF."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from baselines.agents.egos import AGENTS, find_agent, get_agent
from baselines.evaluate.evaluator import play_tasks
from baselines.evaluate.protocols import Protocol
from baselines.report.results import Run, Source, families_of, place_of
from generation.policy import Policy
from icrl4aht_data.benchmark.reference_returns import has_headroom, read_headroom
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.utils.threads import usable_cores

Ego = Callable[[Layout], Policy]
"""The maker of an ego for a layout."""


class EpisodeGif(NamedTuple):
    """An episode of a reported agent beside a teammate of one family."""

    family: str
    told: str  # who plays what, and what it earned; or why there is no picture
    path: Path | None  # the GIF


def episode_gif(
    path: Path,
    task: Task,
    make_ego: Ego,
    protocol: Protocol,
    *,
    seed: int = 0,
    cell: int = 32,
    suite: Path | None = None,
) -> float:
    """Write the first episode of a task as a GIF, `cell` pixels a map cell. Returns the team's return."""
    (played,) = play_tasks(make_ego, [task], dataclasses.replace(protocol, episodes=1), [seed], suite)
    record, reward = np.asarray(played.record[0]), np.asarray(played.reward[0])
    save_episode(path, task.layout, record, reward, cell=cell)
    return float(reward.sum())


def film_families(runs: Sequence[Run], folder: Path, suite: Path | None = None) -> list[EpisodeGif]:
    """The first episode of a task that each agent was evaluated on, for every family of teammates.

    The task is of a layout where that family leaves headroom, if there is one among the results.

    Args:
        runs: what is reported.
        folder: for the GIFs.
        suite: the folder that learned teammates' checkpoints are in.

    Returns:
        Run after run, families in order; of an agent that cannot be played again, why.
    """
    scenes = []
    for run in runs:
        headroom = read_headroom(run.protocol)
        there = [(source, cell) for source in run.sources for cell in source.tasks]
        for family in families_of(cell for _, cell in there):
            of_family = [found for found in there if found[1][1] == family]
            roomy = [found for found in of_family if found[1] in headroom and has_headroom(headroom[found[1]])]
            source, cell = min(roomy or of_family, key=lambda found: place_of(found[1]))
            scenes.append((run, source, source.tasks[cell]))
    egos = {source.folder: _again(source) for _, source, _ in scenes}

    def play(number: int) -> EpisodeGif:
        run, source, task = scenes[number]
        return _film_result(run, source, task, egos[source.folder], folder / f"{number}.gif", suite)

    with ThreadPoolExecutor(min(4, usable_cores())) as pool:  # compiling takes longer than playing
        return list(pool.map(play, range(len(scenes))))


def _film_result(
    run: Run, source: Source, task: Task, ego: Ego | Icrl4ahtError, path: Path, suite: Path | None
) -> EpisodeGif:
    protocol, seed = Protocol(**source.settings["protocol"]), source.settings["seeds"][0]
    family = task.teammate_family
    told = f"{run.label} beside {family}/t{task.teammate['theta_id']} on {task.layout.name}"
    which = f"Task {task.task_id}, protocol {protocol.name}, seed {seed}."
    try:
        if isinstance(ego, Icrl4ahtError):
            raise ego
        earned = episode_gif(path, task, ego, protocol, seed=seed, cell=24, suite=suite)
    except Icrl4ahtError as error:
        return EpisodeGif(family, f"{told}: no picture, {error}. {which}", None)
    return EpisodeGif(family, f"{told}: team return {earned:g} in episode 1 of {protocol.episodes}. {which}", path)


def _again(source: Source) -> Ego | Icrl4ahtError:
    try:
        return ego_of(source)
    except Icrl4ahtError as error:
        return error


def ego_of(source: Source) -> Ego:
    """The ego that results are of.

    Raises:
        OptionError: if it cannot be made again; says why.
    """
    name, details = source.settings["agent"], dict(source.settings.get("details", {}))
    if source.trained is None:
        if name not in AGENTS:
            raise OptionError(f"{name} is neither a reference ego nor of a run folder")
        return get_agent(name)
    folder = source.trained["run"]
    if not Path(folder).is_dir():
        raise OptionError(f"its run folder {folder} is gone")
    details.pop("variant", None)
    agent = find_agent(folder, details.get("acting", "cached"))
    if agent.details != details:
        raise OptionError(f"{folder} holds another model than these results are of: {agent.details}, not {details}")
    return agent.make
