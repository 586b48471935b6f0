"""Learner + teammate -> history arrays: keeps the first steps of every episode. No files of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from generation.learners.ppo import PPOConfig, Rollout
from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size


class Histories(NamedTuple):
    """N histories of T = episodes x 100 steps; arrays or memory maps."""

    state: np.ndarray  # uint8 (N, T, S), before each step
    actions: np.ndarray  # int8 (N, T), sampled by the ego
    teammate_actions: np.ndarray  # int8 (N, T)
    rewards: np.ndarray  # int8 (N, T), the team's, unshaped
    episode_end_state: np.ndarray  # uint8 (N, E, S), after each episode's last kept step


def shapes(layout: Layout, config: PPOConfig) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and dtype of every array of `Histories`."""
    n, episodes, size = config.environments, config.episodes, record_size(layout)
    steps = (n, episodes * KEPT_STEPS)
    return {
        "state": ((*steps, size), "uint8"),
        "actions": (steps, "int8"),
        "teammate_actions": (steps, "int8"),
        "rewards": (steps, "int8"),
        "episode_end_state": ((n, episodes, size), "uint8"),
    }


def keep(histories: Histories, update: int, rollout: Rollout) -> None:
    """Write the kept steps of one roll-out into the histories.

    All environments start together and never end early, so the number of a step says its episode and its clock; writing
    a roll-out twice changes nothing.
    """
    length = rollout.record.shape[0]
    step = np.arange(update * length, (update + 1) * length)
    episode, clock = step // EPISODE_STEPS, step % EPISODE_STEPS
    whole = episode < histories.episode_end_state.shape[1]
    kept = whole & (clock < KEPT_STEPS)
    after = whole & (clock == KEPT_STEPS)
    record = np.asarray(rollout.record).swapaxes(0, 1)
    actions = np.asarray(rollout.actions).swapaxes(0, 1)
    to = episode[kept] * KEPT_STEPS + clock[kept]
    histories.state[:, to] = record[:, kept]
    histories.actions[:, to] = actions[:, kept, EGO]
    histories.teammate_actions[:, to] = actions[:, kept, TEAMMATE]
    histories.rewards[:, to] = np.asarray(rollout.reward).swapaxes(0, 1)[:, kept]
    histories.episode_end_state[:, episode[after]] = record[:, after]
