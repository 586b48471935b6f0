"""Sessions of `icrl4aht-data play` for tests, and a script that plays instead of a person."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from icrl4aht_baselines.evaluate.rollout import task_key
from icrl4aht_baselines.play.game import Game, PolicyPlayer, find_partner
from icrl4aht_baselines.play.recording import GameRecorder, human_task
from icrl4aht_baselines.play.server import PlaySession
from icrl4aht_generation.experts.oracle import oracle

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import get_layout

LAYOUT = get_layout("cramped_up")
"""Layout of all games."""


def new_session(
    partner: str = "stay", episodes: int = 2, steps: int = 8, record: Path | None = None, **options: Any
) -> PlaySession:
    """Return a session without reference egos, in which the game steps only when a test sends an action."""
    found = find_partner(partner, LAYOUT, 1)
    recorder, name = None, "a test"
    if record:
        task = human_task(found, 7)
        recorder, name = GameRecorder(record, task, 0), task.task_id
    game = Game(LAYOUT, [None, found.player], task_key(0, name), episodes, steps)
    return PlaySession(game, partner, **{"ticks": 0, "recorder": recorder, "compared": ()} | options)


def scripted_person() -> Callable[[Sequence[int], int, int], int]:
    """Return a function from a state record, the episode and the step to the action of the oracle as the ego."""
    plan, key = PolicyPlayer(oracle(LAYOUT), LAYOUT, EGO, is_ego=True), task_key(0, "plan")

    def act(record: Sequence[int], episode: int, step: int) -> int:
        if step == 0:
            plan.begin(key, key, episode)
        return plan.act(np.array(record, np.uint8), (None,) * 5, step)  # type: ignore[arg-type]

    return act
