"""Test the choice of the checkpoint whose actions label a task's histories, and the storage of this policy."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.collection.curate import greedy_labels
from icrl4aht_generation.collection.task_folder import LABELLER_RETURNS, is_task_finished
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, load_policy
from icrl4aht_generation.profiles import Profile, WorkUnit, load_profile
from icrl4aht_generation.releases import labeller
from icrl4aht_generation.releases.labeller import CheckpointReturns, choose_checkpoint, choose_labeller
from icrl4aht_generation.releases.measures import teammate_facts
from icrl4aht_generation.releases.package import package_release
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.facts import LABEL_EPISODES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import Kind
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.utils.files import file_hash
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from tests.helpers.damages import flip_bit
from tests.helpers.tiny import artefact


def returns_with_means(*means: float, spread: float = 0.0) -> np.ndarray:
    """Return episode returns, of shape (C, E), of C checkpoints with the given mean returns.

    `spread` is the standard deviation, over episodes, of the difference between two checkpoints' returns.
    """
    noise = np.random.default_rng(0).normal(size=(len(means), LABEL_EPISODES)) * spread / np.sqrt(2)
    return np.array(means)[:, None] + noise - noise.mean(axis=1, keepdims=True)


def test_last_checkpoint_is_chosen_unless_an_earlier_one_is_clearly_better():
    assert choose_checkpoint(returns_with_means(0, 5, 10, 20, 20)) == 4
    assert choose_checkpoint(returns_with_means(0, 0, 0, 0, 0)) == 4
    assert choose_checkpoint(returns_with_means(7)) == 0
    assert choose_checkpoint(returns_with_means(0, 5, 16.9, 3, 0)) == 2
    assert choose_checkpoint(returns_with_means(9, 5, 9, 3, 0)) == 2  # the later of two equal checkpoints is chosen


def test_earlier_checkpoint_must_be_better_by_2_and_by_two_standard_errors():
    assert choose_checkpoint(returns_with_means(1.9, 0)) == 1
    assert choose_checkpoint(returns_with_means(2.1, 0)) == 0
    error = 5 / 2.1  # a difference of 5 is 2.1 standard errors
    assert choose_checkpoint(returns_with_means(5, 0, spread=error * np.sqrt(LABEL_EPISODES))) == 0
    assert choose_checkpoint(returns_with_means(5, 0, spread=error * np.sqrt(LABEL_EPISODES) * 1.2)) == 1


@pytest.fixture
def task(built, tmp_path):
    """Return the task of the fixture `built`, its profile, and a copy of its artefact with measured returns."""
    profile = load_profile(str(built / "tiny.toml"))
    folder = tmp_path / "artefacts" / artefact(built / "a").name
    shutil.copytree(artefact(built / "a"), folder)
    for kept in artefact(built / "a").parent.glob(".*.teammates.json"):  # stored measurements of the teammate
        shutil.copy(kept, folder.parent)
    return profile.units()[0].task, profile, folder


def set_greedy_returns(folder: Path, greedy: list[float]) -> None:
    """Replace the measured greedy returns in an artefact by one constant for each checkpoint."""
    content = json.loads((folder / LABELLER_RETURNS).read_text())
    content["measured"]["greedy"] = [[value] * LABEL_EPISODES for value in greedy]
    (folder / LABELLER_RETURNS).write_text(json.dumps(content))


def stored_returns(folder: Path) -> dict:
    return json.loads((folder / LABELLER_RETURNS).read_text())["measured"]


def package_task(task: tuple[Task, Profile, Path], target: Path, kind: Kind = "lite", **changes: Any) -> Path:
    """Package the task into a release, with some settings of the profile changed."""
    chosen, profile, folder = task
    facts = teammate_facts([chosen], folder.parent, target)
    return package_release(folder.parent, target, [WorkUnit(chosen)], replace(profile, **changes), target, kind, facts)


def fail_if_called(*arguments):
    raise AssertionError("returns were measured again")


def test_packaging_measures_every_checkpoint_once(task, tmp_path, monkeypatch):
    chosen, profile, folder = task
    found = stored_returns(folder)
    for way in ("greedy", "sampled"):
        assert np.shape(found[way]) == (5, 200)
        assert (np.array(found[way]) % 5 == 0).all()  # rewards are multiples of 5
    assert len(np.unique(found["sampled"])) > 1
    monkeypatch.setattr(labeller, "_measure", fail_if_called)
    package_task(task, tmp_path / "full", "full")
    assert is_task_finished(folder, WorkUnit(chosen), profile)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: "",
        lambda content: content[:-9],
        lambda content: content.replace('"checkpoints":["', '"checkpoints":["0'),
        lambda content: content.replace('"greedy"', '"gredy"'),
        lambda content: content.replace("0.0,", "NaN,", 1),
        lambda content: content.replace("0.0,", "", 1),
        lambda content: "[]",
    ],
)
def test_damaged_or_outdated_measurements_are_repeated(task, tmp_path, monkeypatch, damage):
    chosen, _, folder = task
    before = (folder / LABELLER_RETURNS).read_text()
    assert damage(before) != before
    (folder / LABELLER_RETURNS).write_text(damage(before))
    again = CheckpointReturns(**json.loads(before)["measured"])
    monkeypatch.setattr(labeller, "_measure", lambda *arguments: again)
    choose_labeller([folder], chosen, tmp_path)
    assert (folder / LABELLER_RETURNS).read_text() == before


@pytest.mark.slow
def test_measured_returns_equal_those_of_a_loop_over_steps(task):
    """Compare greedy returns of the last checkpoint with a loop over steps of the environment."""
    chosen, _, folder = task
    network, params, _ = load_policy(folder / "checkpoints/c4")
    mate = build_teammate(chosen.layout, chosen.teammate, TEAMMATE, "seeded")
    env = Environment(chosen.layout, 400)
    key = jax.random.key(int(hashlib.sha256(chosen.task_id.encode()).hexdigest()[:8], 16))
    state = env.init(jax.random.split(jax.random.split(key)[0], LABEL_EPISODES))

    @jax.jit
    def step(state, hidden, memory, key):
        obs = observe(chosen.layout, state.record, EGO)[None]
        result: Any = network.apply(params, hidden, obs, np.zeros((1, LABEL_EPISODES), bool))
        hidden, logits, _ = result
        keys = jax.random.split(key, LABEL_EPISODES)
        action, memory = jax.vmap(mate.act, (None, 0, 0, 0))(mate.params, memory, state.record, keys)
        result = env.step(state, jnp.stack([logits[0].argmax(-1), action], axis=-1))
        return result.state, hidden, memory, result.reward

    keys = jax.vmap(jax.random.fold_in, (0, None))(env.episode_key(state), TEAMMATE)
    memory, hidden = jax.vmap(mate.init, (None, 0))(mate.params, keys), network.initial_hidden(LABEL_EPISODES)
    returns = np.zeros(LABEL_EPISODES)
    for key in jax.random.split(jax.random.key(0), 100):
        state, hidden, memory, reward = step(state, hidden, memory, key)
        returns += np.asarray(reward)
    assert stored_returns(folder)["greedy"][4] == returns.tolist()


def test_clearly_better_earlier_checkpoint_labels_the_histories(task, tmp_path):
    chosen, _, folder = task
    set_greedy_returns(folder, [0, 60, 20, 5, 0])
    sampled = np.mean(stored_returns(folder)["sampled"][1])
    root = package_task(task, tmp_path / "lite")
    dataset = load_icrl4aht(root)
    network, params, card = load_policy(folder / "checkpoints/c1")
    for history in dataset:
        labels = greedy_labels(chosen.layout, network, params, history.state[:])
        np.testing.assert_array_equal(history.expert_actions[:], labels)
        assert (history.entry.expert_return, history.entry.expert_return_sampled) == (60, sampled)
        assert history.entry.expert_step == card["steps"] == 3_200 * 2
    expert = read_provenance(root / "meta/provenance.json")[chosen.task_id].expert
    assert expert is not None
    assert (expert.return_greedy, expert.return_sampled) == (60, sampled)
    assert (expert.step, expert.last_return_greedy, expert.episodes) == (card["steps"], 0, 200)
    assert expert.policy_sha256 == file_hash(folder / "checkpoints/c1/policy.safetensors")
    assert "## Labels" in (root / "README.md").read_text()
    assert verify_release(root).ok


@pytest.fixture
def release_with_policies(task, tmp_path) -> Path:
    """Return a release that contains the labelling policies."""
    return package_task(task, tmp_path / "with", policies=True)


def policy_files(root: Path) -> dict[str, str]:
    return {name: digest for name, digest in read_manifest(root).items() if name.startswith("experts/")}


def test_profile_setting_policies_adds_labelling_policies_to_the_release(built, release_with_policies, tmp_path):
    assert not policy_files(built / "a" / "lite")
    (of_task,) = read_provenance(release_with_policies / "meta/provenance.json").values()
    assert of_task.expert is not None
    folder = f"experts/{of_task.expert.policy_sha256}"
    files = policy_files(release_with_policies)
    assert set(files) == {f"{folder}/{name}" for name in (POLICY_WEIGHTS, POLICY_CARD)}
    assert files[f"{folder}/{POLICY_WEIGHTS}"] == of_task.expert.policy_sha256
    assert load_policy(release_with_policies / folder)[2]["steps"] == of_task.expert.step
    assert verify_release(release_with_policies).ok
    full = to_release(load_icrl4aht(release_with_policies), tmp_path / "full", "full")
    assert policy_files(full) == files
    assert policy_files(combine_releases(tmp_path / "both", [full])) == files


def test_verify_compares_labelling_policies_and_index_with_provenance(release_with_policies):
    root = release_with_policies
    weights = next(root.glob("experts/*/policy.safetensors"))
    flip_bit(weights)
    provenance = json.loads((root / "meta/provenance.json").read_text())
    (of_task,) = provenance.values()
    of_task["expert"]["return_greedy"] = 99.0
    (root / "meta/provenance.json").write_text(json.dumps(provenance))
    write_manifest(root)
    problems = sorted((finding.file, finding.problem) for finding in verify_release(root).findings)
    assert problems[0][0] == weights.relative_to(root).as_posix()
    assert f"expected {weights.parent.name}, the name of its folder" in problems[0][1]
    assert [file for file, _ in problems[1:]] == ["meta/histories.jsonl"] * 3
    assert "but meta/provenance.json has 99.0 of its task" in problems[1][1]
