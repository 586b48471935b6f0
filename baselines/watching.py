"""Episodes to look at: an agent beside a teammate, as a GIF."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from baselines.agents import get_agent
from baselines.evaluate import Protocol, get_protocol, play_tasks
from baselines.report import LAYOUTS, Run
from generation.teammates.base import Policy
from generation.teammates.instances import named_task
from icrl4aht_data.headroom import HEURISTICS, has_headroom, read_headroom
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.tasks import Task


def film(
    path: Path, task: Task, make_ego: Callable[[Layout], Policy], protocol: Protocol, *, seed: int = 0, cell: int = 32
) -> float:
    """Write the first episode of a task as a GIF, `cell` pixels a map cell. Returns the team's return."""
    (played,) = play_tasks(make_ego, [task], dataclasses.replace(protocol, episodes=1), [seed])
    record, reward = np.asarray(played.record[0]), np.asarray(played.reward[0])
    save_episode(path, task.layout, record, reward, cell=cell)
    return float(reward.sum())


def film_families(runs: Sequence[Run], folder: Path, ego: str = "oracle") -> list[tuple[str, Path]]:
    """An episode per heuristic family, on the first layout of the runs where that family leaves headroom.

    Args:
        runs: what is reported.
        folder: for the GIFs.
        ego: a reference ego; what the reported agents could have done.

    Returns:
        Captions and files.
    """
    protocol = runs[0].protocol
    headroom = read_headroom(protocol)
    layouts = [layout for layout in LAYOUTS if any(cell[0] == layout for run in runs for cell in run.cells)] or LAYOUTS
    films = []
    for family in HEURISTICS:
        roomy = [name for name in layouts if has_headroom(headroom[name, family])]
        layout = (roomy or list(layouts))[0]
        path = folder / f"{family}.gif"
        earned = film(path, named_task(layout, f"{family}/t0"), get_agent(ego), get_protocol(protocol), cell=24)
        films.append((f"{family}/t0 on {layout} beside the ego {ego}: return {earned:g}", path))
    return films
