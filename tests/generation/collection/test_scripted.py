"""Test histories played by scripted egos: actions, noise, labels, and independence from the batch size."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.collection import scripted_rollout
from icrl4aht_generation.collection.curate import oracle_labels
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.scripted import scripted_bytes
from icrl4aht_generation.collection.scripted_rollout import noise_schedules, play_scripted_histories
from icrl4aht_generation.collection.task_folder import METADATA, TIMING, last_timing, partial_folder
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS
from icrl4aht_generation.profiles import Profile, WorkUnit, load_profile
from icrl4aht_generation.profiles.noise_config import SEARCH, NoiseConfig
from icrl4aht_generation.releases.check import compare_rebuilds
from icrl4aht_generation.teammates.distances import act_on_records
from icrl4aht_generation.teammates.learned import build_learned
from icrl4aht_generation.teammates.preference import WATCHER, all_dishes
from icrl4aht_generation.teammates.registry import build_teammate, heuristic_teammate

from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.errors import DiskFullError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.utils.files import file_hash
from tests.generation.teammates.test_learned import save_random_checkpoint
from tests.helpers.commands import run_cli
from tests.helpers.tiny import NOISE

PIECE = 16
LAYOUT = get_layout("demo_wide")
MATE = heuristic_teammate("utility_greedy", "default", 0)
WORK = WorkUnit(make_task("teammate", "train", "demo_wide", MATE, 7), "noise")


pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def small_batches():
    """Play the 40 episodes of a task in three batches of 16; the last batch is half filled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scripted_rollout, "EPISODES_AT_ONCE", PIECE)
        yield


@pytest.fixture(scope="module")
def profile(tmp_path_factory) -> Profile:
    path = tmp_path_factory.mktemp("noise") / "noise.toml"
    path.write_text(NOISE)
    return load_profile(str(path))


@pytest.fixture(scope="module")
def noise_artefact(profile, small_batches, tmp_path_factory) -> Path:
    """Return the folder of a collected task with noise histories."""
    job = CollectionJob(WORK, profile, tmp_path_factory.mktemp("noise"))
    job.run()
    return job.folder


@pytest.fixture(scope="module")
def arrays(noise_artefact) -> dict[str, np.ndarray]:
    return {path.stem: np.load(path) for path in noise_artefact.glob("*.npy")}


def test_noise_artefact_has_arrays_of_expected_shapes_and_size(arrays, noise_artefact, profile):
    size = 24
    assert {name: (array.shape, str(array.dtype)) for name, array in arrays.items()} == {
        "state": ((4, 1000, size), "uint8"),
        "actions": ((4, 1000), "int8"),
        "teammate_actions": ((4, 1000), "int8"),
        "rewards": ((4, 1000), "int8"),
        "episode_end_state": ((4, 10, size), "uint8"),
        "script_actions": ((4, 1000), "int8"),
        "noise": ((4, 10), "float32"),
    }
    stored = sum(path.stat().st_size for path in noise_artefact.iterdir() if path.name != METADATA)
    assert stored == pytest.approx(scripted_bytes(LAYOUT, profile.noise), abs=2_000)


def test_every_recorded_step_follows_the_rules(arrays):
    states = arrays["state"].reshape(40, 100, -1)
    after = np.concatenate([states[:, 1:], arrays["episode_end_state"].reshape(40, 1, -1)], axis=1)
    actions = np.stack([arrays["actions"], arrays["teammate_actions"]], axis=-1).reshape(40, 100, 2).astype(int)
    found = step(LAYOUT, states, actions, after[..., 6])
    np.testing.assert_array_equal(found.state, after)
    np.testing.assert_array_equal(found.reward, arrays["rewards"].reshape(40, 100))
    assert len(np.unique(states[:, 0], axis=0)) > 30, "episodes start in different states"


def test_actions_equal_oracle_actions_except_for_noise(arrays):
    """By chance, one in six random actions equals the action of the oracle."""
    clean = (arrays["actions"] == arrays["script_actions"]).reshape(40, 100)
    expected = 1 - arrays["noise"].reshape(40, 1) * 5 / 6
    assert clean[expected[:, 0] == 1].all()
    assert abs(clean.mean() - expected.mean()) < 4 * np.sqrt((expected * (1 - expected)).sum() / 40 / 4000)
    noisy = arrays["actions"].reshape(40, 100)[~clean]  # only random actions can differ from the oracle's
    assert (np.bincount(noisy, minlength=6) > 0.1 * len(noisy)).all()


