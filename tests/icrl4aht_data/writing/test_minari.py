"""Test conversion to Minari datasets, which are read back with Minari."""

from __future__ import annotations

import gymnasium
import minari
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import MINI
from icrl4aht_data.environments import TASK_ENVIRONMENT
from icrl4aht_data.errors import NotStoredError, OptionError
from icrl4aht_data.writing.minari import to_minari
from tests.helpers.commands import run_cli

EPISODES, STEPS = 6, 20
"""Episodes of a history of the fixture `lite`, and their steps."""


@pytest.fixture(scope="module")
def minari_folder(lite, tmp_path_factory):
    """Return the folder of `lite` as a Minari dataset; the release has two layouts with unequal observation shapes."""
    folder = tmp_path_factory.mktemp("minari")
    return to_minari(load_icrl4aht(lite[0]), folder / "lite-v0")


def test_minari_reads_the_arrays_of_every_episode(lite, minari_folder, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(minari_folder.parent))
    opened = minari.load_dataset("lite-v0")
    release = load_icrl4aht(lite[0], obs="uint8", channels="canonical")
    assert opened.total_episodes == EPISODES * len(release)
    assert opened.total_steps == sum(len(history) for history in release)
    assert opened.observation_space == gymnasium.spaces.Box(0, 255, (5, 5, 46), np.uint8)
    assert opened.action_space == gymnasium.spaces.Discrete(6)
    for number, episode in enumerate(opened.iterate_episodes()):
        history, first = release[number // EPISODES], number % EPISODES * STEPS
        steps = slice(first, first + STEPS)
        assert episode.observations.shape == (STEPS + 1, 5, 5, 46)
        np.testing.assert_array_equal(episode.observations[:-1], history.obs[steps])
        np.testing.assert_array_equal(episode.actions, history.actions[steps])
        np.testing.assert_array_equal(episode.rewards, history.rewards[steps])
        np.testing.assert_array_equal(episode.truncations, history.dones[steps])
        assert not episode.terminations.any()
        np.testing.assert_array_equal(episode.infos["state"][:-1], history.state[steps])
        np.testing.assert_array_equal(episode.infos["state"][-1], history.episode_end_state[number % EPISODES])
        np.testing.assert_array_equal(episode.infos["teammate_action"][1:], history.teammate_actions[steps])
        np.testing.assert_array_equal(episode.infos["expert_action"][:-1], history.expert_actions[steps])
    facts = next(iter(opened.storage.get_episode_metadata([EPISODES])))
    assert (facts["history"], facts["episode"], facts["task_id"]) == (1, 0, release.entries[1].task_id)


def test_minari_dataset_of_one_task_recovers_its_environment(tmp_path):
    """Minari recovers the task's environment from the converted dataset."""
    release = load_icrl4aht(MINI, layout="demo_wide", source="noise", teammate_family="H3")
    part = release.filter(task_id=release.entries[0].task_id)[:1]
    to_minari(part, tmp_path / "one-v0")
    spec = minari.MinariDataset(tmp_path / "one-v0" / "data").env_spec
    assert spec is not None
    assert (spec.id, spec.max_episode_steps) == (TASK_ENVIRONMENT, 400)
    assert spec.kwargs["task"]["task_id"] == part.entries[0].task_id
    env = minari.MinariDataset(tmp_path / "one-v0" / "data").recover_environment()
    assert env.observation_space.shape == (5, 5, 45)


def test_minari_metadata_contains_tasks_and_provenance_and_no_environment(lite, minari_folder):
    opened, release = minari.MinariDataset(minari_folder / "data"), load_icrl4aht(lite[0])
    assert opened.env_spec is None
    shown = opened.storage.metadata
    assert shown["author"] == {"The icrl4aht-data authors"} and shown["dataset_size"] > 0
    assert "4 tasks; there is no single environment to recover" in shown["description"]
    about = shown["icrl4aht"]
    assert (about["data_version"], about["kept_steps"]) == ("0.0.1", STEPS)
    names = release.column("task_id").tolist()
    assert [history["task_id"] for history in about["histories"]] == names
    assert {task["task_id"] for task in about["tasks"]} == about["provenance"].keys() == set(names)


def test_convert_command_writes_and_overwrites_minari_datasets(lite, tmp_path):
    made = ["convert", "--quiet", lite[0], "--layout", "demo_wide", "--to", "minari", "--out", tmp_path / "wide-v0"]
    run_cli(*made)
    run_cli(*made, "--overwrite")
    assert len(minari.MinariDataset(tmp_path / "wide-v0" / "data")) == 6 * EPISODES


def test_to_minari_refuses_missing_states_and_invalid_names(lite, converted_release, tmp_path):
    with pytest.raises(NotStoredError, match="has observations only"):
        to_minari(load_icrl4aht(converted_release), tmp_path / "some-v0")
    with pytest.raises(OptionError, match="expected a folder with a Minari name, such as demo_wide-v0"):
        to_minari(load_icrl4aht(lite[0]), tmp_path / "some")
    assert not list(tmp_path.iterdir())
