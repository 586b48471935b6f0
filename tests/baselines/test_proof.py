"""Test `research proof`, which trains models on a release: jobs, stored returns, and the table in the dataset card."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from icrl4aht_baselines import proof as training
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.proof import ProofJob, ProofOptions, run_references, write_proof

from icrl4aht_data.format.index import read_index
from icrl4aht_data.writing import proof
from icrl4aht_data.writing.card import card_facts, render_card
from icrl4aht_data.writing.proof import histories_hash, proof_table, read_proof
from tests.helpers.random_releases import random_release


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("proof") / "release"
    random_release(root, layouts=("demo_wide", "cramped_up"), teammates=1, streams=2, episodes=3, length=100)
    return root


def small_options(root: Path) -> ProofOptions:
    """Return options of tiny training runs on a release, with one validation task of each track."""
    tasks = {track: (bundled_tasks(track, "validation")[0],) for track in ("preference", "teammate")}
    return ProofOptions(str(root), steps=2, batch_size=2, context=20, tasks=tasks)


def block_returns(first: float, late: float, cleared: float, teammate: float) -> dict[str, Any]:
    blocks = {"preference": {"1": first, "6-20": late}, "preference cleared": {"1": first, "6-20": cleared}}
    return blocks | {"teammate": {"all": teammate}}


def content_of(job: ProofJob, late: float) -> dict[str, Any]:
    """Return the result of a finished job, for its file."""
    return {"settings": job.settings, "minutes": 20.0, "returns": block_returns(-2.0, late, -1.0, late / 2)}


def test_proof_table_has_mean_and_range_over_finished_training_runs(release, tmp_path):
    options = small_options(release)
    jobs = [ProofJob("all", "ad-expert", seed, options, tmp_path) for seed in (0, 1, 2)]
    for job, late in zip(jobs[:2], (10.0, 20.0), strict=True):  # the third job stays unfinished
        job.folder.mkdir()
        job.result_file.write_text(json.dumps(content_of(job, late)))
    assert [job.is_finished() for job in jobs] == [True, True, False]
    blocks = {"1": 0.0, "6-20": 40.0}
    earned = {
        "preference": {"stay": blocks, "search": blocks},
        "teammate": {"stay": {"all": 0.0}, "rl2-reference": {"all": 20.0}},
    }
    path = write_proof(jobs, earned, tmp_path / "proof.json")
    content = json.loads(path.read_text())
    assert content["models"][0]["histories_sha256"] == histories_hash(read_index(release), "all")
    assert content["models"][0]["share"] == [0.25, 0.5]  # the models earn 5 and 10, and rl2-reference earns 20
    other = ProofJob("all", "ad", 0, options, tmp_path)
    other.folder.mkdir()
    other.result_file.write_text(json.dumps(content_of(other, 0.0)))
    write_proof([other], earned, path)
    assert [one["learner"] for one in json.loads(path.read_text())["models"]] == [
        "AD, own actions",
        "AD, expert labels",
    ]
    changed = replace(other, options=replace(options, steps=3))
    changed.result_file.write_text(json.dumps(content_of(changed, 0.0)))
    write_proof([changed], earned, path)
    assert len(json.loads(path.read_text())["models"]) == 1, "the settings of the earlier models differ"
    spreads = ["-2.0 (-2.0 to -2.0)", "15.0 (10.0 to 20.0)", "-2.0 (-2.0 to -2.0)", "-1.0 (-1.0 to -1.0)"]
    spreads += ["0.38 (0.25 to 0.50)", "20.0 (20.0 to 20.0)"]
    assert " | ".join(["| all | AD, expert labels | 2", *spreads]) in proof_table(content)


def test_dataset_card_shows_only_results_of_models_trained_on_its_release(release, tmp_path, monkeypatch):
    model = {key: [1.0] for key in ("first", "late", "first_cleared", "late_cleared", "share", "minutes")}
    model |= {"histories": "ppo", "learner": "AD", "seeds": [0]}
    model |= {"histories_sha256": histories_hash(read_index(release), "ppo")}
    content = {
        "training": {"steps": 800, "batch_size": 16, "context": 500},
        "tasks": {"preference": 48, "teammate": 20},
        "references": {"stay": {"6-20": 1.0}, "search": {"1": 2.0, "6-20": 40.0}},
        "models": [model],
    }
    stored = tmp_path / "proof.json"
    monkeypatch.setattr(proof, "card_file", lambda name: stored)
    stored.write_text(json.dumps(content))
    assert read_proof(release) == content
    assert "## What it teaches" in render_card(card_facts(release))
    other = model | {"histories_sha256": "0"}
    stored.write_text(json.dumps(content | {"models": [other, model]}))
    assert read_proof(release) == content
    stored.write_text(json.dumps(content | {"models": [other]}))
    assert read_proof(release) is None
    assert "## What it teaches" not in render_card(card_facts(release))


@pytest.mark.slow
def test_proof_job_trains_and_evaluates_a_model_with_and_without_memory(release, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "PROOF_PROTOCOL", get_protocol("seeded", 6))
    monkeypatch.setattr(training, "COMPARED_EGOS", {"preference": ("stay",)})
    options = small_options(release)
    job = ProofJob("all", "dpt-expert", 0, options, tmp_path)
    steps: list[int] = []
    job.run(lambda done, speed: steps.append(done))
    assert steps == [1, 2] and job.is_finished()
    found = job.result()["returns"]
    assert {*found} == {"preference", "preference cleared", "teammate"}
    assert {"1", "2-5", "6-20", "all"} <= found["preference"].keys()
    assert job.finished_text().startswith("first episode ")
    before = job.result_file.stat().st_mtime_ns
    job.run()
    assert job.result_file.stat().st_mtime_ns == before
    stay = run_references(options, tmp_path)["preference"]["stay"]
    assert stay["1"] == stay["6-20"]  # an ego that never moves earns the same in all episodes
