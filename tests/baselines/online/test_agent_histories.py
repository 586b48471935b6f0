"""Test histories recorded from trained agents: labels, teammates, resumed collection and the release."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import AGENTS, NamedEgo, find_agent, stay
from icrl4aht_baselines.online import agent_histories
from icrl4aht_baselines.online.agent_histories import Teammates, collect_release, release_teammates
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.profiles.noise_config import NoiseConfig

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks, teammate_id
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.errors import LabelsMissingError, OptionError
from icrl4aht_data.format.provenance import ReferenceEgos
from icrl4aht_data.overcooked.actions import STAY
from icrl4aht_data.writing.combine import combine_releases
from tests.helpers.commands import run_cli
from tests.helpers.evaluated import TEST_TASKS

CONFIG = NoiseConfig(2, 10, start=(1.0, 1.0), end=(0.0, 0.0))


def always_interact(layout: Any) -> Policy:
    """Return an agent that always chooses `interact`."""
    return Policy((), lambda params, key: (), lambda params, memory, view, key: (jnp.int32(5), memory), "ego_input")


def idle_agent(layout: Any) -> Policy:
    return stay(layout)._replace(sees="ego_input")


COOK = NamedEgo("cook", always_interact, {"version": 1})


@pytest.fixture(scope="module")
def dataset() -> Any:
    """Return histories of the bundled release on one layout with heuristic teammates of one family."""
    return load_icrl4aht(layout="cramped_up").filter(teammate_family="H3")


@pytest.fixture(scope="module")
def teammates(dataset) -> Teammates:
    """Return the teammates of `dataset`; with the second teammate, the oracle has an invented, very low return."""
    found = release_teammates(dataset)
    useless = ReferenceEgos(stay=0.0, random=0.0, oracle=-1000.0, episodes=100)
    return found._replace(references={found.tasks[1].task_id: useless})


@pytest.fixture(scope="module")
def release(teammates, tmp_path_factory) -> Path:
    return collect_release(COOK, teammates, CONFIG, tmp_path_factory.mktemp("agent") / "release")


def test_collected_release_passes_deep_verification(release):
    report = verify_release(release, level="deep")
    assert report.ok, report.findings
    assert not list(release.parent.glob("*.parts"))


@pytest.mark.parametrize(("agent", "dishes"), [("oracle", 1), ("rl2-adapting", 2)])
def test_oracle_reads_the_dish_of_every_task(tmp_path, monkeypatch, agent, dishes):
    """The oracle takes its recipes from one layout, so each of its groups of tasks has one dish."""
    tasks = read_tasks(manifest_path("preference", "train"))
    two = [one for one in tasks if (one.layout.name, one.teammate_kind) == ("rooms-0-67", "territory")][:2]
    assert len({one.layout.recipes for one in two}) == 2

    def record_nothing(make: Any, group: list[Any], *options: Any) -> Any:
        assert len({one.layout.recipes for one in group}) == dishes
        raise StopIteration

    monkeypatch.setattr(agent_histories, "record_histories", record_nothing)
    with pytest.raises(StopIteration):
        collect_release(
            find_agent(agent), Teammates(two, {}, tmp_path, tmp_path / "from"), CONFIG, tmp_path / "release"
        )


def test_provenance_names_the_agent_and_tasks_without_oracle_labels(release, dataset, teammates):
    found = load_icrl4aht(release)
    made, given = release_teammates(found).tasks, release_teammates(dataset).tasks
    assert found.counts("source") == {"agent": 2 * len(given)}
    assert set(found.counts("split")) == {"train", "validation"}
    card = (release / "README.md").read_text(encoding="utf-8")
    assert "a trained agent plays" in card
    made_by = {made.expert.action for made in found.provenance.values() if made.expert}
    assert made_by == {"cook, before the noise"}
    assert found.counts("label_view") == {"ego": len(found)}
    without = found.column("task_id") == teammates.tasks[1].task_id
    assert (found.has_labels("oracle") == ~without).all() and without.sum() == 2
    with pytest.raises(LabelsMissingError, match=f"in 1 task .*of task {teammates.tasks[1].task_id}"):
        found.filter(split="train").ad(batch_size=1, length=10, labels="oracle")
    assert {task.teammate_key for task in made} == {task.teammate_key for task in given}
    assert not set(found.column("task_id")) & set(dataset.column("task_id"))


def test_noise_decreases_over_episodes_and_labels_have_no_noise(release):
    found = load_icrl4aht(release)
    for history in (found[0], found[len(found) - 1]):
        taken, labels = (np.asarray(values[:]).reshape(10, 100) for values in (history.actions, history.expert_actions))
        assert (labels == 5).all()
        share = (taken == labels).mean(axis=1)
        assert share[0] < 0.4 and (share[-1] == 1).all()
        assert np.corrcoef(share, np.arange(10))[0, 1] > 0.9
        oracle = np.asarray(history.oracle_actions[:])
        assert len(set(oracle.tolist())) > 3  # oracle labels differ from the constant action of the agent


@pytest.mark.slow
def test_histories_can_be_labelled_by_another_agent(dataset):
    """The labelling agent receives the inputs of the recorded agent, including the actions that were taken."""

    def count_stays(layout: Any) -> Policy:
        def act(params: Any, memory: Any, ego_input: Any, key: Any) -> tuple[Any, Any]:
            return jnp.int32((memory + 1) % 6), memory + (ego_input.prev_action == STAY)

        return Policy((), lambda params, key: jnp.int32(0), act, "ego_input")

    tasks = release_teammates(dataset).tasks[:1]
    config = NoiseConfig(1, 10, start=(0.0, 0.0))
    found = agent_histories.record_histories(idle_agent, tasks, config, make_labeller=count_stays)
    assert (found.actions == STAY).all()
    # The labelling agent counts previous `stay` actions; the first step has no previous action.
    np.testing.assert_array_equal(found.expert_actions[0], (1 + np.maximum(np.arange(1000) - 1, 0)) % 6)
    with pytest.raises(OptionError, match="the labeller's input is state, expected the agent's input ego_input"):
        agent_histories.with_noise(idle_agent(None), 10, AGENTS["oracle"](tasks[0].layout))


@pytest.mark.slow
def test_search_labels_histories_and_remembers_which_dish_was_rewarded():
    """Without noise, the script `search` agrees with its own play as soon as a dish was rewarded."""
    tasks = release_teammates(load_icrl4aht(layout="rooms-0-46", source="search").filter(teammate_family="H3")).tasks
    config = NoiseConfig(2, 10, start=(0.0, 0.0))
    found = agent_histories.record_histories(AGENTS["search"], tasks[:1], config, make_labeller=AGENTS["search"])
    returns, agrees = found.rewards.reshape(2, 10, 100).sum(axis=-1), found.actions == found.expert_actions
    for own, agree in zip(returns, agrees.reshape(2, 10, 100), strict=True):
        first = int(np.argmax(own > 0))
        assert own.max() == 40 and first < 5 and agree[first + 1 :].all()
    other = agent_histories.record_histories(idle_agent, tasks[:1], config, make_labeller=AGENTS["search"])
    assert (other.actions == STAY).all() and len(np.unique(other.expert_actions)) > 3


def test_teammates_of_given_tasks_are_added_to_teammates_of_the_release(dataset):
    tasks = [task for track in TRACKS for task in read_tasks(manifest_path(track, "train", "diverse"))]
    plain, more = release_teammates(dataset), release_teammates(dataset, number=1, tasks=tasks)
    added = more.tasks[len(plain.tasks) :]
    here = [task for task in tasks if task.layout.name == "cramped_up"]
    assert [task.teammate for task in added] == [task.teammate for task in here] and len(here) > 30
    assert {task.layout.name for task in added} == {"cramped_up"}  # only tasks on the release's layout are added
    assert len({task.task_id for task in plain.tasks + more.tasks}) == len(plain.tasks) + len(more.tasks)
    again = release_teammates(dataset, tasks=[*plain.tasks, *here[:1]])
    assert len(again.tasks) == len(plain.tasks) + 1  # tasks that exist already are not added twice


def test_tasks_on_other_layouts_or_with_learned_teammates_raise_errors(dataset):
    with pytest.raises(OptionError, match=r"expected tasks on cramped_up, found 120 on coord_ring, .*: leave out the"):
        release_teammates(dataset, tasks=read_tasks(manifest_path("teammate", "test")))
    learned = replace(TEST_TASKS[0], teammate={"kind": "rl", "family": "fcp", "theta": {}})
    with pytest.raises(OptionError, match="its teammate is learned; expected heuristics, which need no checkpoints"):
        release_teammates(dataset, tasks=[learned])


def test_stopped_collection_resumes_to_an_equal_release(release, teammates, tmp_path, monkeypatch):
    played: list[str] = []

    def interrupt_write(*args: Any, **options: Any) -> Any:
        raise KeyboardInterrupt

    def record(make: Any, tasks: Any, *args: Any) -> Any:
        played.append(tasks[0].layout.name)
        return original(make, tasks, *args)

    original, target = agent_histories.record_histories, tmp_path / "release"
    monkeypatch.setattr(agent_histories, "record_histories", record)
    with monkeypatch.context() as patch:
        patch.setattr(agent_histories, "write_release", interrupt_write)
        with pytest.raises(KeyboardInterrupt):
            collect_release(COOK, teammates, CONFIG, target)
    assert not target.exists() and played == ["cramped_up"]
    with pytest.raises(OptionError, match=r"release\.parts: holds parts with other settings .*histories.*remove the"):
        collect_release(COOK, teammates, NoiseConfig(3, 10), target)
    collect_release(COOK, teammates, CONFIG, target)
    assert played == ["cramped_up"]
    assert (target / "MANIFEST.sha256").read_bytes() == (release / "MANIFEST.sha256").read_bytes()


@pytest.mark.slow
def test_swap_changes_the_teammate_every_few_episodes(release, teammates, tmp_path):
    tasks = [task for task in teammates.tasks if task.split == "train"][:2]
    chosen = teammates._replace(tasks=tasks)
    collect_release(COOK, chosen, CONFIG, tmp_path / "release", swap=4)
    swapped, plain = load_icrl4aht(tmp_path / "release"), load_icrl4aht(release, task_id=[one.task_id for one in tasks])
    one, two = (teammate_id(task.teammate) for task in tasks)
    assert [entry.teammate_of_episode for entry in swapped.entries[::2]] == [
        ((0, one), (4, two), (8, one)),
        ((0, two), (4, one), (8, two)),
    ]
    for history, before in zip(swapped, plain, strict=True):  # random keys depend only on the task
        same = [(history.episodes[e].state == before.episodes[e].state).all() for e in range(10)]
        assert all(same[:4]) and not all(same[4:8])
    assert verify_release(tmp_path / "release", level="deep").findings == []


def test_planned_swaps_use_different_teammates_of_the_same_split(teammates):
    tasks = teammates.tasks
    swaps = agent_histories.plan_swaps(tasks, 10, 3)
    assert swaps.keys() == {task.task_id for task in tasks}
    split = {teammate_id(task.teammate): task.split for task in tasks}
    for task in tasks:
        played = [teammate_id(teammate) for teammate in swaps[task.task_id].teammates]
        assert played[0] == teammate_id(task.teammate) and len(set(played)) == len(played) <= 4
        assert {split[one] for one in played} == {task.split}
    with pytest.raises(OptionError, match=r"swap = 10: expected 1 to 9, since a history has 10 episodes"):
        agent_histories.plan_swaps(tasks, 10, 10)
    with pytest.raises(OptionError, match=f"swap = 3: expected at least 2 .* found 1, as in {tasks[0].task_id};"):
        agent_histories.plan_swaps(tasks[:1], 10, 3)


@pytest.mark.slow
def test_collect_command_writes_a_release_and_refuses_to_overwrite(tmp_path):
    choice = ["--layout", "cramped_up", "--teammate-family", "H3", "--histories", "1", "--episodes", "10"]
    arguments = ["collect", "--agent", "random", *choice, "--out", str(tmp_path / "release")]
    printed = run_cli(*arguments)
    assert "describes it" in printed
    with pytest.raises(OptionError, match="--overwrite"):
        run_cli(*arguments)
    run_cli(*arguments[:-1], str(tmp_path / "second"), "--number", "1")
    combined = load_icrl4aht(combine_releases(tmp_path / "both", [tmp_path / "release", tmp_path / "second"]))
    one, two = (set(combined.select(numbers).column("task_id")) for numbers in np.array_split(combined.ids, 2))
    assert len(one) == len(two) and not one & two
