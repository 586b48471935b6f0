"""Episodes as GIFs: an agent with a teammate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import numpy as np

from baselines.agents.egos import AGENTS, PlayMode, find_agent, get_agent
from baselines.evaluate.evaluator import play_tasks
from baselines.evaluate.protocols import Protocol
from baselines.report.overlap import describe_overlap
from baselines.report.results import EvaluationRun, ResultSource, cell_of, cell_order, group_of, groups_of
from generation.policy import Policy
from icrl4aht_data.benchmark.reference_returns import has_headroom, read_headroom
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.utils.threads import usable_cores

_PROGRESS = "episodes of the report"


class EpisodeGif(NamedTuple):
    """An episode of a reported agent with a teammate of one family.

    Attributes:
        family: of the teammate.
        caption: who plays which task, and the return; or why there is no picture.
        path: the GIF, or None.
    """

    family: str
    caption: str
    path: Path | None


def episode_gif(
    path: Path,
    task: Task,
    make_ego: Callable[[Layout], Policy],
    protocol: Protocol,
    *,
    seed: int = 0,
    cell: int = 32,
    suite: Path | None = None,
) -> float:
    """Write the first episode of a task as a GIF with `cell` pixels per map cell. Returns the team's return."""
    (played,) = play_tasks(make_ego, [task], dataclasses.replace(protocol, episodes=1), [seed], suite)
    record, reward = np.asarray(played.record[0]), np.asarray(played.reward[0])
    save_episode(path, task.layout, record, reward, cell=cell)
    return float(reward.sum())


def family_gifs(
    runs: Sequence[EvaluationRun],
    folder: Path,
    suite: Path | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> list[EpisodeGif]:
    """Write the first episode of an evaluated task for each agent and family of teammates.

    The task is on a layout where that family leaves headroom, if there is one among the results.

    Args:
        runs: what is reported.
        folder: for the GIFs.
        suite: folder of learned teammates' checkpoints.
        progress: called with (description, episodes drawn, episodes), from the calling thread.

    Returns:
        Run after run, families in order. If an agent cannot be restored, the caption says why.
    """
    chosen = []
    for run in runs:
        headroom = read_headroom(run.protocol)
        played = [(source, cell) for source in run.sources for cell in source.tasks]
        for family in groups_of(cell for _, cell in played):
            of_family = [found for found in played if found[1][1] == family]
            open_cells = [found for found in of_family if found[1] in headroom and has_headroom(headroom[found[1]])]
            source, cell = min(open_cells or of_family, key=lambda found: cell_order(found[1]))
            chosen.append((run, source, source.tasks[cell][0]))
    egos = {source.folder: _restore(source) for _, source, _ in chosen}

    def draw(number: int) -> EpisodeGif:
        run, source, task = chosen[number]
        return _draw_result(run, source, task, egos[source.folder], folder / f"{number}.gif", suite)

    progress(_PROGRESS, 0, len(chosen))
    with ThreadPoolExecutor(min(4, usable_cores())) as pool:  # compiling takes longer than playing
        drawn = [pool.submit(draw, number) for number in range(len(chosen))]
        for done, future in enumerate(as_completed(drawn), start=1):
            future.result()
            progress(_PROGRESS, done, len(chosen))
    return [future.result() for future in drawn]


def _draw_result(
    run: EvaluationRun,
    source: ResultSource,
    task: Task,
    ego: Callable[[Layout], Policy] | Icrl4ahtError,
    path: Path,
    suite: Path | None,
) -> EpisodeGif:
    protocol, seed = Protocol(**source.settings["protocol"]), source.settings["seeds"][0]
    family = task.teammate_family
    group = group_of(cell_of(task))
    kind = "" if group == "test" else f" ({group})"  # a number without it names a published teammate
    players = f"{run.label} with {family}/t{task.teammate['theta_id']}{kind} on {task.layout.name}"
    trained = describe_overlap([task], source.seen)
    origin = f"Task {task.task_id}, protocol {protocol.name}, seed {seed}. {trained}"
    try:
        if isinstance(ego, Icrl4ahtError):
            raise ego
        earned = episode_gif(path, task, ego, protocol, seed=seed, cell=24, suite=suite)
    except Icrl4ahtError as error:
        return EpisodeGif(family, f"{players}: no picture, {error}. {origin}", None)
    return EpisodeGif(family, f"{players}: team return {earned:g} in episode 1 of {protocol.episodes}. {origin}", path)


def _restore(source: ResultSource) -> Callable[[Layout], Policy] | Icrl4ahtError:
    try:
        return restore_ego(source)
    except Icrl4ahtError as error:
        return error


def restore_ego(source: ResultSource) -> Callable[[Layout], Policy]:
    """Returns the function that makes the ego of some results, layout -> policy.

    Raises:
        OptionError: if the ego is neither a reference ego nor trained, or its run folder is missing or has changed.
    """
    name, details = source.settings["agent"], dict(source.settings.get("details", {}))
    if name in AGENTS:
        return get_agent(name)
    if source.trained is None and "model" not in details:
        raise OptionError(f"{name} is neither a reference ego, nor a bundled model, nor of a run folder")
    folder = details.get("model") or (source.trained or {})["run"]
    if "model" not in details and not Path(folder).is_dir():
        raise OptionError(f"its run folder {folder} is missing")
    details.pop("variant", None)
    agent = find_agent(folder, PlayMode.from_details(details))
    if agent.details != details:
        raise OptionError(f"{folder} holds another model than these results are of: {agent.details}, not {details}")
    return agent.make
