"""Test the evaluator: results depend only on the task, egos get the right inputs, and errors are clear."""

from __future__ import annotations

import dataclasses
import json
from contextlib import nullcontext
from unittest.mock import Mock, call

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import random, stay
from icrl4aht_baselines.agents.host import EgoInput, from_host
from icrl4aht_baselines.evaluate import evaluator
from icrl4aht_baselines.evaluate.evaluator import ProgramCache, evaluate, play_tasks
from icrl4aht_baselines.evaluate.protocols import (
    PROTOCOLS,
    bundled_tasks,
    get_protocol,
    hidden_recipe_note,
    limit_tasks,
)
from icrl4aht_baselines.evaluate.results import read_result
from icrl4aht_baselines.report.results import read_run
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_tasks

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import read_reference_returns
from icrl4aht_data.errors import OptionError, TaskFormatError, UnknownNameError
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.rules import step
from tests.helpers.host_agents import HostRecorder

PUBLISHED = dataclasses.replace(PROTOCOLS["published"], episodes=4)
ALL = [task for track in TRACKS for task in published_tasks(track)]
H4 = [task for task in ALL if task.teammate_family == "H4"]
SIMPLE, RING = ([task for task in H4 if task.layout.name == name] for name in ("coord_simple", "coord_ring"))


def returns_by_task(results):
    return {result.task_id: result.returns for result in results}


@pytest.fixture(scope="module")
def programs():
    """Return a cache of the programs that tests of this file compile."""
    return ProgramCache()


@pytest.fixture(scope="module")
def batch_returns(programs):
    """Return the returns of ten tasks that are evaluated in one batch."""
    return returns_by_task(evaluate("random", random, SIMPLE + RING, PUBLISHED, programs=programs))


def test_returns_of_a_task_do_not_depend_on_other_tasks_in_batch(batch_returns, programs):
    alone = returns_by_task(evaluate("random", random, [RING[3]], PUBLISHED))
    assert alone[RING[3].task_id] == batch_returns[RING[3].task_id]
    assert returns_by_task(evaluate("random", random, RING[::-1], PUBLISHED, programs=programs)) == {
        task.task_id: batch_returns[task.task_id] for task in RING
    }


def test_resumed_evaluation_skips_stored_tasks_and_gives_same_returns(batch_returns, programs, tmp_path, monkeypatch):
    first = evaluate("random", random, SIMPLE, PUBLISHED, out=tmp_path, programs=programs)
    started, played = [], []

    def log_and_make_ego(layout):
        started.append(layout.name)
        return random(layout)

    again = evaluate("random", log_and_make_ego, SIMPLE + RING, PUBLISHED, out=tmp_path, played=played.append)
    assert returns_by_task(again) == batch_returns
    shown = Mock()
    monkeypatch.setattr(evaluator, "progress_bars", lambda quiet, unit: nullcontext(None if quiet else shown))
    evaluate("random", random, SIMPLE, PUBLISHED, out=tmp_path)
    assert shown.call_args == call("random, published", 5 * 4, 5 * 4)  # a bar is shown unless `played` is given
    assert played == [5 * 4, 5, 5, 5, 5]  # stored tasks are reported in one call, other tasks after each episode
    assert started == ["coord_ring"]
    assert len(list((tmp_path / "tasks").iterdir())) == 10
    path = tmp_path / "tasks" / f"{SIMPLE[0].task_id}.json"
    assert read_result(path) == first[0]
    for agent, seeds in (("random", [1]), ("stay", [0])):
        with pytest.raises(OptionError, match="holds a result with other settings"):
            evaluate(agent, random, SIMPLE, PUBLISHED, seeds=seeds, out=tmp_path)
    content = json.loads(path.read_text())
    content["settings"]["seeds"] = [5]
    for text, message in ((json.dumps(content), "do not match their hash"), ("{", "not a result")):
        path.write_text(text)
        with pytest.raises(OptionError, match=message):
            read_run(tmp_path)


def test_seeds_and_tasks_give_different_returns(batch_returns):
    """Seeds that are evaluated in one batch do not affect each other."""
    both = returns_by_task(evaluate("random", random, SIMPLE, PUBLISHED, seeds=[7, 0]))
    assert all(both[task.task_id][1:] == batch_returns[task.task_id] for task in SIMPLE)
    assert any(both[task.task_id][0] != batch_returns[task.task_id][0] for task in SIMPLE)
    assert len({tuple(batch_returns[task.task_id][0]) for task in SIMPLE}) > 1


def test_output_folder_with_other_files_raises_error(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(OptionError, match=r"has other files \(notes.txt\), expected results of `evaluate`"):
        evaluate("stay", stay, SIMPLE, PUBLISHED, out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 3}, r"seeds = 3: expected a sequence of integers"),
        ({"seeds": ()}, r"seeds = \(\): expected a sequence of integers"),
        ({"seeds": (True,)}, "seeds = True: expected an integer"),
        ({"seeds": (1, 1)}, r"seeds = \[1, 1\]: expected different seeds"),
        ({"protocol": "sedeed"}, "unknown protocol 'sedeed'.*Did you mean 'seeded'"),
        ({"protocol": 5}, "unknown protocol 5"),
        ({"make_ego": 5}, "make_ego = 5: expected a function layout -> ego"),
        ({"tasks": ["demo_wide"]}, "tasks: 'demo_wide': expected tasks, such as those of test_tasks"),
    ],
)
def test_invalid_arguments_of_evaluate_raise_errors(arguments, message):
    with pytest.raises((OptionError, UnknownNameError), match=message):
        evaluate(**{"agent": "stay", "make_ego": stay, "tasks": SIMPLE, "protocol": "published"} | arguments)
    with pytest.raises(OptionError, match="agent = 5: expected an object with the methods reset and act"):
        from_host(5)  # type: ignore[arg-type]


