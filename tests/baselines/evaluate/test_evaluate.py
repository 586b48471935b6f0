"""The evaluator: purity, what egos are given, results on disk, clear errors."""

from __future__ import annotations

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from baselines.agents.egos import get_agent, random, stay
from baselines.agents.host import Percept, from_host
from baselines.commands.cli import cli
from baselines.evaluate.evaluator import evaluate, play_tasks
from baselines.evaluate.protocols import PROTOCOLS, get_protocol
from baselines.evaluate.results import read_result
from baselines.report.headroom import write_headroom_cards
from baselines.report.results import EvaluationRun, as_run, normalized_return, read_run
from baselines.report.summary import bootstrap_interval, csv_text, markdown
from generation.policy import Policy
from generation.teammates.instances import published_tasks
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import read_headroom
from icrl4aht_data.errors import OptionError, TaskFormatError, UnknownNameError
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.rules import step

PUBLISHED = dataclasses.replace(PROTOCOLS["published"], episodes=4)
ALL = [task for track in TRACKS for task in published_tasks(track)]
H4 = [task for task in ALL if task.teammate_family == "H4"]
SIMPLE, RING = ([task for task in H4 if task.layout.name == name] for name in ("coord_simple", "coord_ring"))


def returns(results):
    return {result.task_id: result.returns for result in results}


@pytest.fixture(scope="module")
def together():
    """Ten tasks at once."""
    return returns(evaluate("random", random, SIMPLE + RING, PUBLISHED))


def test_a_task_is_the_same_alone_and_among_others(together):
    alone = returns(evaluate("random", random, [RING[3]], PUBLISHED))
    assert alone[RING[3].task_id] == together[RING[3].task_id]
    reordered = returns(evaluate("random", random, [RING[1], SIMPLE[2], RING[0]], PUBLISHED))
    for task_id, values in reordered.items():
        assert values == together[task_id]


def test_an_interrupted_run_goes_on_to_the_same_results(together, tmp_path):
    first = evaluate("random", random, SIMPLE, PUBLISHED, out=tmp_path)
    started = []

    def watched(layout):
        started.append(layout.name)
        return random(layout)

    assert returns(evaluate("random", watched, SIMPLE + RING, PUBLISHED, out=tmp_path)) == together
    assert started == ["coord_ring"]
    assert len(list((tmp_path / "tasks").iterdir())) == 10
    assert read_result(tmp_path / "tasks" / f"{SIMPLE[0].task_id}.json") == first[0]


def test_seeds_and_tasks_differ(together):
    other = returns(evaluate("random", random, SIMPLE, PUBLISHED, seeds=[1]))
    assert other != {task.task_id: together[task.task_id] for task in SIMPLE}
    assert len({tuple(together[task.task_id][0]) for task in SIMPLE}) > 1


def test_several_seeds_play_at_once(together):
    both = returns(evaluate("random", random, SIMPLE, PUBLISHED, seeds=[0, 1]))
    other = returns(evaluate("random", random, SIMPLE[1:2], PUBLISHED, seeds=[1]))
    for task in SIMPLE:
        assert both[task.task_id][0] == together[task.task_id][0]
    assert both[SIMPLE[1].task_id][1:] == other[SIMPLE[1].task_id]


def test_results_of_other_settings_are_never_reused(tmp_path):
    evaluate("stay", stay, SIMPLE[:1], PUBLISHED, out=tmp_path)
    with pytest.raises(OptionError, match="holds a result of other settings"):
        evaluate("stay", stay, SIMPLE[:1], PUBLISHED, seeds=[1], out=tmp_path)
    with pytest.raises(OptionError, match="holds a result of other settings"):
        evaluate("random", random, SIMPLE[:1], PUBLISHED, out=tmp_path)


def test_damaged_results_are_named(tmp_path):
    evaluate("stay", stay, SIMPLE[:1], PUBLISHED, out=tmp_path)
    (path,) = (tmp_path / "tasks").iterdir()
    content = json.loads(path.read_text())
    content["settings"]["seeds"] = [5]
    path.write_text(json.dumps(content))
    with pytest.raises(OptionError, match="do not match their hash"):
        read_run(tmp_path)
    path.write_text("{")
    with pytest.raises(OptionError, match="not a result"):
        read_run(tmp_path)


