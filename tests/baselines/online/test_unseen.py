"""Returns on unseen layouts: equal to playing each layout alone; the command."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.agents.egos import AGENTS
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, task_key
from icrl4aht_baselines.online import unseen
from icrl4aht_baselines.online.unseen import unseen_layouts, unseen_returns
from icrl4aht_baselines.training.options import MOST_REARRANGED
from icrl4aht_generation.layouts.grids import canonical_map
from icrl4aht_generation.layouts.rearranged import rearranged_layouts
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout

TASKS = [
    task
    for task in bundled_tasks("layout", "diverse")
    if task.layout.name == "cramped_up" and task.teammate_family == "H1"
]


def test_unseen_layouts_are_not_training_layouts():
    layout = get_layout("asymm_both")
    trained = set(map(canonical_map, rearranged_layouts(layout, MOST_REARRANGED)))
    new = unseen_layouts(layout, 4)
    assert len(new) == 4 and not set(map(canonical_map, new)) & trained
    assert {(one.name, one.recipes) for one in new} == {(layout.name, layout.recipes)}


@pytest.mark.slow
def test_returns_equal_playing_each_layout_alone():
    found = unseen_returns({"oracle": AGENTS["oracle"]}, TASKS, 3, 2)["oracle"]["cramped_up", "H1"]
    assert found.shape == (3, 2)
    layout, task = unseen_layouts(TASKS[0].layout, 3)[-1], TASKS[-1]  # last version, last teammate
    mates = [build_teammate(layout, task.teammate)]
    rollout = EvaluationRollout(layout, AGENTS["oracle"](layout), mates, get_protocol("seeded"))
    state = rollout.start(task_key(2, task.task_id)[None])
    episode = jax.jit(rollout.episode)
    alone = []
    for _ in range(2):
        state, played = episode((), rollout.teammate_params, state)
        alone.append(float(played.reward.sum()))
    assert found[-1].tolist() == alone
    assert found.any()


def test_learned_teammates_play_on_their_own_layout_only():
    task = TASKS[0]
    learned = dataclasses.replace(task, teammate={**task.teammate, "kind": "rl"})
    with pytest.raises(OptionError, match=rf"{task.task_id}: its teammate is learned and plays on cramped_up only"):
        unseen_returns({}, [learned], 1, 1)


class TestCommand:
    @pytest.fixture
    def played(self, monkeypatch) -> list[Any]:
        """Replace playing by invented returns; collect the arguments of each call."""
        calls = []

        def returns(egos: dict[str, Any], tasks: list[Any], *sizes: Any) -> Any:
            calls.append((list(egos), {task.layout.name for task in tasks}, *sizes[:2]))
            cells = {(task.layout.name, task.teammate_family) for task in tasks}
            values = {"stay": 0.0, "oracle": 20.0}
            return {ego: {cell: np.full(sizes[:2], values.get(ego, 5.0)) for cell in cells} for ego in egos}

        monkeypatch.setattr(unseen, "unseen_returns", returns)
        return calls

    def test_table(self, played):
        command = ["research", "unseen", "--agent", "rl2-reference", "--versions", "4"]
        result = CliRunner().invoke(cli, command, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        assert played == [(["stay", "oracle", "rl2-reference"], {"asymm_both", "cramped_up"}, 4, 40)]
        assert "| `rl2-reference` | 5.0 (5.0 to 5.0) | 5.0 (5.0 to 5.0) |" in result.output
