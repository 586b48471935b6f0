"""Test bundled models, which are copied from training runs, loaded by name and listed by the command `models`."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from icrl4aht_baselines.agents import bundled
from icrl4aht_baselines.agents.bundled import EVERY_TRACK, MODEL_CARD, MODELS, bundle_run, bundled_models
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.report.comparison import describe_scores
from icrl4aht_baselines.report.stored_results import read_stored, results_file
from icrl4aht_baselines.training.histories import load_initial_params, prepare, read_trained
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import read_config
from PIL import Image

from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from tests.helpers.commands import run_cli

MODEL = ModelOptions(layers=1, width=8, heads=2, encoder="mlp")
OPTIONS = TrainOptions(steps=1, batch_size=2, context=6)


@pytest.fixture(scope="module")
def trained_run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bundled") / "run"
    histories = HistoryOptions(("demo_wide",), source=("noise",), channels="canonical", labels="oracle")
    job = prepare("ad", MODEL, OPTIONS, histories)
    job.train(folder)
    return folder


@pytest.fixture
def models(trained_run, tmp_path, monkeypatch) -> Path:
    """Replace the package's bundled models with one small model for the track `teammate`."""
    bundle_run(trained_run, "ad-tiny", "teammate", tmp_path)
    monkeypatch.setattr(bundled.bundled_models, "__defaults__", (tmp_path,))
    return tmp_path


def test_bundled_model_keeps_parameters_and_training_record_of_its_run(trained_run, models):
    agent = find_agent("ad-tiny")
    assert agent.details and agent.name == agent.details["model"] == "ad-tiny"
    assert agent.details["trained_on"] == {"teammate": read_trained(trained_run).trained_on}
    message = "ad-tiny: no model for layout cramped_down of track layout, only for tracks teammate: choose tasks"
    with pytest.raises(OptionError, match=message):
        agent.make(get_layout("cramped_down"))
    one, two = read_trained(trained_run), read_trained(models / "ad-tiny" / "teammate")
    jax.tree.map(np.testing.assert_array_equal, one.params, two.params)
    assert (one.step, one.context, one.layouts, one.trained_on) == (two.step, two.context, two.layouts, two.trained_on)
    text = (models / "ad-tiny" / "teammate" / "config.json").read_text(encoding="utf-8")
    assert json.loads(text)["histories"]["root"] == "mini" and str(Path.home()) not in text
    with (
        Image.open(trained_run / "curves.png") as drawn,
        Image.open(models / "ad-tiny" / "teammate" / "curves.png") as copied,
    ):
        assert copied.size == drawn.size and copied.mode == "P"


def test_bundled_model_samples_its_actions_by_default(trained_run, tmp_path, monkeypatch):
    bundle_run(trained_run, "ad-drawn", "teammate", tmp_path)
    monkeypatch.setattr(bundled.bundled_models, "__defaults__", (tmp_path,))
    by_default, greedy = find_agent("ad-drawn"), find_agent("ad-drawn", greedy=True)
    assert by_default.name == "ad-drawn" and by_default.details and by_default.details["sampled"] is True
    assert greedy.name == "ad-drawn (greedy)" and greedy.details and "sampled" not in greedy.details
    assert find_agent("ad-drawn", acting="exact", greedy=None).name == "ad-drawn"
    assert find_agent(str(trained_run), greedy=False).name == "AD+mlp (sampled)"
    with pytest.raises(UnknownNameError, match=r"unknown acting 'exat'.*Did you mean 'exact'"):
        find_agent(trained_run, acting="exat")  # type: ignore[arg-type]


def test_model_of_all_tracks_plays_every_layout_and_replaces_models_of_one_track(trained_run, models):
    folder = bundle_run(trained_run, "ad-tiny", EVERY_TRACK, models)
    assert [path.name for path in (models / "ad-tiny").iterdir() if path.is_dir()] == [EVERY_TRACK]
    agent, trained = find_agent("ad-tiny"), read_trained(folder)
    assert agent.details and (agent.details["run"], agent.details["trained_on"]) == (trained.hash, trained.trained_on)
    assert {agent.make(get_layout(name)).sees for name in ("demo_wide", "cramped_down")} == {"canonical_input"}
    strange = Layout("mine", "mine_too", ("W5W2W", "0A AW", "WWXWW"), recipes=((0, 2, 5),))
    with pytest.raises(OptionError, match=r"ad-tiny/all: trained with canonical channels: layout mine: .* ids below 4"):
        agent.make(strange)
    assert "all tracks: AD+mlp" in run_cli("models")
    bundle_run(trained_run, "ad-tiny", "layout", models)
    assert [*bundled_models(models)["ad-tiny"].runs] == ["layout"]