def test_a_motionless_ego_gets_exactly_the_published_40_beside_h4():
    for result in evaluate("stay", stay, SIMPLE, PUBLISHED):
        assert result.returns == [[40.0] * 4]


class Watcher:
    """A host agent that plays fixed actions and keeps what it was given."""

    def __init__(self, actions=None):
        self.actions = actions
        self.seen: list[Percept] = []

    def reset(self, batch):
        self.batch, self.rng, self.played = batch, np.random.default_rng(0), []

    def act(self, percept):
        self.seen.append(percept)
        chosen = self.rng.integers(0, 6, self.batch) if self.actions is None else self.actions(self.batch)
        self.played.append(chosen)
        return chosen


def test_host_agents_are_given_what_happened():
    watcher = Watcher()
    protocol = dataclasses.replace(PUBLISHED, episodes=2)
    played = list(play_tasks(from_host(watcher), SIMPLE[:3], protocol))
    record, actions, reward = (np.concatenate([np.asarray(p[k]) for p in played], axis=1) for k in range(3))
    assert len(watcher.seen) == 200
    layout = LAYOUTS["coord_simple"]
    for t, percept in enumerate(watcher.seen):
        np.testing.assert_array_equal(percept.obs, observe(layout, record[:, t], 0))
        np.testing.assert_array_equal(watcher.played[t], actions[:, t, 0])
        if t:
            np.testing.assert_array_equal(percept.prev_action, actions[:, t - 1, 0])
            np.testing.assert_array_equal(percept.prev_teammate_action, actions[:, t - 1, 1])
            np.testing.assert_array_equal(percept.prev_reward, reward[:, t - 1])
        assert percept.prev_done.tolist() == [t == 100] * 3
    assert not watcher.seen[0].prev_action.any()
    assert not watcher.seen[0].prev_reward.any()


def test_recorded_play_follows_the_rules():
    protocol = dataclasses.replace(PUBLISHED, episodes=1)
    (played,) = play_tasks(random, RING[:2], protocol, [3])
    record, actions = np.asarray(played.record), np.asarray(played.actions)
    layout = LAYOUTS["coord_ring"]
    outcome = step(layout, record[:, :-1], actions[:, :-1], record[:, 1:, 6])
    np.testing.assert_array_equal(outcome.state, record[:, 1:])
    np.testing.assert_array_equal(outcome.reward, played.reward[:, :-1])


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (lambda batch: np.full(batch, 6), r"returned actions 6\.\.6 on coord_simple, expected 0\.\.5"),
        (lambda batch: np.full(batch, -1), r"returned actions -1\.\.-1"),
        (lambda batch: np.zeros((batch, 1), int), r"returned int64 of shape \(1, 1\), expected integers \(1,\)"),
        (lambda batch: np.zeros(batch), r"returned float64 of shape \(1,\), expected integers \(1,\)"),
    ],
)
def test_host_agents_that_return_nonsense(actions, message):
    with pytest.raises(OptionError, match=message):
        evaluate("mine", from_host(Watcher(actions)), SIMPLE[:1], dataclasses.replace(PUBLISHED, episodes=1))


@pytest.mark.parametrize("action", [jnp.zeros(3, jnp.int32), jnp.float32(1)])
def test_jax_agents_that_return_nonsense(action):
    def mine(layout):
        return Policy((), lambda params, key: (), lambda params, carry, view, key: (action, carry), "observation")

    with pytest.raises(OptionError, match=r"expected one integer 0\.\.5 for each"):
        evaluate("mine", mine, SIMPLE[:1], PUBLISHED)


def test_memory_lives_through_the_task():
    """An ego that counts its steps: the count goes on over episodes and starts anew with each task."""

    def mine(layout):
        def act(params, count, view, key):
            return jnp.where(count < 100, 4, 5), count + 1  # stays in the first episode, interacts in the second

        return Policy((), lambda params, key: jnp.int32(0), act, "observation")

    protocol = dataclasses.replace(PUBLISHED, episodes=2)
    first, second = play_tasks(mine, SIMPLE[:2], protocol)
    assert (first.actions[..., 0] == 4).all()
    assert (second.actions[..., 0] == 5).all()


