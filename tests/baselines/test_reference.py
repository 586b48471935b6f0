"""Test reference models: training settings, the steps that make the models, and resumed commands."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
from icrl4aht_baselines import reference
from icrl4aht_baselines.agents import bundled
from icrl4aht_baselines.agents.bundled import EVERY_TRACK, MODELS, bundled_models
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method
from icrl4aht_baselines.reference import REFERENCE_SETTINGS, RL2_HISTORIES, ReferenceJob
from icrl4aht_baselines.report.results import EvaluationRun
from icrl4aht_baselines.training import trainer
from icrl4aht_baselines.training.histories import read_trained
from icrl4aht_baselines.training.options import HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import read_config
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.profiles.noise_config import NoiseConfig

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import ALL_TRACKS, TRACKS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks
from icrl4aht_data.errors import OptionError, UnknownNameError
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
        rate = {"learning_rate": reference.OWN_SHARE * settings.train["learning_rate"]} if settings.own_round else {}
        expected = {**settings.model, **settings.train, **rate, "method": settings.method}
        given = {**config["model"], **config["train"], "method": config["method"]}
        assert settings.play.items() <= config.get("play", {}).items()
        assert {key: given[key] for key in expected} == {
            key: list(value) if isinstance(value, tuple) else value for key, value in expected.items()
        }
        assert bundled_models()[name].sampled is not settings.greedy
        assert settings.histories.items() <= config["histories"].items()
    assert RL2_HISTORIES.end == (0.0, 0.0) and RL2_HISTORIES.finish[1] < 1


def test_reference_command_rejects_unknown_names(tmp_path):
    with pytest.raises(
        OptionError,
        match=r"rl2-reference does not learn from a teacher's histories.*ad-reference, dpt-reference",
    ):
        reference.check_learns_from_teacher("rl2-reference")
    command = ["research", "reference", "--name", "rl2-reference", "--out", str(tmp_path / "out"), "--teacher"]
    with pytest.raises(UnknownNameError, match="unknown agent 'rl2-referenc'"):
        run_cli(*command, "rl2-referenc")
    assert not (tmp_path / "out").exists()


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
            ("cramped_down", "asymm_right") if "ad-reference-layout-s3" in folder.parts else ("demo_wide", "test_wide")
        )
        run = evaluated_run("ad-reference", layouts[folder.name == "test-preference" :][:1])
        return dataclasses.replace(run, sources=(run.sources[0]._replace(trained=trained, folder=str(folder)),))

    monkeypatch.setattr(reference, "read_run", fake_run)
    for track in TRACKS:
        (tmp_path / "ad-x" / track).mkdir(parents=True)
    (tmp_path / "ad-x" / "layout" / "curves.png").write_bytes(b"")
    jobs = [ReferenceJob("ad-reference", track, 3, tmp_path, "rl2-reference") for track in TRACKS]
    card = reference.write_bundled_card("ad-x", jobs, tmp_path).read_text(encoding="utf-8")
    assert (
        "| made by | `icrl4aht-data research reference --name ad-reference --teacher rl2-reference --bundle-as ad-x` |"
        in card
    )
    assert "These histories were recorded for it, and are in no release.\n" in card
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


def test_histories_of_teachers_with_equal_folder_names_are_recorded_separately(tmp_path, monkeypatch):
    recorded: list[Path] = []
    monkeypatch.setattr(reference, "find_agent", lambda teacher, greedy: teacher)
    monkeypatch.setattr(ReferenceJob, "teammates", lambda job: ())
    monkeypatch.setattr(reference, "collect_release", lambda *options: recorded.append(options[-1]))
    teachers = ["rl2-reference", *(str(tmp_path / seed / "run") for seed in ("s0", "s1"))]
    for teacher in teachers[1:]:
        Path(teacher).mkdir(parents=True)
    found = [ReferenceJob("ad-reference", "layout", 0, tmp_path, teacher).teacher_histories() for teacher in teachers]
    assert found == recorded and len({*found}) == 3 and found[0].name == "agent-layout-rl2-reference"


@pytest.fixture
def tiny_training_settings(monkeypatch, tmp_path) -> Path:
    """Use tiny settings, one layout, few tasks, and a part of the bundled release as training data."""
    for name, settings in REFERENCE_SETTINGS.items():
        sizes: dict[str, Any] = {"steps": 1, "batch_size": 8} if settings.plays else TINY
        model = MODEL | {"recurrent_layers": 1, "dropout": 0.0} if settings.plays else MODEL
        monkeypatch.setitem(REFERENCE_SETTINGS, name, dataclasses.replace(settings, model=model, train=sizes))
    monkeypatch.setattr(reference, "RL2_HISTORIES", NoiseConfig(2, 10, start=(0.5, 0.5)))
    monkeypatch.setattr(reference, "OWN_HISTORIES", NoiseConfig(1, 10, start=(0.0, 0.0)))
    monkeypatch.setitem(reference.TRACK_PLAY, "layout", {"rearranged": 1})
    monkeypatch.setattr(reference, "TRACKS", {"layout": {"train": ("asymm_both",)}})
    monkeypatch.setattr(trainer, "can_draw", lambda: False)
    diverse = read_tasks(manifest_path("layout", "train", "diverse"))
    # Tasks of one family on one layout share compiled programs.
    few = [task for task in diverse if (task.layout.name, task.teammate_family) == ("asymm_both", "H1")]
    monkeypatch.setattr(reference, "read_tasks", lambda path: few[:1])
    histories = load_icrl4aht(layout="asymm_both", teammate_family="H1", source="noise")
    (tmp_path / "noise").mkdir()
    to_release(histories, tmp_path / "noise" / "lite", "lite")
    return tmp_path


@pytest.mark.slow
def test_reference_model_trains_on_rl2_histories_then_on_its_own_histories(tiny_training_settings):
    out = tiny_training_settings
    job = ReferenceJob("ad-reference", "layout", 0, out)
    seen: list[int] = []
    job.run(lambda step, speed: seen.append(step))
    assert seen[-1] == job.updates == 4 and job.is_finished()
    assert {path.name for path in out.iterdir() if path.is_dir() and not path.name.startswith(".")} == {
        "noise",
        "rl2-reference-layout-s0",
        "agent-layout",
        "ad-reference-layout-s0",
    }
    trained = read_trained(job.run_folder)
    assert trained.hide_recipe == ("asymm_both",) and trained.step == 2
    assert {cell["source"] for cell in trained.trained_on} == {"agent"}
    own, mixed = (load_icrl4aht(job.folder / name) for name in ("own", "mixed"))
    assert len(mixed) == len(own) + len(load_icrl4aht(out / "agent-layout"))
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    job.result_file.unlink()
    job.run()
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")} == times
