"""Conversion to Minari datasets, which Minari itself opens, and back."""

from __future__ import annotations

import json
import re
import sys

import gymnasium
import h5py
import minari
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.commands.cli import main
from icrl4aht_data.dataset import MINI
from icrl4aht_data.environments import TASK_ENVIRONMENT
from icrl4aht_data.errors import MinariFormatError, NotStoredError, OptionError
from icrl4aht_data.format.schema import FIELDS
from icrl4aht_data.utils.installation import install_command
from icrl4aht_data.writing.minari import from_minari, is_minari_dataset, to_minari

EPISODES, STEPS = 6, 20
"""Episodes of a history of the fixture `lite`, and their steps."""


@pytest.fixture(scope="module")
def converted(lite, tmp_path_factory):
    """All histories of `lite`, whose two layouts have observations of unequal shape."""
    folder = tmp_path_factory.mktemp("minari")
    return to_minari(load_icrl4aht(lite[0]), folder / "lite-v0")


def test_minari_opens_every_episode(lite, converted, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(converted.parent))
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


@pytest.mark.parametrize("kind", ["lite", "full"])
def test_back_to_a_release(two_sources, kind, tmp_path):
    original = load_icrl4aht(two_sources[0])
    to_minari(original, tmp_path / "all-v1")
    from_minari(tmp_path / "all-v1", tmp_path / "back", kind)
    assert verify_release(tmp_path / "back", level="full").ok
    back = load_icrl4aht(tmp_path / "back")
    assert back.info.kind == kind
    for one, two in zip(original, back, strict=True):
        for name in ("task_id", "split", "source", "env_idx", "learner", "episodes", "has_oracle_actions"):
            assert getattr(one.entry, name) == getattr(two.entry, name)
        for name in (name for name, field in FIELDS.items() if one.entry.has(field)):
            np.testing.assert_array_equal(one.read(name), two.read(name), err_msg=name)


def test_a_dataset_of_one_task_has_its_environment(tmp_path):
    """Minari recovers the environment that the release recovers."""
    release = load_icrl4aht(MINI, layout="demo_wide", source="noise", teammate_family="H3")
    part = release.filter(task_id=release.entries[0].task_id)[:1]
    to_minari(part, tmp_path / "one-v0")
    spec = minari.MinariDataset(tmp_path / "one-v0" / "data").env_spec
    assert spec is not None
    assert (spec.id, spec.max_episode_steps) == (TASK_ENVIRONMENT, 400)
    assert spec.kwargs["task"]["task_id"] == part.entries[0].task_id
    env = minari.MinariDataset(tmp_path / "one-v0" / "data").recover_environment()
    assert env.observation_space.shape == (5, 5, 45)


def test_commands(lite, tmp_path, monkeypatch, capsys):
    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["icrl4aht-data", "convert", "--quiet", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    made, back = str(tmp_path / "wide-v0"), str(tmp_path / "back")
    forth = [str(lite[0]), "--layout", "demo_wide", "--to", "minari", "--out", made]
    assert run(*forth) == 0
    assert run(*forth) != 0
    assert "exists" in capsys.readouterr().err
    assert run(*forth, "--overwrite") == 0
    assert is_minari_dataset(tmp_path / "wide-v0")
    assert run(made, "--out", back) == 0
    assert len(load_icrl4aht(back)) == 6
    assert run(made, "--to", "published", "--out", str(tmp_path / "p")) == 2
    assert "a Minari dataset converts to full or lite" in capsys.readouterr().err


def test_wrong_selections_and_names_are_errors(lite, converted_release, tmp_path):
    with pytest.raises(NotStoredError, match="has observations only"):
        to_minari(load_icrl4aht(converted_release), tmp_path / "some-v0")
    with pytest.raises(OptionError, match="expected a folder named as a Minari dataset, such as demo_wide-v0"):
        to_minari(load_icrl4aht(lite[0]), tmp_path / "some")
    assert not list(tmp_path.iterdir())


class TestWrongDatasets:
    @pytest.fixture
    def made(self, lite, tmp_path):
        return to_minari(load_icrl4aht(lite[0], layout="demo_wide")[:1], tmp_path / "made-v0")

    def change_metadata(self, folder, **changes):
        path = folder / "data" / "metadata.json"
        content = json.loads(path.read_text())
        path.write_text(json.dumps({k: v for k, v in (content | changes).items() if v is not None}))

    def error(self, folder) -> str:
        with pytest.raises(MinariFormatError) as raised:
            from_minari(folder, folder.parent / "back")
        assert not (folder.parent / "back").exists()
        assert str(folder) in str(raised.value)
        return str(raised.value)

    def test_of_others(self, made):
        self.change_metadata(made, icrl4aht=None)
        assert "only datasets of `convert --to minari` can be converted" in self.error(made)

    def test_malformed_metadata(self, made):
        self.change_metadata(made, icrl4aht={"kept_steps": "many"})
        assert "metadata icrl4aht" in self.error(made)
        (made / "data" / "metadata.json").write_text("{")
        assert "cannot be read as a Minari dataset" in self.error(made)

    def test_missing_episodes_and_infos(self, made):
        with h5py.File(made / "data" / "main_data.hdf5", "a") as file:
            del file["episode_2/infos/state"]
        assert "episode 2: infos have no state" in self.error(made)
        with h5py.File(made / "data" / "main_data.hdf5", "a") as file:
            del file["episode_1"]
        assert "episode 1: cannot be read" in self.error(made)
        self.change_metadata(made, total_episodes=5)
        assert "expected the 6 episodes of its metadata, found 5" in self.error(made)

    def test_episodes_of_another_length(self, made):
        with h5py.File(made / "data" / "main_data.hdf5", "a") as file:
            rewards = file["episode_0/rewards"]
            assert isinstance(rewards, h5py.Dataset)
            rewards.resize((STEPS - 1,))
        assert "expected 20 actions and rewards" in self.error(made)

    def test_changed_tasks(self, made):
        about = json.loads((made / "data" / "metadata.json").read_text())["icrl4aht"]
        about["tasks"][0]["seed"] += 1
        self.change_metadata(made, icrl4aht=about)
        assert "does not match the task's content" in self.error(made)

    def test_without_minari(self, made, lite, monkeypatch):
        monkeypatch.setitem(sys.modules, "minari", None)
        with pytest.raises(OptionError, match=re.escape("" + install_command("minari"))):
            to_minari(load_icrl4aht(lite[0]), made.with_name("x-v0"))
        with pytest.raises(OptionError, match=re.escape("" + install_command("minari"))):
            from_minari(made, made.with_name("back"))
