"""Checks of observations, steps and episode starts against the rules of the game."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import columns, start
from icrl4aht_data.reading.history import History
from icrl4aht_data.writing.published_views import empty_views


def observation_faults(layout: Layout, history: History) -> Iterator[str]:
    """Yield a problem if an observation does not match the layout's fixed cells; needs no state records."""
    fixed = fixed_channels(layout)
    views = {view.tobytes() for view in empty_views(layout)[..., fixed]}
    wrong = [t for t, seen in enumerate(history.read("obs")[..., fixed]) if seen.tobytes() not in views]
    if wrong:
        yield f"obs: {len(wrong)} steps do not show {layout.name} from any cell of the ego's, first step {wrong[0]}"


def replay_faults(layout: Layout, history: History, dones: np.ndarray, rewards: np.ndarray) -> Iterator[str]:
    """Replay every step of a history with state records, and yield contradictions to the rules.

    Args:
        layout: the history's layout.
        history: the history, with possible states only.
        dones: bool (T,), last steps of episodes.
        rewards: (T,), the recorded rewards.
    """
    states, ends = history.read("state"), history.read("episode_end_state")
    if history.kind == "full":
        wrong = np.flatnonzero((history.read("obs") != observe(layout, states, EGO)).any(axis=(1, 2, 3)))
        if len(wrong):
            yield f"obs: {len(wrong)} steps differ from what their state shows, first step {wrong[0]}"
    following = np.concatenate([states[1:], states[:1]])
    following[dones] = ends
    recipe = columns(layout).recipe
    actions = np.stack([history.read("actions"), history.read("teammate_actions")], axis=-1)
    # New recipes are random, so the replay takes the recorded ones.
    played = step(layout, states, np.clip(actions, 0, len(ACTIONS) - 1), following[:, recipe])
    wrong = np.flatnonzero((played.state != following).any(axis=-1))
    if len(wrong):
        yield f"replay: {len(wrong)} steps do not lead to the recorded next state, first step {wrong[0]}"
    wrong = np.flatnonzero(played.reward != rewards)
    if len(wrong):
        t = int(wrong[0])
        yield f"replay: {len(wrong)} rewards differ, first at step {t}: rules {played.reward[t]}, found {rewards[t]}"
    if not np.isin([*states[:, recipe], *ends[:, recipe]], layout.recipe_items).all():
        yield "a recipe is not one of the layout's"
    starts = states[np.concatenate([[0], np.flatnonzero(dones)[:-1] + 1])]
    positions = starts[:, columns(layout).positions]
    fresh = start(layout, positions, starts[:, columns(layout).facings], starts[:, recipe])
    differs = (fresh != starts).any(axis=-1)
    for agent in (0, 1):
        differs |= ~np.isin(positions[:, agent], layout.rooms[agent])
    if differs.any():
        yield f"{differs.sum()} episodes do not start as the environment starts, first episode {differs.argmax()}"
