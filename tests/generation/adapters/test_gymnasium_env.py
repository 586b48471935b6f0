"""Test the Gymnasium environment of a task: Gymnasium's checker, registered ids, and replays of histories."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from icrl4aht_generation.adapters.draws import recorded_draws
from icrl4aht_generation.adapters.gymnasium_env import TaskEnv, published_environment
from icrl4aht_generation.teammates.instances import published_task, published_tasks

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.environments import TASK_ENVIRONMENT
from icrl4aht_data.errors import NotStoredError, OptionError, TaskFormatError, UnknownNameError
from icrl4aht_data.overcooked.state import record_size
from tests.helpers.commands import run_python

NAME = "icrl4aht/demo_wide-H4-t0-v0"


@pytest.fixture(scope="module")
def env():
    return gymnasium.make(NAME)


# Gymnasium takes observations of 5x5 cells for images and warns that they should be resized.
@pytest.mark.filterwarnings("ignore:.*resize")
def test_environment_passes_the_checker_of_gymnasium():
    check_env(gymnasium.make(NAME, render_mode="rgb_array").unwrapped)


def test_every_published_test_task_has_an_environment_id():
    ids = {name for name in gymnasium.registry if name.startswith("icrl4aht/")} - {TASK_ENVIRONMENT}
    tasks = {task.task_id for track in ("teammate", "layout") for task in published_tasks(track)}
    arguments = [gymnasium.spec(name).kwargs for name in ids]
    assert {published_task(**these).task_id for these in arguments} == tasks
    assert len(ids) == len(tasks) == 160


def test_module_prefix_of_an_environment_id_imports_the_package():
    """In a new process, no id is registered until the prefix imports the package."""
    code = f"import gymnasium; print(gymnasium.make('icrl4aht_data:{NAME}').spec.id)"
    assert run_python("-c", code).strip() == NAME


def test_episodes_depend_only_on_seed_and_actions(env):
    def play(seed: int) -> list[np.ndarray]:
        _, info = env.reset(seed=seed)
        seen = [info["state"]]
        steps = [env.step(action) for action in np.random.default_rng(0).integers(0, 6, 100)]
        assert [truncated for *_, truncated, _ in steps] == [False] * 99 + [True]
        seen += [info["state"] for *_, info in steps]
        return seen

    first = play(1)
    np.testing.assert_array_equal(first, play(1))
    assert not np.array_equal(first, play(2))
    # A reset without a seed starts another episode.
    assert not np.array_equal(first[0], env.reset()[1]["state"])


def first_history(**filters) -> tuple:
    dataset = load_icrl4aht(obs="uint8", **filters)
    return dataset, dataset[0]


def replay(env, history, episode: int, options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Replay a recorded episode with the ego's recorded actions; return the observations and the last state."""
    own = slice(100 * episode, 100 * episode + 100)
    observation, info = env.reset(options=options)
    observations, rewards, terminated, truncated, infos = zip(*map(env.step, history.actions[own]), strict=True)
    assert not any(terminated + truncated)
    states = [info["state"], *(one["state"] for one in infos)]
    np.testing.assert_array_equal(states[:-1], history.state[own])
    np.testing.assert_array_equal(rewards, history.rewards[own])
    np.testing.assert_array_equal([one["teammate_action"] for one in infos], history.teammate_actions[own])
    return np.array([observation, *observations[:-1]]), states[-1]


@pytest.mark.parametrize(
    "filters",
    [
        {"layout": "demo_wide", "source": "noise"},
        {"layout": "demo_wide", "teammate_family": "rl"},
    ],
    ids=str,
)
def test_recorded_actions_reproduce_the_recorded_history(filters):
    dataset, history = first_history(**filters)
    recovered = dataset.recover_environment(history.entry.history_id)
    assert recovered.spec.max_episode_steps == 400
    returns = history.returns()
    for episode in {0, int(returns.argmax()), len(returns) - 1}:
        options = dataset.reset_options(history.entry.history_id, episode)
        observations, last = replay(recovered, history, episode, options)
        np.testing.assert_array_equal(observations, history.obs[100 * episode : 100 * episode + 100])
        np.testing.assert_array_equal(last, history.episode_end_state[episode])
    assert returns.max() > 0


