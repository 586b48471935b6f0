"""Test the evaluation of trained models."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.training.histories import prepare, read_trained
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, format_versions, open_run
from icrl4aht_generation.learners.resume import Checkpoints
from icrl4aht_generation.teammates.instances import published_tasks

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.format.layouts_file import layout_family
from icrl4aht_data.overcooked import layouts
from tests.helpers.commands import run_cli
from tests.helpers.small_models import random_parameters

SHORT = dataclasses.replace(PROTOCOLS["seeded"], episodes=2, steps=10)
WIDE = [task for task in published_tasks("teammate") if (task.layout.name, task.teammate_family) == ("demo_wide", "H4")]
MODEL = ModelOptions(layers=1, width=16, heads=2, teammate_actions=True)
OPTIONS = TrainOptions(steps=2, batch_size=2, context=30)


@pytest.fixture(scope="module")
def runs(lite, tmp_path_factory) -> Path:
    """Return a folder with run folders `ad` and `dpt` of two models with random parameters."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("ad", "dpt"):
        write_run(folder / name, HistoryOptions(("demo_wide",), str(lite[0])))
    return folder


def write_run(folder: Path, histories: HistoryOptions) -> None:
    """Write a run folder of a model with random parameters; the folder has the name of the method."""
    job = prepare(folder.name, MODEL, OPTIONS, histories)
    config = {**format_versions(), "method": folder.name, **job.about, "train": dataclasses.asdict(OPTIONS)}
    open_run(folder, config)
    Checkpoints(folder / CHECKPOINTS).save({"params": random_parameters(job.method), "step": np.int32(2)}, 2)


def test_evaluation_of_a_trained_model_stores_settings_of_its_run(runs, tmp_path):
    agent = find_agent(runs / "dpt", acting="cached")
    assert agent.name == "DPT+TA"
    (result,) = evaluate(agent.name, agent.make, WIDE[:1], SHORT, details=agent.details, out=tmp_path)
    assert np.shape(result.returns) == (1, 2)
    run = read_trained(runs / "dpt")
    settings = {"run": run.hash, "step": 2, "context": 30, "encoder": "paper", "acting": "cached"}
    settings["trained_on"] = run.trained_on
    assert result.settings["details"] == settings
    with pytest.raises(OptionError, match=r"with other settings \(details.acting: found .*; details.step: found 2"):
        evaluate(agent.name, agent.make, WIDE[:1], SHORT, details={"step": 3}, out=tmp_path)


def test_run_on_generated_layouts_is_evaluated_without_its_release(tmp_path, monkeypatch):
    name = next(one.name for one in load_icrl4aht(source="noise").layouts if layout_family(one.name) == "templates")
    write_run(tmp_path / "ad", HistoryOptions((name,)))
    monkeypatch.setattr(layouts, "_RELEASE_LAYOUTS", {})  # as in a process that has not opened the release
    with pytest.raises(UnknownNameError):
        layouts.get_layout(name)
    agent = find_agent(tmp_path / "ad")
    assert agent.make(layouts.get_layout(name)).sees == "ego_input"


class TestInvalidRuns:
    def test_evaluation_on_layout_of_another_shape_raises_error(self, runs, tmp_path):
        arguments = ["evaluate", "--agent", str(runs / "ad"), "--layout", "coord_simple", "--out", str(tmp_path)]
        with pytest.raises(OptionError, match=r"trained on demo_wide with observations \(5, 5, 45\); coord_simple has"):
            run_cli(*arguments)

    def test_damaged_or_incompatible_run_raises_error(self, runs, tmp_path):
        def copied_run(name: str, **changes) -> str:
            shutil.copytree(runs / "ad", tmp_path / name)
            config = json.loads((tmp_path / name / "config.json").read_text())
            (tmp_path / name / "config.json").write_text(json.dumps(config | changes))
            return str(tmp_path / name)

        with pytest.raises(OptionError, match=r"run_format 99, but version \S+ .* reads run_format 4 only: .*--out\)$"):
            find_agent(copied_run("newer", run_format=99))
        with pytest.raises(OptionError, match=r"use this run with version 9\.9 of this package, which wrote it$"):
            find_agent(copied_run("newest", run_format=99, package_version="9.9"))
        wide = dataclasses.asdict(dataclasses.replace(MODEL, width=32))
        with pytest.raises(OptionError, match=r"not a state of this training: params/.*expected float32 .*, found"):
            find_agent(copied_run("wider", model=wide))
        with pytest.raises(
            OptionError, match=r"expected float32 .*, or use this run with version 9\.9 of this package"
        ):
            find_agent(copied_run("wider-old", model=wide, package_version="9.9"))
        with pytest.raises(OptionError, match="does not describe a run on learning histories: KeyError"):
            find_agent(copied_run("other", model={}, histories={}))
        with pytest.raises(
            OptionError, match=r"learning histories: TypeError\(.*'depth'.*, or use this run with version"
        ):
            find_agent(copied_run("option", model=dataclasses.asdict(MODEL) | {"depth": 3}, package_version="9.9"))
        with pytest.raises(OptionError, match=r"learning histories: UnknownNameError.*unknown method 'adx'"):
            find_agent(copied_run("method", method="adx"))
        shutil.rmtree(Path(copied_run("early")) / "checkpoints")
        with pytest.raises(OptionError, match="expected a checkpoint, found none; train until"):
            find_agent(str(tmp_path / "early"))
