"""Test reference models: training settings, the steps that make the models, and resumed commands."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from icrl4aht_baselines import reference
from icrl4aht_baselines.agents import bundled
from icrl4aht_baselines.agents.bundled import EVERY_TRACK, MODELS
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method
from icrl4aht_baselines.reference import REFERENCE_SETTINGS, ReferenceJob
from icrl4aht_baselines.report.results import EvaluationRun
from icrl4aht_baselines.training import trainer
from icrl4aht_baselines.training.histories import read_trained
from icrl4aht_baselines.training.options import HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import read_config
from icrl4aht_generation.jobs.job import OnUpdate

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import ALL_TRACKS, TRACKS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks
from icrl4aht_data.writing.convert import to_release
from tests.helpers.commands import run_cli
from tests.helpers.evaluated import evaluated_run

TINY = {"steps": 2, "batch_size": 2, "context": 20}
MODEL = {"layers": 1, "width": 8, "heads": 2, "encoder": "mlp", "teammate_actions": True}


def test_recipes_match_the_settings_of_the_bundled_models():
    """The settings are valid and equal the settings stored with its bundled model."""
    for name, settings in REFERENCE_SETTINGS.items():
        get_method(settings.method)
        ModelOptions(**settings.model)
        TrainOptions(**settings.train)
        PlayOptions(**settings.play)
        for view in reference.TRACK_VIEWS.values():
            HistoryOptions(("demo_wide",), **settings.histories, **view)
        config = read_config(MODELS / name / settings.tracks[-1])
        expected = {**settings.model, **settings.train, "method": settings.method}
        given = {**config["model"], **config["train"], "method": config["method"]}
        assert settings.play.items() <= config.get("play", {}).items()
        assert {key: given[key] for key in expected} == {
            key: list(value) if isinstance(value, tuple) else value for key, value in expected.items()
        }
        wanted = {**settings.histories, "source": list(settings.histories.get("source", ()))}
        assert settings.plays or wanted.items() <= config["histories"].items()


def test_reference_model_is_bundled_with_all_tracks(tmp_path, monkeypatch):
    copied, cards = [], []

    def skip_training(job: ReferenceJob, on_update: OnUpdate) -> dict[str, Any]:
        job.folder.mkdir()
        return {}

    monkeypatch.setattr(ReferenceJob, "measure", skip_training)
    monkeypatch.setattr(ReferenceJob, "evaluate", lambda job, show: None)
    monkeypatch.setattr(bundled, "bundle_run", lambda run, name, track, **way: copied.append((name, track)))
    monkeypatch.setattr(reference, "write_bundled_card", lambda name, found, **way: cards.append(found))
    command = ["research", "reference", "--name", "rl2-reference", "--out", tmp_path, "--bundle-as", "rl2-reference"]
    run_cli(*command, "--track", "layout", "--track", "teammate")
    assert copied == [("rl2-reference", "teammate"), ("rl2-reference", "layout")]
    assert [job.track for job in cards[0]] == ["teammate", "layout"]
    printed = run_cli(*command, "--track", "layout", code=2)
    assert "expected one --name, all tracks, one seed" in " ".join(printed.split())


def test_card_of_a_reference_model_shows_command_and_training_curves(tmp_path, monkeypatch):
    histories = {"root": "x", "layouts": ["demo_wide"], "data_version": "1.0.0", "sizes": {"train": 3}}
    config = {"method": "ad", "model": {}, "train": {"seed": 3}, "package_version": "0", "histories": histories}
    trained = {"config": config, "manifest_sha256": "ab12", "run_hash": "1"}

    def fake_run(folder: Path) -> EvaluationRun:
        layouts = (
            ("cramped_down", "asymm_right") if "rl2-reference-layout-s3" in folder.parts else ("demo_wide", "test_wide")
        )
        run = evaluated_run("rl2-reference", layouts[folder.name == "test-preference" :][:1])
        return dataclasses.replace(run, sources=(run.sources[0]._replace(trained=trained, folder=str(folder)),))

    monkeypatch.setattr(reference, "read_run", fake_run)
    for track in TRACKS:
        (tmp_path / "ad-x" / track).mkdir(parents=True)
    (tmp_path / "ad-x" / "layout" / "curves.png").write_bytes(b"")
    jobs = [ReferenceJob("rl2-reference", track, 3, tmp_path) for track in TRACKS]
    card = reference.write_bundled_card("ad-x", jobs, tmp_path).read_text(encoding="utf-8")
    assert "| made by | `icrl4aht-data research reference --name rl2-reference --bundle-as ad-x` |" in card
    shown = re.findall(r"!\[\w+\]\((.+)\)", card.split("## Curves")[1].split("## Limits")[0])
    assert shown == ["layout/curves.png"]


def test_model_of_all_tracks_is_evaluated_on_all_tracks(tmp_path):
    job = ReferenceJob("rl2-adapting", EVERY_TRACK, 0, tmp_path)
    tests = [task for kind in ("test-seeded", "test-preference") for task in job.evaluation_tasks(kind)]
    assert {task.track for task in tests} == {*ALL_TRACKS}
    assert {task.track for task in job.evaluation_tasks("diverse")} == {*TRACKS}
    own = [ReferenceJob("x", track, 0, tmp_path) for track in TRACKS]
    assert {task.track for task in own[1].evaluation_tasks("test-seeded")} == {"layout"}
    hidden = [task for one in own for task in one.evaluation_tasks("test-preference")]
    assert len({task.task_id for task in hidden}) == len(hidden) == 120, "each is played by one model"


@pytest.fixture
def tiny_training_settings(monkeypatch, tmp_path) -> Path:
    """Use tiny settings, few tasks, one layout of track `layout`, and parts of the bundled release as profiles."""
    for name, settings in REFERENCE_SETTINGS.items():
        sizes: dict[str, Any] = {"steps": 1, "batch_size": 8} if settings.plays else TINY
        model = MODEL | {"recurrent_layers": 1, "dropout": 0.0} if settings.plays else MODEL
        monkeypatch.setitem(REFERENCE_SETTINGS, name, dataclasses.replace(settings, model=model, train=sizes))
    monkeypatch.setitem(reference.TRACK_PLAY, "layout", {"rearranged": 1})
    monkeypatch.setattr(reference, "TRACKS", {"layout": {"train": ("asymm_both",)}})
    monkeypatch.setattr(trainer, "can_draw", lambda: False)
    diverse = read_tasks(manifest_path("layout", "train", "diverse"))
    # Tasks of one family on one layout share compiled programs.
    few = [task for task in diverse if (task.layout.name, task.teammate_family) == ("asymm_both", "H1")]
    monkeypatch.setattr(reference, "read_tasks", lambda path: few[:1])
    noise = load_icrl4aht(layout="asymm_both", teammate_family="H1", source="noise")
    search = load_icrl4aht(layout="templates-0-46", source="search")
    for profile, histories in (("noise", noise), ("teach", search)):
        (tmp_path / profile).mkdir()
        to_release(histories, tmp_path / profile / "lite", "lite")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(("name", "track"), [("rl2-reference", "layout"), ("ad-reference", EVERY_TRACK)])
def test_reference_model_trains_on_a_generated_release(name, track, tiny_training_settings):
    out = tiny_training_settings
    job = ReferenceJob(name, track, 0, out)
    seen: list[int] = []
    job.run(lambda step, speed: seen.append(step))
    assert seen[-1] == job.updates and job.is_finished()
    trained = read_trained(job.run_folder)
    assert trained.step == job.updates and trained.hide_recipe == (("asymm_both",) if track == "layout" else ())
    if not job.reference.plays:
        assert {cell["source"] for cell in trained.trained_on} == {"agent", "search"}
        sources = load_icrl4aht(out / "bundled-teach").column("source").tolist()
        counts = {"agent": len(load_icrl4aht(source="agent")), "search": len(load_icrl4aht(out / "teach" / "lite"))}
        assert Counter(sources) == counts
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    job.result_file.unlink()
    job.run()
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == times
