"""Test the positive control of in-context learning: its small environments, learning algorithms and checks."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.control import control, worlds
from icrl4aht_baselines.training import trainer
from icrl4aht_generation.policy import Policy

from tests.helpers.commands import run_cli

TINY = control.ControlExperiment(bandit_steps=4, room_episodes=2, rows=64, tasks=4, updates=(2, 2, 2), batch_size=4)


def constant_policy(action: int) -> Policy:
    return Policy((), lambda params, key: (), lambda params, carry, view, key: (jnp.int32(action), carry), "ego_input")


def test_bandit_and_dark_room_give_expected_rewards():
    means = jnp.array([[0.0, 1.0, 0, 0, 0], [1.0, 0.0, 0, 0, 0]])
    actions, rewards = worlds.play_small_tasks(worlds.bandit(), constant_policy(1), means, 0, 6)
    assert actions.tolist() == [[1] * 6] * 2
    assert rewards.tolist() == [[1] * 6, [0] * 6]
    above, corner = worlds.MIDDLE - worlds.SIDE, 0
    _, rewards = worlds.play_small_tasks(
        worlds.dark_room(), constant_policy(0), jnp.array([above, corner]), 0, 2 * worlds.ROOM_STEPS
    )
    episode = [1] + [0] * (worlds.ROOM_STEPS - 1)  # the agent moves up past the goal to the wall
    assert rewards.tolist() == [episode * 2, [0] * 2 * worlds.ROOM_STEPS]
    assert worlds.best_return(np.array([above, corner])).tolist() == [10, 7]


def test_source_algorithms_improve_within_a_history():
    rng = np.random.default_rng(0)
    means = rng.random((300, worlds.ARMS))
    uniform = 100 * (means.max(axis=1) - means.mean(axis=1)).mean()
    for choose in (worlds.thompson, worlds.ucb):
        actions, _ = worlds.play_bandits(choose, means, 100, rng)
        regret = (means.max(axis=1, keepdims=True) - np.take_along_axis(means, actions, axis=1)).sum(axis=1).mean()
        assert regret < uniform / 2
    goals = np.delete(np.arange(worlds.CELLS), worlds.MIDDLE)
    cells, actions, rewards = worlds.dark_room_histories(np.tile(goals, 10), 20, rng)
    np.testing.assert_array_equal(cells.reshape(-1, worlds.ROOM_STEPS)[:, 0], worlds.MIDDLE)
    shares = rewards.reshape(len(cells), 20, -1).sum(axis=-1) / worlds.best_return(np.tile(goals, 10))[:, None]
    assert shares[:, 0].mean() < 0.3
    assert shares[:, -4:].mean() > 0.8


@pytest.mark.parametrize(("quantity", "code"), [("regret, at most", 0), ("regret, at least", 1)])
def test_control_command_exits_with_1_if_a_check_fails(tmp_path, monkeypatch, quantity, code):
    check = control.ControlCheck("bandits", "AD", quantity, 1.0, 2.0, "")
    monkeypatch.setattr(control, "run_control", lambda folder, show: [check])
    printed = run_cli("control", "--out", tmp_path, code=code)
    assert ("FAIL" in printed) == bool(code)


@pytest.mark.slow
def test_control_trains_all_models_and_fails_if_they_are_undertrained(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "can_draw", lambda: False)
    monkeypatch.setattr(control.run_control, "__defaults__", (TINY,))
    printed = run_cli("control", "--out", tmp_path, code=1)
    assert printed.count("FAIL") >= 2
    # In only four steps, a model without context cannot have twice the regret of the source algorithm.
    assert "FAIL  bandits    AD, context cut off" in printed
    parts = {path.name for path in tmp_path.iterdir() if path.is_dir()}
    assert parts == {"dpt_on_bandits", "ad_on_bandits", "ad_in_dark_room"}