def test_labels_equal_oracle_labels_of_recorded_states_and_actions(arrays):
    found = [oracle_labels(LAYOUT, *one) for one in zip(arrays["state"], arrays["actions"], strict=True)]
    np.testing.assert_array_equal(found, arrays["script_actions"])


def test_episode_depends_only_on_seed_history_and_episode_number(arrays):
    """Episodes of several histories, played in one batch, equal the episodes of the collected task."""
    mate = build_teammate(None, MATE)
    history, episode = np.array([3, 1, *[0] * 14]), np.array([2, 9, *range(14)])
    # Episodes 10 to 13 have the noise of episodes 0 to 3.
    chances = np.concatenate([arrays["noise"], arrays["noise"]], axis=1)

    def play(seed):
        return next(play_scripted_histories(LAYOUT, mate, seed, "noise", [(history, episode)], chances))[1]

    found = play(7)
    for k in range(2):
        steps = slice(100 * episode[k], 100 * episode[k] + 100)
        np.testing.assert_array_equal(np.asarray(found["state"])[k], arrays["state"][history[k], steps])
        np.testing.assert_array_equal(np.asarray(found["actions"])[k], arrays["actions"][history[k], steps])
    other = play(8)
    assert not np.array_equal(np.asarray(other["state"])[0], np.asarray(found["state"])[0])


def test_noise_schedules_follow_their_settings():
    """Noise follows the formula within the given ranges and does not depend on the number of histories."""
    linear = noise_schedules(NoiseConfig(histories=2, episodes=11), 0)
    np.testing.assert_allclose(linear, [np.linspace(1, 0, 11)] * 2, atol=1e-6)
    steep = NoiseConfig(histories=1, episodes=11, begin=(0.2, 0.2), finish=(0.6, 0.6), power=(2, 2), end=(0.1, 0.1))
    expected = [1, 1, 1, *(0.1 + 0.9 * (1 - x) ** 2 for x in (0.25, 0.5, 0.75)), *[0.1] * 5]
    np.testing.assert_allclose(noise_schedules(steep, 0)[0], expected, atol=1e-6)
    sudden = NoiseConfig(histories=1, episodes=11, begin=(0.5, 0.5), finish=(0.5, 0.5))
    np.testing.assert_array_equal(noise_schedules(sudden, 0)[0], [1] * 6 + [0] * 5)
    ranges = {"start": (0.8, 1), "end": (0, 0.2), "begin": (0, 0.4), "finish": (0.5, 1), "power": (0.5, 2)}
    drawn = noise_schedules(NoiseConfig(histories=50, episodes=30, **ranges), 3)
    assert drawn.dtype == np.float32
    assert (np.diff(drawn) <= 0).all()
    assert 0.8 <= drawn[:, 0].min() < 0.85 < 0.95 < drawn[:, 0].max() <= 1
    assert 0 <= drawn[:, -1].min() < 0.05 < 0.15 < drawn[:, -1].max() <= 0.2
    np.testing.assert_array_equal(noise_schedules(NoiseConfig(histories=9, episodes=30, **ranges), 3), drawn[:9])
    assert not np.array_equal(noise_schedules(NoiseConfig(histories=50, episodes=30, **ranges), 4), drawn)
    # Histories have different noise at the same episode number.
    assert np.ptp(drawn[:, 15]) > 0.5


def test_interrupted_scripted_task_is_collected_again_with_equal_results(noise_artefact, profile, tmp_path):
    job, seen = CollectionJob(WORK, profile, tmp_path), []

    def stop(done, speed):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job.run(stop)
    assert (partial_folder(job.folder) / "rewards.npy").exists()
    job.run(lambda done, speed: seen.append(done))
    assert seen == [1, 2, 3]
    assert not compare_rebuilds(job.folder, noise_artefact).differences
    assert not partial_folder(job.folder).exists()


def test_timing_file_is_not_in_the_hashed_metadata(noise_artefact):
    assert TIMING not in json.loads((noise_artefact / METADATA).read_text())["files"]
    timing = last_timing(noise_artefact)
    assert timing is not None
    assert timing["update"] == 2
    assert 0 < timing["recording"] < timing["seconds"]