@pytest.mark.parametrize("source", ["ppo", pytest.param("noise", marks=pytest.mark.slow)])
def test_recovered_keys_reproduce_actions_of_heuristic_teammates(source):
    """With the random keys of a recorded episode, the teammate's policy takes the recorded actions."""
    dataset, history = first_history(layout="demo_wide", source=source, teammate_family=["H1", "H2", "H3", "H4"])
    recovered = dataset.recover_environment(history.entry.history_id)
    for episode in (0, int(history.returns().argmax())):
        replay(recovered, history, episode, recorded_draws(dataset, history.entry.history_id, episode))


def test_teammate_policy_acts_after_the_given_actions_end():
    dataset, history = first_history(layout="demo_wide", source="noise")
    recovered = dataset.recover_environment(history.entry.history_id)
    number = history.entry.history_id
    scripted = {name: array[:50] for name, array in dataset.reset_options(number).items() if name != "state"}
    recovered.reset(options=recorded_draws(dataset, number) | scripted | {"teammate_actions": np.full(50, 4)})
    teammate = [recovered.step(action)[-1]["teammate_action"] for action in history.actions[:100]]
    assert teammate[:50] == [4] * 50
    assert set(teammate[50:]) - {4}


def test_random_keys_of_histories_without_known_code_version_cannot_be_recovered(lite):
    dataset = load_icrl4aht(lite[0])
    with pytest.raises(NotStoredError, match=r"use dataset\.reset_options"):
        recorded_draws(dataset, 0)


def test_recovered_environments_accept_length_and_render_mode():
    dataset, history = first_history(layout="demo_wide", source="noise", channels="canonical")
    recovered = dataset.recover_environment(history.entry.history_id, max_episode_steps=3, render_mode="rgb_array")
    assert recovered.observation_space.shape == (5, 5, 46)
    np.testing.assert_array_equal(recovered.reset(options={"state": history.state[0]})[0], history.obs[0])
    assert [recovered.step(4)[3] for _ in range(3)] == [False, False, True]
    assert recovered.render().ndim == 3


def test_recovering_environment_of_release_without_tasks_raises_error(converted_release):
    with pytest.raises(NotStoredError, match=r"convert again with tasks\.jsonl"):
        load_icrl4aht(converted_release).recover_environment(0)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"stat": 0}, UnknownNameError, "Did you mean 'state'"),
        ({"state": np.zeros(3, np.uint8)}, OptionError, r"state: expected integers in 0\.\.255 of shape \(\d+,\)"),
        ({"state": "zeros"}, OptionError, "state: expected a state record of demo_wide, found a position that is not"),
        ({"teammate_actions": [0, 6]}, OptionError, r"teammate_actions: expected integers in 0\.\.5 .* values 0\.\.6"),
        ({"recipes": [1]}, OptionError, "recipes: expected items of demo_wide's recipes"),
    ],
    ids=str,
)
def test_invalid_reset_options_raise_errors(env, options, error, message):
    if isinstance(options.get("state"), str):
        options = {"state": np.zeros(record_size(env.unwrapped.layout), np.uint8)}
    with pytest.raises(error, match=message):
        env.reset(options=options)


def test_wrong_use_of_task_environment_raises_errors():
    fresh = published_environment("demo_wide", "H4/t0")
    with pytest.raises(OptionError, match="call reset"):
        fresh.step(0)
    fresh.reset(seed=0)
    with pytest.raises(OptionError, match=r"action: expected 0\.\.5 \(up, down, .*\), found 6"):
        fresh.step(6)
    task = asdict(published_task("demo_wide", "H4/t0"))
    with pytest.raises(TaskFormatError, match="expected the fields"):
        TaskEnv({name: value for name, value in task.items() if name != "seed"})
    for wrong_task in ("foo", published_task("demo_wide", "H4/t0")):
        with pytest.raises(TaskFormatError, match=r"task = .*: expected the fields of a task by name"):
            gymnasium.make("icrl4aht/task-v0", task=wrong_task)
    assert repr(fresh) == f"TaskEnv(demo_wide, task {task['task_id']})"
    wrong_options: list[dict[str, Any]] = [{"noise": "loud"}, {"channels": "all"}, {"render_mode": "human"}]
    for wrong in wrong_options:
        with pytest.raises(UnknownNameError, match=f"unknown {next(iter(wrong))}"):
            TaskEnv(task, **wrong)
    with pytest.raises(UnknownNameError, match="unknown teammate 'H9/t0'"):
        published_environment("demo_wide", "H9/t0")
