"""Returns on layouts that no model was trained on, to measure generalization to new layouts.

Shapes: `V` layouts, `E` episodes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.layouts.rearranged import rearranged_layouts
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.registry import build_teammate
from jaxtyping import Float

from icrl4aht_baselines.agents.egos import ego_on
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, task_key
from icrl4aht_baselines.training.options import MOST_REARRANGED
from icrl4aht_data.benchmark.reference_returns import Cell
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout, get_layout


def unseen_returns(
    egos: Mapping[str, Callable[[Layout], Policy]],
    tasks: Sequence[Task],
    versions: int,
    episodes: int,
    played: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> dict[str, dict[Cell, Float[np.ndarray, "V E"]]]:
    """Play tasks on rearranged versions of their layouts, under the protocol `seeded`.

    Args:
        egos: agent -> function from a layout to its policy.
        tasks: tasks with heuristic teammates.
        versions: number of rearranged versions of each layout.
        episodes: episodes of each ego on each version with each teammate.
        played: called with (description, episodes played, episodes), for progress.

    Returns:
        Agent -> layout and family -> returns on each version with a teammate of the family.

    Raises:
        OptionError: if a teammate is learned and so plays on its own layout only, or if a layout has too few versions.
    """
    cells: dict[Cell, list[Task]] = defaultdict(list)
    for task in tasks:
        if task.teammate["kind"] != "heuristic":
            raise OptionError(
                f"task {task.task_id}: its teammate is learned and plays on {task.layout.name} only; expected "
                f"heuristics: leave these tasks out"
            )
        cells[task.layout.name, task.teammate_family].append(task)
    layouts = {name: unseen_layouts(get_layout(name), versions) for name, _ in cells}
    total, done = len(egos) * len(cells) * versions * episodes, 0
    found: dict[str, dict[Cell, Any]] = {name: {} for name in egos}
    for (layout, family), mates in cells.items():
        chosen = [mates[number] for number in np.linspace(0, len(mates) - 1, versions).astype(int)]
        for name, make in egos.items():
            played(f"{name} with {family} on {layout}", done, total)
            found[name][layout, family] = _returns(make, layouts[layout], chosen, episodes)
            done += versions * episodes
    played("all layouts", total, total)
    return found


def unseen_layouts(layout: Layout, count: int) -> list[Layout]:
    """Return rearranged versions of a layout that no model is trained on, with the layout's own recipes.

    They have the layout's name: settings by layout, such as hidden recipe indicators, apply to them as well.

    Raises:
        OptionError: as `rearranged_layouts`.
    """
    found = rearranged_layouts(layout, MOST_REARRANGED + count)[MOST_REARRANGED:]
    return [replace(layout, rows=one.rows) for one in found]


def _returns(
    make: Callable[[Layout], Policy], layouts: Sequence[Layout], tasks: Sequence[Task], episodes: int
) -> Float[np.ndarray, "V E"]:
    """Return the returns of an ego on each layout, with the teammate of the task of the same number."""
    mates = [build_teammate(None, task.teammate) for task in tasks]
    ego, numbers = ego_on(make, layouts), np.arange(len(layouts))
    rollout = EvaluationRollout(layouts, ego, mates, get_protocol("seeded"), numbers)
    state = jax.jit(rollout.start)(jnp.stack([task_key(number, task.task_id) for number, task in enumerate(tasks)]))
    episode, found = jax.jit(rollout.episode), []
    for _ in range(episodes):
        state, batch = episode(ego.params, rollout.teammate_params, state)
        found.append(np.asarray(batch.reward, np.float64).sum(axis=-1))
    return np.stack(found, axis=-1)