def test_impossible_teammates_are_found_before_any_work(tmp_path):
    wrong = dataclasses.replace(
        SIMPLE[1], teammate=SIMPLE[1].teammate | {"theta": SIMPLE[1].teammate["theta"] | {"inertia": 2.0}}
    )
    with pytest.raises(TaskFormatError, match=r"task .*_t1_.*inertia = 2.0 \(expected a number in 0..1\)"):
        evaluate("stay", stay, [SIMPLE[0], wrong], PUBLISHED, out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_unknown_names():
    with pytest.raises(UnknownNameError, match=r"unknown agent 'rnadom'; valid: .*Did you mean 'random'\?"):
        get_agent("rnadom")
    with pytest.raises(UnknownNameError, match=r"unknown protocol 'publish'; valid: published, seeded"):
        get_protocol("publish")


def test_bootstrap_interval_covers_the_mean():
    means = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    low, high = bootstrap_interval(means, np.random.default_rng(0))
    assert 1.0 <= low < 4.0 < high <= 10.0
    assert bootstrap_interval(np.full(5, 7.0), np.random.default_rng(0)) == (7.0, 7.0)


def test_report_shows_the_published_numbers_beside(together):
    run = as_run(evaluate("random", random, SIMPLE, PUBLISHED))
    text = markdown([run])
    assert "published 35.2 ± 0.4" in text
    assert "<br>no headroom |" in text
    mean = np.mean([together[task.task_id] for task in SIMPLE])
    assert f"| H4 | {mean:.1f} ± " in text
    lines = csv_text([run]).splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("random,published,coord_simple,H4,5,4,")


def test_commands(tmp_path):
    from icrl4aht_data.benchmark.tasks import write_tasks

    write_tasks(tmp_path / "two.jsonl", SIMPLE[:1])
    options = ["--protocol", "published", "--manifest", str(tmp_path / "two.jsonl"), "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(cli, ["evaluate", "--agent", "stay", *options])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(cli, ["report", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    assert "40.0 ± 0.0" in result.output
    assert {path.name for path in (tmp_path / "run" / "report").iterdir()} == {"report.md", "report.csv", "curves.png"}
    (tmp_path / "two.jsonl").write_text("{}\n")
    result = CliRunner().invoke(cli, ["evaluate", "--agent", "stay", *options])
    assert "line 1" in str(result.exception)


def test_headroom_cards_name_the_cells_that_leave_nothing_to_do(tmp_path):
    def run(agent, values):
        returns = {cell: np.full((5, 2), value) for cell, value in values.items()}
        return EvaluationRun(agent, "seeded", returns)

    flat, open_ = ("coord_simple", "H4"), ("demo_wide", "H1")
    runs = [run("stay", {flat: 40.0, open_: 0.0}), run("random", {flat: 35.0, open_: 0.0})]
    write_headroom_cards([*runs, run("oracle", {flat: 40.5, open_: 39.9})], tmp_path)
    content = json.loads((tmp_path / "headroom.json").read_text())
    assert content["seeded"]["demo_wide"]["H1"] == {"stay": 0.0, "random": 0.0, "oracle": 39.9}
    text = (tmp_path / "headroom.md").read_text()
    assert "**0.0 / 0.0 / 39.9**" in text
    assert "No headroom: coord_simple/H4." in text


def test_normalised_scores_stand_only_where_there_is_headroom():
    table = {"stay": 10.0, "random": 5.0, "oracle": 30.0}
    assert normalized_return(20.0, table) == 0.5
    assert normalized_return(10.0, {**table, "oracle": 10.5}) is None
    assert normalized_return(10.0, None) is None


def test_headroom_cards_cover_every_cell():
    for protocol in PROTOCOLS:
        assert set(read_headroom(protocol)) == {(task.layout.name, task.teammate_family) for task in ALL}