def test_full_disk_leaves_no_files_of_a_scripted_task(profile, tmp_path):
    def raise_disk_full(pieces, speed):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    job = CollectionJob(WORK, profile, tmp_path)
    with pytest.raises(DiskFullError, match=r": the disk is full: this task needs "):
        job.run(raise_disk_full)
    assert not partial_folder(job.folder).exists()


def search_histories(profile: Profile, folder: Path, dish: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Return histories of the scripted ego that searches for the wanted recipe; the teammate never acts."""
    work = WorkUnit(make_task("preference", "train", "asymm_both_plain", WATCHER, 5, [dish]), "search")
    job = CollectionJob(work, profile, folder)
    job.run()
    assert job.is_finished()
    return {path.stem: np.load(path) for path in job.folder.glob("*.npy")}


def test_searching_ego_finds_and_remembers_the_wanted_recipe(profile, tmp_path):
    config = replace(SEARCH, histories=8, episodes=10, start=(0.0, 0.0))
    exact = replace(profile, search=config)
    one, other = (search_histories(exact, tmp_path, dish) for dish in ((0, 0, 0), (1, 1, 1)))
    for found in (one, other):
        np.testing.assert_array_equal(found["actions"], found["script_actions"])
        returns = found["rewards"].reshape(8, 10, 100).sum(axis=-1)
        for own in found["rewards"]:
            assert (own < 0).sum() < len(all_dishes(get_layout("asymm_both_plain"))), "a dish is refused at most once"
            assert not (own[(own > 0).argmax() :] < 0).any(), "no wrong delivery after the first correct one"
        assert (returns[:, 5:] > 0).all(), returns
        assert returns[:, 5:].mean() > returns[:, 0].mean() + 20
        assert (returns[:, 0] < 0).any(), "some histories begin with a wrong dish"
    # Before the first delivery, actions do not depend on the wanted recipe, which is not shown.
    delivered = np.minimum(*((found["rewards"] != 0).argmax(axis=1) for found in (one, other)))
    assert (delivered > 10).all()
    for history, step_ in enumerate(delivered):
        np.testing.assert_array_equal(one["actions"][history, :step_], other["actions"][history, :step_])
    assert any(not np.array_equal(a, b) for a, b in zip(one["actions"], other["actions"], strict=True))


def test_noise_of_a_search_history_is_constant():
    chances = noise_schedules(replace(SEARCH, histories=50), 0)
    assert (chances == chances[:, :1]).all()
    assert chances.min() >= 0
    assert chances.max() <= 0.2
    assert np.ptp(chances[:, 0]) > 0.1


@pytest.mark.slow
def test_scripted_histories_can_have_a_learned_teammate(profile, tmp_path):
    """The learned teammate takes the greedy actions of its policy."""
    save_random_checkpoint(tmp_path / "suite/member", LAYOUT)
    theta = {"checkpoint": "member", "sha256": file_hash(tmp_path / "suite/member" / POLICY_WEIGHTS)}
    mate = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0, "theta": theta}
    work = WorkUnit(make_task("teammate", "train", "demo_wide", mate, 3), "noise")
    job = CollectionJob(work, profile, tmp_path, tmp_path / "suite")
    job.run()
    states = np.load(job.folder / "state.npy").reshape(40, 100, -1)[[0, 25]].swapaxes(0, 1)
    policy = build_learned(LAYOUT, tmp_path / "suite/member")
    expected = act_on_records(LAYOUT, [policy], jnp.asarray(states))[0].T
    played = np.load(job.folder / "teammate_actions.npy").reshape(40, 100)[[0, 25]]
    np.testing.assert_array_equal(played, expected)
    assert len(np.unique(played)) > 1


@pytest.mark.slow
def test_generate_check_and_verify_commands_accept_scripted_histories(tmp_path):
    """Verify a release, and compare it with a release collected in new processes in batches of 256 episodes."""
    (tmp_path / "noise.toml").write_text(NOISE)
    command = ("generate", "--profile", tmp_path / "noise.toml", "--out")
    again = ("--tasks", tmp_path / "a/lite/meta/tasks.jsonl", "--workers", 2)
    for name, options in (("a", ()), ("b", again)):
        assert "demo_wide with utility_greedy, noise: finished at " in run_cli(*command, tmp_path / name, *options)
    run_cli("check", tmp_path / "a", tmp_path / "b")
    run_cli("verify", tmp_path / "a" / "lite", "--deep")