def test_host_agents_receive_observations_and_rewards_that_follow_the_rules():
    rng = np.random.default_rng(0)
    watcher = HostRecorder(lambda batch: rng.integers(0, 6, batch))
    episodes = list(play_tasks(from_host(watcher), RING, dataclasses.replace(PUBLISHED, episodes=2)))
    record, actions, reward = (np.concatenate([np.asarray(p[k]) for p in episodes], axis=1) for k in range(3))
    (seen,), (played,) = watcher.seen, watcher.played
    assert len(seen) == 200
    assert all(part.flags.writeable for part in seen[0]), "torch.from_numpy takes them without a warning"
    layout = LAYOUTS["coord_ring"]
    for t, ego_input in enumerate(seen):
        np.testing.assert_array_equal(ego_input.obs, observe(layout, record[:, t], 0))
        np.testing.assert_array_equal(played[t], actions[:, t, 0])
        if t:
            np.testing.assert_array_equal(ego_input.prev_action, actions[:, t - 1, 0])
            np.testing.assert_array_equal(ego_input.prev_teammate_action, actions[:, t - 1, 1])
            np.testing.assert_array_equal(ego_input.prev_reward, reward[:, t - 1])
        assert ego_input.prev_done.tolist() == [t == 100] * 5
    assert not seen[0].prev_action.any() and not seen[0].prev_reward.any()
    for episode in np.split(np.arange(200), 2):
        before, after = episode[:-1], episode[1:]
        outcome = step(layout, record[:, before], actions[:, before], record[:, after, 6])
        np.testing.assert_array_equal(outcome.state, record[:, after])
        np.testing.assert_array_equal(outcome.reward, reward[:, before])


def test_out_of_range_action_of_host_agent_raises_error():
    make_ego = from_host(HostRecorder(lambda batch: np.full(batch, 6)))
    with pytest.raises(OptionError, match=r"returned actions 6\.\.6 on coord_simple, expected 0\.\.5"):
        evaluate("mine", make_ego, SIMPLE, dataclasses.replace(PUBLISHED, episodes=1))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((1, 1), int), r"returned int64 of shape \(1, 1\), expected integers of shape \(1,\)"),
        (np.zeros(1), r"returned float64 of shape \(1,\), expected integers of shape \(1,\)"),
    ],
)
def test_host_agent_actions_of_wrong_shape_or_type_raise_errors(actions, message):
    """The test calls the policy directly, because compiling the environment takes seconds."""
    policy, keys = from_host(HostRecorder(lambda batch: actions))(LAYOUTS["coord_simple"]), jnp.zeros(1, jnp.uint32)
    ego_input = EgoInput(jnp.zeros((1, 5, 5, 40)), *[jnp.zeros(1)] * 4)
    memory = policy.init((), keys)
    with pytest.raises(jax.errors.JaxRuntimeError, match=message):
        jax.block_until_ready(jax.jit(policy.act)((), memory, ego_input, keys))


@pytest.mark.parametrize("action", [jnp.zeros(3, jnp.int32), jnp.float32(1)])
def test_jax_agent_action_of_wrong_shape_or_type_raises_error(action):
    def make_ego(layout):
        return Policy((), lambda params, key: (), lambda params, carry, view, key: (action, carry), "observation")

    with pytest.raises(OptionError, match=r"expected one integer 0\.\.5 for each"):
        evaluate("mine", make_ego, SIMPLE, PUBLISHED)


def test_invalid_teammate_raises_error_before_evaluation_starts(tmp_path):
    wrong = dataclasses.replace(
        SIMPLE[1], teammate=SIMPLE[1].teammate | {"theta": SIMPLE[1].teammate["theta"] | {"inertia": 2.0}}
    )
    with pytest.raises(TaskFormatError, match=r"task .*_t1_.*expected `float` <= 1.0 - at `\$.inertia`"):
        evaluate("stay", stay, [SIMPLE[0], wrong], PUBLISHED, out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_tasks_per_family_and_episodes_can_be_limited():
    assert limit_tasks(SIMPLE + RING, 2) == SIMPLE[:2] + RING[:2]
    assert limit_tasks(SIMPLE, None) == SIMPLE
    assert get_protocol("seeded", 3) == dataclasses.replace(PROTOCOLS["seeded"], episodes=3)
    with pytest.raises(OptionError, match="episodes = 0: expected at least 1"):
        get_protocol("seeded", 0)


def test_hidden_recipe_note_lists_layouts_that_hide_the_recipe():
    simple, right = ([task for task in ALL if task.layout.name == name] for name in ("demo_simple", "asymm_right"))
    assert hidden_recipe_note(simple) == ""
    note = hidden_recipe_note([*simple, *right])
    assert " on asymm_right: " in note and "throughout" not in note
    preference = hidden_recipe_note(bundled_tasks("preference", "validation"))
    assert "asymm_both_plain, test_wide_plain, rooms-0-46" in preference and "throughout" in preference


def test_headroom_is_stored_for_every_layout_and_family_of_test_tasks():
    for protocol in ("published", "seeded"):
        assert set(read_reference_returns(protocol)) == {(task.layout.name, task.teammate_family) for task in ALL}
