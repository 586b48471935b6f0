"""An agent that runs on the host, in NumPy, and records its inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from icrl4aht_baselines.agents.host import EgoInput

from icrl4aht_data.overcooked.actions import STAY


class HostRecorder:
    """An agent on the host that takes chosen actions, by default `stay`, and records its inputs and actions.

    Args:
        choose: function that takes the number of tasks and returns an action for each task.
    """

    def __init__(self, choose: Callable[[int], Any] = lambda batch: np.full(batch, STAY)) -> None:
        self.choose = choose
        self.seen: list[list[EgoInput]] = []
        self.played: list[list[Any]] = []

    def reset(self, batch: int) -> None:
        self.seen.append([])
        self.played.append([])

    def act(self, ego_input: EgoInput) -> Any:
        self.seen[-1].append(ego_input)
        self.played[-1].append(self.choose(len(ego_input.obs)))
        return self.played[-1][-1]
