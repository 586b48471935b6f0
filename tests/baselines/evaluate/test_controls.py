"""Test the memory control, the partner control and the protocol `swap` with an ego that uses its memory."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import NamedEgo, stay
from icrl4aht_baselines.agents.host import from_host
from icrl4aht_baselines.evaluate import ControlledResults, evaluate_controls
from icrl4aht_baselines.evaluate.evaluator import evaluate, play_tasks
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, get_protocol, plan_tasks, segment_lengths
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, ProgramCache, task_key
from icrl4aht_baselines.report.results import read_run
from icrl4aht_baselines.report.scores import control_lines
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_task, published_tasks
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_data.benchmark.tasks import make_task, write_tasks
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.actions import STAY
from tests.helpers.commands import run_cli
from tests.helpers.host_agents import HostRecorder

H1, H2, H4 = (published_task("coord_simple", f"{family}/t0") for family in ("H1", "H2", "H4"))
TASKS = [H1, H4]
"""Two tasks: H1 never delivers and H4 delivers without help, so the ego `stay` earns 0 and 40 in an episode."""
FOUR = dataclasses.replace(PROTOCOLS["seeded"], episodes=4)
STAYS, RANDOM, PAID = 0, 1, 2


class EgoMemory(NamedTuple):
    """Memory of the ego: finished episodes, reward in the first episode, and whether the ego acts randomly now."""

    episodes: jax.Array
    paid: jax.Array
    wanders: jax.Array


def _begin(mode, key):
    return EgoMemory(jnp.int32(0), jnp.float32(0), mode == RANDOM)


def _act(mode, memory, ego_input, key):
    paid = memory.paid + jnp.where(memory.episodes == 0, ego_input.prev_reward, 0)
    wanders = jnp.where(ego_input.prev_done & (mode == PAID), paid <= 0, memory.wanders)
    memory = EgoMemory(memory.episodes + ego_input.prev_done, paid, wanders)
    return jnp.where(wanders, jax.random.randint(key, (), 0, 6), STAY), memory


def ego(mode):
    """Return an ego that stays, acts randomly, or acts randomly only after a first episode without reward."""
    policy = Policy(jnp.int32(mode), _begin, _act, "ego_input")
    return lambda layout: policy


@pytest.fixture(scope="module")
def compiled_programs():
    """Return a cache of compiled programs that all tests of this module share."""
    return ProgramCache()


@pytest.fixture(scope="module")
def solo_returns(compiled_programs):
    """Play with an ego that stays and with a random one; give the returns of each, of shape (tasks, episodes)."""

    def play(mode):
        results = evaluate("fixed", ego(mode), TASKS, FOUR, programs=compiled_programs)
        return np.array([result.returns[0] for result in results])

    return play(STAYS), play(RANDOM)


def test_memory_and_partner_controls_equal_hand_computed_differences(solo_returns, compiled_programs, tmp_path):
    stays, wanders = solo_returns
    assert stays.tolist() == [[0] * 4, [40] * 4]
    assert (wanders < stays)[:, 1:].any(axis=1).all()
    found = evaluate_controls("mine", ego(PAID), TASKS, FOUR, out=tmp_path, programs=compiled_programs)
    assert len(compiled_programs) == 2  # evaluation compiles one program for each teammate family
    plain = np.array([[stays[0, 0], *wanders[0, 1:]], stays[1]])
    np.testing.assert_array_equal([result.returns[0] for result in found.plain], plain)
    np.testing.assert_array_equal([result.returns[0] for result in found.cleared], stays)
    # In task 0, the ego earns reward with the teammate of task 1, and then never moves with its own teammate.
    # Task 1: the teammate of task 0 plays first, the ego earns nothing, and acts randomly when its own teammate plays.
    swapped = np.array([result.returns[0] for result in found.swapped])
    np.testing.assert_array_equal(swapped[:, 2:], [stays[0, 2:], wanders[1, 2:]])
    np.testing.assert_array_equal(found.memory[:, 0], (plain - stays).mean(axis=1))
    np.testing.assert_array_equal(found.partner[:, 0], (plain - swapped)[:, 2:].mean(axis=1))
    assert found.memory[0, 0] < 0 and found.memory[1, 0] == 0
    assert found.partner[0, 0] < 0 < found.partner[1, 0]
    memory, partner = control_lines(found, TASKS)
    assert f"track teammate, benefit M of memory: {found.memory.mean():+.1f}, " in memory
    assert (
        f"track teammate, benefit P of the right context: {found.partner.mean():+.1f}, the return in the 2 last"
        in partner
    )


def test_control_intervals_treat_equal_behaviours_as_one_unit():
    """With one seed, five teammates of H4 that behave the same have no interval; different teammates of H3 do."""
    tasks = [task for task in published_tasks("teammate") if task.layout.name == "coord_simple"]
    values = np.arange(4.0)
    for family in ("H4", "H3"):
        own = [task for task in tasks if task.teammate_family == family]
        plain, zero = (
            [Result(task.task_id, {}, [(value + scale * number).tolist()]) for number, task in enumerate(own)]
            for value, scale in ((values, 1.0), (values, 0.0))
        )
        memory, _ = control_lines(ControlledResults(plain, zero, zero, 2), own)
        assert memory.startswith("track teammate, benefit M of memory: +2.0") and ("(" in memory) == (family == "H3")


def test_controls_do_not_change_returns_of_ego_without_memory(solo_returns, compiled_programs):
    """The random keys of the last episodes do not depend on the teammates of earlier episodes."""
    found = evaluate_controls("random", ego(RANDOM), TASKS, FOUR, programs=compiled_programs)
    np.testing.assert_array_equal([result.returns[0] for result in found.plain], solo_returns[1])
    assert not found.memory.any() and not found.partner.any()
    first, swapped = ([result.returns[0][:2] for result in results] for results in (found.plain, found.swapped))
    assert first != swapped


def test_protocol_swap_keeps_ego_memory_and_random_keys(solo_returns, compiled_programs):
    rules = dataclasses.replace(PROTOCOLS["swap"], episodes=4, swap_every=2)
    first, second = evaluate("mine", ego(PAID), TASKS, rules, programs=compiled_programs)
    stays, wanders = solo_returns
    assert first.returns[0][:2] == [stays[0, 0], wanders[0, 1]]
    assert second.returns[0] == [40, 40, 0, 0]  # a reward in the first episode makes the ego stay
    other = dataclasses.replace(H1, teammate=H4.teammate)
    (expected,) = evaluate("fixed", ego(RANDOM), [other], FOUR, programs=compiled_programs)
    assert first.returns[0][2:] == expected.returns[0][2:]
    assert (first.partners, second.partners) == ([H1.task_id, H4.task_id], [H4.task_id, H1.task_id])


def test_stored_control_results_are_reused_only_for_same_partners(compiled_programs, tmp_path):
    """An evaluation with a control resumes only with the same partners; results without a control store no partners."""
    first = evaluate_controls(
        "mine", ego(PAID), TASKS, FOUR, out=tmp_path, details={"of": 1}, programs=compiled_programs
    )

    def forbidden_ego(layout):
        raise AssertionError("finished tasks are evaluated again")

    assert evaluate_controls("mine", forbidden_ego, TASKS, FOUR, out=tmp_path, details={"of": 1}) == first
    plain, cleared, swapped = (results[0].settings for results in first[:3])
    rules = {"name": "seeded", "noise": "seeded", "four_recipes": False, "episodes": 4, "steps": 100}
    assert plain["protocol"] == rules
    assert (plain["agent"], plain["details"]) == ("mine", {"of": 1})
    assert (cleared["agent"], cleared["details"]) == ("mine (cleared)", {"of": 1, "forget": True})
    assert (swapped["agent"], swapped["details"]) == ("mine (swapped)", {"of": 1, "swapped": True})
    assert "partners" not in first.plain[0].to_json()
    message = f"holds a result with the teammates of {H1.task_id}, {H4.task_id}, expected those of {H2.task_id}, "
    with pytest.raises(OptionError, match=message):
        evaluate(
            "mine", forbidden_ego, [H4, H2, H1], FOUR, control="swapped", out=tmp_path / "swapped", details={"of": 1}
        )


@pytest.mark.slow
def test_memory_control_resets_host_agents_before_each_episode(tmp_path):
    agent, short = HostRecorder(), dataclasses.replace(FOUR, steps=5)
    evaluate_controls("host", from_host(agent), TASKS, short)
    log = [inputs[::5] for inputs in agent.seen]  # one log per reset of the agent, with the first step of each episode
    # Each of the two families has one reset without a control, four with memory cleared, one with swapped teammates.
    assert [len(episodes) for episodes in log] == [4, 4] + [1] * 8 + [4, 4]
    plain, cleared, swapped = log[0], [episodes[0] for episodes in log[2:6]], log[10]
    assert [bool(one.prev_done) for one in plain] == [False, True, True, True]
    assert not any(one.prev_done or one.prev_action for one in cleared)
    assert [bool(one.prev_done) for one in swapped] == [False, True, True, True]
    for one, other, third in zip(plain, cleared, swapped, strict=True):  # all evaluations have equal start states
        np.testing.assert_array_equal(one.obs, other.obs)
        np.testing.assert_array_equal(one.obs, third.obs)


class TestPlanTasks:
    def test_swap_partner_is_from_the_next_teammate_family(self):
        tasks = [task for task in published_tasks("teammate") if task.layout.name in ("coord_simple", "demo_wide")]
        by_id = {task.task_id: task for task in tasks}
        after = {"H1": "H2", "H2": "H3", "H3": "H4", "H4": "H1"}
        for task, played, partners in plan_tasks(tasks, PROTOCOLS["seeded"], "swapped"):
            partner = by_id[partners[0]]
            assert (partner.layout, partner.teammate_family) == (task.layout, after[task.teammate_family])
            assert partner.teammate["theta_id"] == task.teammate["theta_id"]
            assert [one.teammate for one in played] == [partner.teammate, task.teammate]
            assert {one.task_id for one in played} == {task.task_id}
        families = [by_id[partner].teammate_family for partner in plan_tasks(tasks, PROTOCOLS["swap"])[0].partners]
        assert families == ["H1", "H2", "H3", "H4"]

    def test_swap_partner_within_one_family_is_another_teammate(self):
        first, second = (published_task("coord_simple", f"H4/t{number}") for number in range(2))
        again = dataclasses.replace(first, task_id="again")
        partners = {task.task_id: ids[0] for task, _, ids in plan_tasks([first, again, second], FOUR, "swapped")}
        assert partners == {first.task_id: second.task_id, "again": second.task_id, second.task_id: first.task_id}

    def test_swap_partner_has_another_recipe(self):
        dishes = [[(0, 0, 0)], [(0, 0, 0)], [(1, 1, 1)]]
        tasks = [
            make_task("teammate", "test", "coord_simple", one.teammate, 0, dish)
            for one, dish in zip((H4, H1, H2), dishes, strict=True)
        ]
        plan = plan_tasks(tasks, FOUR, "swapped")[0]
        assert plan.partners[0] == tasks[2].task_id
        assert [one.recipes for one in plan.played] == [((1, 1, 1),), ((0, 0, 0),)]

    def test_segment_lengths_add_up_to_episodes_of_the_protocol(self):
        assert segment_lengths(PROTOCOLS["seeded"]) == (100,)
        assert segment_lengths(PROTOCOLS["swap"]) == (25, 25, 25, 25)
        assert segment_lengths(get_protocol("swap", 30)) == (25, 5)
        assert segment_lengths(PROTOCOLS["seeded"], "swapped") == (80, 20)
        assert segment_lengths(get_protocol("seeded", 39), "swapped") == (20, 19)
        assert segment_lengths(get_protocol("seeded", 3), "swapped") == (2, 1)

    def test_task_without_swap_partner_raises_error_with_its_id(self):
        message = rf"task {H1.task_id}: expected another task on coord_simple with another teammate to swap with, found"
        with pytest.raises(OptionError, match=message):
            plan_tasks([H1, published_task("demo_wide", "H2/t0")], FOUR, "swapped")
        with pytest.raises(OptionError, match=message):
            evaluate("stay", stay, [H1], "swap")
        assert plan_tasks([H1], get_protocol("swap", 25))[0].partners == ()

    def test_controls_reject_unsuitable_protocols_and_unknown_names(self):
        for rules in (PROTOCOLS["swap"], get_protocol("seeded", 1)):
            with pytest.raises(OptionError, match=f"protocol {rules.name} and episodes = {rules.episodes}: expected"):
                evaluate_controls("stay", stay, TASKS, rules)
        with pytest.raises(UnknownNameError, match=r"unknown control 'swaped'.*Did you mean 'swapped'"):
            evaluate("stay", stay, TASKS, FOUR, control="swaped")  # type: ignore[arg-type]
        with pytest.raises(OptionError, match=r"protocol swap: expected at most 25 episodes.* found 100"):
            next(play_tasks(stay, [H4], PROTOCOLS["swap"]))


def test_next_segment_starts_with_its_own_recipes():
    """`move_to_layouts` replaces the recipe of the previous segment in the first state of the next segment."""
    first, second = (
        [make_task("teammate", "test", "coord_simple", H4.teammate, seed, [dish]) for seed in range(2)]
        for dish in ((0, 0, 0), (1, 1, 1))
    )
    keys = jnp.stack([task_key(0, task.task_id) for task in first])

    def rollout(layouts, numbers):
        return EvaluationRollout(layouts, stay(H4.layout), [build_teammate(None, H4.teammate)], FOUR, numbers)

    one, other = rollout(first[0].layout, None), rollout([second[0].layout, first[0].layout], np.array([0, 1]))
    before, expected = jax.jit(one.start)(keys), jax.jit(other.start)(keys)
    state = jax.jit(other.move_to_layouts)(before)
    np.testing.assert_array_equal(state.env.record, expected.env.record)
    np.testing.assert_array_equal(state.env.layout, [0, 1])
    assert not np.array_equal(state.env.record[0], before.env.record[0])


@pytest.mark.slow
def test_evaluate_command_with_controls_writes_all_results(compiled_programs, tmp_path, monkeypatch):
    monkeypatch.setattr("icrl4aht_baselines.agents.egos.find_agent", lambda name, **mode: NamedEgo(name, ego(PAID)))
    monkeypatch.setattr("icrl4aht_baselines.evaluate.evaluator.ProgramCache", lambda: compiled_programs)
    write_tasks(tmp_path / "two.jsonl", TASKS)

    def run_evaluate(folder, *options, code=0):
        command = ["evaluate", "--agent", "mine", "--manifest", tmp_path / "two.jsonl", *options]
        return run_cli(*command, "--out", tmp_path / folder, code=code)

    printed = run_evaluate("run", "--episodes", "4", "--controls")
    assert (
        "track teammate, benefit M of memory: " in printed
        and "track teammate, benefit P of the right context: " in printed
    )
    for folder in ("run", "run/cleared", "run/swapped"):
        assert len(list((tmp_path / folder / "tasks").glob("*.json"))) == 2
    assert "--controls: cannot be used with --forget" in run_evaluate("run", "--controls", "--forget", code=2)
    run_evaluate("cleared", "--episodes", "4", "--forget")
    assert read_run(tmp_path / "cleared").table.equals(read_run(tmp_path / "run/cleared").table)
