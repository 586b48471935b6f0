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
from tests.servers.http import http_server


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


def finish(job: ProofJob, late: float) -> ProofJob:
    """Write the result of a job, as if it had finished."""
    job.folder.mkdir(exist_ok=True)
    returns = block_returns(-2.0, late, -1.0, late / 2)
    job.result_file.write_text(json.dumps({"settings": job.settings, "minutes": 20.0, "returns": returns}))
    return job


def test_proof_has_an_entry_for_each_training_run_and_keeps_comparable_ones(release, tmp_path):
    options, path = small_options(release), tmp_path / "proof.json"
    blocks = {"1": 0.0, "6-20": 40.0}
    earned = {
        "preference": {"stay": blocks, "search": blocks},
        "teammate": {"stay": {"all": 0.0}, "rl2-reference": {"all": 20.0}},
    }

    def written(*jobs: ProofJob) -> list[dict[str, Any]]:
        write_proof(jobs, earned, path)
        return json.loads(path.read_text())["runs"]

    unfinished = ProofJob("all", "ad-expert", 2, options, tmp_path)
    first, second = (finish(ProofJob("all", "ad-expert", s, options, tmp_path), 10.0 * (s + 1)) for s in (0, 1))
    assert not unfinished.is_finished()
    (run,) = written(second, unfinished)
    assert run["histories_sha256"] == histories_hash(read_index(release), "all")
    assert run["share"] == 0.5  # the model earns 10, and rl2-reference earns 20
    assert [one["seed"] for one in written(first)] == [0, 1]
    own = finish(ProofJob("all", "ad", 0, options, tmp_path), 0.0)
    assert [(one["method"], one["labels"], one["seed"]) for one in written(own, first)] == [
        ("AD", "expert", 0),
        ("AD", "expert", 1),
        ("AD", "own", 0),
    ]
    spreads = ["-2.0 (-2.0..-2.0)", "15.0 (10.0..20.0)", "-1.0 (-1.0..-1.0)", "0.38 (0.25..0.50)"]
    assert " | ".join(["| all | AD | expert", *spreads]) in proof_table(json.loads(path.read_text()))

    content = json.loads(path.read_text())
    content["runs"][0]["settings_sha256"] = "0"
    path.write_text(json.dumps(content))
    assert len(written(own)) == 2, "an entry of other histories or settings is removed"
    changed = finish(replace(own, options=replace(options, steps=3)), 0.0)
    assert len(written(changed)) == 1, "the settings of the earlier runs differ"


def test_job_on_a_release_at_an_address_names_its_histories(release, tmp_path, monkeypatch):
    """Opening a remote release fetches its index only; the hash of its histories needs the tables of chunks, too."""
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    with http_server(release) as server:
        job = ProofJob("ppo", "dpt-expert", 0, replace(small_options(release), root=server.url), tmp_path)
        assert job.settings["histories_sha256"] == histories_hash(read_index(release), "ppo")
    assert job.queries == job.options.context + 1 == 21
    assert ProofJob("ppo", "ad", 0, job.options, tmp_path).queries == 1


def test_dataset_card_shows_only_results_of_models_trained_on_its_release(release, tmp_path, monkeypatch):
    run = dict.fromkeys(("first", "late", "late_cleared", "share", "minutes"), 1.0)
    run |= {"histories": "ppo", "method": "AD", "labels": "own", "seed": 0}
    run |= {"histories_sha256": histories_hash(read_index(release), "ppo")}
    content = {
        "training": {"steps": 800, "batch_size": 16, "context": 500},
        "tasks": {"preference": 48, "teammate": 20},
        "references": {"stay": {"6-20": 1.0}, "search": {"1": 2.0, "6-20": 40.0}},
        "runs": [run],
    }
    stored = tmp_path / "proof.json"
    monkeypatch.setattr(proof, "card_file", lambda name: stored)
    stored.write_text(json.dumps(content))
    assert read_proof(release) == content | {"trainings": [1]}
    card = render_card(card_facts(release))
    assert "## What models learn from it" in card and "minutes on one core: 1; runs of each row: 1" in card
    other = run | {"histories_sha256": "0"}
    stored.write_text(json.dumps(content | {"runs": [other, run]}))
    assert read_proof(release) == content | {"trainings": [1]}
    stored.write_text(json.dumps(content | {"runs": [other]}))
    assert read_proof(release) is None
    assert "## What models learn from it" not in render_card(card_facts(release))


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