def test_bundling_rejects_invalid_names_unfinished_runs_and_large_models(trained_run, tmp_path, monkeypatch):
    for name in ("../ad", "oracle", "AD-x", ""):
        with pytest.raises(OptionError, match="expected lowercase words joined by hyphens, such as ad-reference"):
            bundle_run(trained_run, name, "teammate", tmp_path)
    config = json.loads((trained_run / "config.json").read_text())
    half = tmp_path / "half"
    shutil.copytree(trained_run, half)
    (half / "config.json").write_text(json.dumps(config | {"train": config["train"] | {"steps": 9}}))
    with pytest.raises(OptionError, match="half: training stopped at step 1 of 9; resume it with the same command"):
        bundle_run(half, "ad-tiny", "teammate", tmp_path / "models")
    monkeypatch.setattr(bundled, "_LARGEST", 1000)
    with pytest.raises(OptionError, match=r"parameters of [\d,]+ bytes, expected at most 1,000: bundle a smaller"):
        bundle_run(trained_run, "ad-tiny", "teammate", tmp_path / "models")
    assert not (tmp_path / "models").exists()


def test_models_in_the_package_are_small_and_loadable_and_have_cards():
    assert set(bundled_models(MODELS)) == {"ad-reference", "dpt-reference", "rl2-adapting", "rl2-reference"}
    scores = describe_scores(read_stored(results_file()), bundled_models(MODELS))
    for model in bundled_models(MODELS).values():
        assert model.role and re.search(r", M [+-]\d.* on tracks teammate and layout, M", scores[model.name])
        assert (MODELS / model.name / MODEL_CARD).is_file()
        agent = find_agent(model.name)
        for track, folder in model.runs.items():
            size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
            assert size < 2.1e6, folder
            played = {"teammate": ("demo_wide", "coord_ring"), "layout": ("asymm_right", "cramped_down")}
            for layout in played.get(track, ("demo_wide", "asymm_right", "templates-0-217")):
                assert agent.make(get_layout(layout)).sees == "canonical_input"


def test_training_rejects_initial_parameters_of_another_model_size(trained_run, tmp_path):
    out = str(tmp_path / "out")
    words = ["train", "ad", "--layout", "demo_wide", "--channels", "canonical"]
    arguments = [*words, "--out", out, "--init", str(trained_run)]
    small = ["--steps", "1", "--batch-size", "2", "--context", "6", "--heads", "2", "--dropout", "0.1"]
    with pytest.raises(OptionError, match=r"trained with other options \(width = 8, not 12\); give these"):
        run_cli(*arguments, *small, "--layers", "1", "--width", "12", "--positions", "none")
    with pytest.raises(OptionError, match=r"trained with other options \(.*positions = 'none', not 'rope'"):
        run_cli(*arguments, *small, "--layers", "1", "--width", "8", "--positions", "rope")
    assert not Path(out).exists()


def test_settings_state_the_versions_of_the_run_that_a_training_starts_from(trained_run):
    histories = HistoryOptions(("demo_wide",), source=("noise",), channels="canonical", labels="oracle")
    job, config = prepare("ad", MODEL, OPTIONS, histories), read_config(trained_run)
    load_initial_params(trained_run, job.method, job.about)
    found = job.about["init"]
    assert (found["run"], found["step"]) == (read_trained(trained_run).hash, 1) and "init" not in found
    stated = {name: config["histories"][name] for name in ("data_version", "manifest_sha256")}
    assert found.items() >= (stated | {"package_version": config["package_version"]}).items()


def test_models_command_lists_bundled_models(models):
    printed = run_cli("models")
    scores = "N – on track teammate, N – on track layout, N – on track preference, M – on tracks teammate and layout"
    assert re.search(rf"^ad-tiny: ; {scores}, M – on track preference; of 20\d\d-\d\d-\d\d\n", printed)
    assert "\n  track teammate: AD+mlp, " in printed
    assert "parameters, K = 6, 1 steps on demo_wide (source noise)" in printed
