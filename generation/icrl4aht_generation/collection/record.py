"""Roll-outs -> arrays of learning histories: the first steps of every episode. Writes no files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_generation.learners.rollout import Rollout

SCRIPT_ARRAYS = ("script_actions", "noise")
"""Arrays that artefacts of scripted sources have besides those of `HistoryArrays`, see `collection.scripted`."""


class HistoryArrays(NamedTuple):
    """N histories of E episodes and T = 100 E steps; NumPy arrays or memory maps.

    Attributes:
        state: uint8 (N, T, S), state records before each step.
        actions: int8 (N, T), the ego's sampled actions.
        teammate_actions: int8 (N, T).
        rewards: int8 (N, T), the team's, unshaped.
        episode_end_state: uint8 (N, E, S), state records after each episode's last kept step.
    """

    state: np.ndarray
    actions: np.ndarray
    teammate_actions: np.ndarray
    rewards: np.ndarray
    episode_end_state: np.ndarray


def array_shapes(layout: Layout, histories: int, episodes: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and dtype of every field of `HistoryArrays`."""
    n, size = histories, record_size(layout)
    steps = (n, episodes * KEPT_STEPS)
    return {
        "state": ((*steps, size), "uint8"),
        "actions": (steps, "int8"),
        "teammate_actions": (steps, "int8"),
        "rewards": (steps, "int8"),
        "episode_end_state": ((n, episodes, size), "uint8"),
    }


def arrays_bytes(shapes: Mapping[str, tuple[tuple[int, ...], str]]) -> int:
    """Return the uncompressed size of arrays, given their shapes and dtypes by name."""
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def record_rollout(histories: HistoryArrays, update: int, rollout: Rollout) -> None:
    """Write the kept steps of one roll-out into the histories.

    All environments start together and never end early, so the number of a step determines its episode and its clock;
    writing a roll-out twice changes nothing, which a resumed task relies on.
    """
    length = rollout.record.shape[0]
    step = np.arange(update * length, (update + 1) * length)
    episode, clock = step // EPISODE_STEPS, step % EPISODE_STEPS
    complete = episode < histories.episode_end_state.shape[1]
    kept = complete & (clock < KEPT_STEPS)
    after = complete & (clock == KEPT_STEPS)
    record = np.asarray(rollout.record).swapaxes(0, 1)
    actions = np.asarray(rollout.actions).swapaxes(0, 1)
    to = episode[kept] * KEPT_STEPS + clock[kept]
    histories.state[:, to] = record[:, kept]
    histories.actions[:, to] = actions[:, kept, EGO]
    histories.teammate_actions[:, to] = actions[:, kept, TEAMMATE]
    histories.rewards[:, to] = np.asarray(rollout.reward).swapaxes(0, 1)[:, kept]
    histories.episode_end_state[:, episode[after]] = record[:, after]
