"""Test how releases are generated from tiny profiles: tasks, packaging, learned teammates and invalid folders."""

from __future__ import annotations

import json
import shutil
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
from icrl4aht_generation.collection import job
from icrl4aht_generation.collection import task_folder as artefacts
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task_folder import METADATA
from icrl4aht_generation.jobs.job import FailedJobsError
from icrl4aht_generation.learners.checkpoint import load_policy
from icrl4aht_generation.populations import select
from icrl4aht_generation.populations import train as suite
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases import build, labeller, measures, package
from icrl4aht_generation.releases.check import compare_rebuilds
from icrl4aht_generation.releases.labeller import CheckpointReturns
from icrl4aht_generation.teammates.registry import recover_teammate
from rich.console import Console

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.facts import LABEL_EPISODES
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import NearestTestTeammate
from icrl4aht_data.format.schema import Kind
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.writing.convert import to_release
from tests.helpers.commands import run_cli
from tests.helpers.damages import flip_bit
from tests.helpers.tiny import LEARNED, TINY, artefact


@pytest.mark.parametrize("kind", ["lite", "full"])
def test_generated_releases_pass_deep_verification(built, kind):
    report = verify_release(built / "a" / kind, level="deep")
    assert report.ok, report.findings
    assert (report.histories, report.transitions) == (3, 3 * 500)


def test_history_has_the_first_100_of_each_400_steps(built):
    history = load_icrl4aht(built / "a" / "lite")[0]
    assert (history.entry.T, history.entry.episodes) == (500, 5)
    assert np.flatnonzero(history.dones[:]).tolist() == [99, 199, 299, 399, 499]
    metrics = [json.loads(line) for line in (artefact(built / "a") / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in metrics] == [640 * (k + 1) for k in range(25)]


def test_release_keeps_the_histories_with_the_highest_scores_in_order(built):
    rewards = np.load(artefact(built / "a") / "rewards.npy")
    returns = rewards.reshape(8, 5, 100).sum(axis=-1)
    scores = 2 * returns.mean(axis=1) - returns.mean(axis=1)  # start and end of the curve are equal here
    kept = [entry.env_idx for entry in load_icrl4aht(built / "a" / "lite").entries]
    assert kept == np.argsort(-scores, kind="stable")[:3].tolist()


def test_checkpoints_of_a_learner_are_evenly_spaced(built):
    folder = artefact(built / "a")
    metadata = json.loads((folder / METADATA).read_text())
    assert metadata["checkpoint_updates"] == [5, 10, 15, 20, 25]
    kernels = []
    for number in range(5):
        _, params, card = load_policy(folder / f"checkpoints/c{number}")
        assert card["steps"] == metadata["checkpoint_updates"][number] * 640
        kernels.append(params["params"]["actor"]["kernel"])
    for one, other in pairwise(kernels):
        assert (one != other).any()


def test_damaged_artefacts_or_other_settings_make_a_task_unfinished(built, tmp_path):
    profile = load_profile(str(built / "tiny.toml"))
    (work,) = profile.units()
    folder = tmp_path / "copy"
    shutil.copytree(artefact(built / "a"), folder)
    assert artefacts.is_task_finished(folder, work, profile)
    (built / "other.toml").write_text(TINY.replace("rollout = 80", "rollout = 40"))
    assert not artefacts.is_task_finished(folder, work, load_profile(str(built / "other.toml")))
    for name in ("actions.npy", "checkpoints/c0/policy.json"):
        flip_bit(folder / name)
        assert not artefacts.is_task_finished(folder, work, profile)
        flip_bit(folder / name)
    (folder / METADATA).unlink()
    assert not artefacts.is_task_finished(folder, work, profile)


def rebuild(profile: Path, out: Path, *kinds: Kind) -> str:
    """Rebuild releases of the given kinds, by default lite, and return the printed text."""
    console = Console(file=StringIO())
    build.build_releases(load_profile(str(profile)), out, kinds or ("lite",), console)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_rebuild_in_folder_with_other_files_raises_error(built, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OptionError, match=r"has other files \(thesis.txt\), expected a rebuild"):
        rebuild(built / "tiny.toml", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_workers_know_the_generated_layouts_of_given_tasks(tmp_path, monkeypatch):
    queued: list[CollectionJob] = []

    def run_nothing(jobs: list[CollectionJob], *rest: object) -> None:
        queued.extend(jobs)
        raise FailedJobsError("no job was run")

    monkeypatch.setattr(build, "run_jobs", run_nothing)
    bundled = [
        load_icrl4aht(source="noise", layout="cramped_up"),
        *(load_icrl4aht(source="noise", layout_family=family) for family in ("templates", "rooms")),
    ]
    tasks = [one.tasks[one[0].entry.task_id] for one in bundled]
    with pytest.raises(FailedJobsError):
        build.build_releases(load_profile("noise"), tmp_path, ["lite"], Console(file=StringIO()), tasks=tasks)
    assert [layout.name for layout in queued[0].layouts] == [task.layout.name for task in tasks[1:]]


def test_rebuild_does_not_replace_release_of_another_profile(built, tmp_path, monkeypatch):
    def fail_if_called(*arguments):
        raise AssertionError("expected an error before any task is collected")

    monkeypatch.setattr(build, "run_jobs", fail_if_called)
    shutil.copytree(built / "a" / "lite", tmp_path / "lite")
    (tmp_path / "other.toml").write_text(TINY)
    with pytest.raises(
        OptionError, match="generated with tiny, not with profile other, and is not replaced; move it away"
    ):
        rebuild(tmp_path / "other.toml", tmp_path)
    assert verify_release(tmp_path / "lite").ok


def test_bundle_release_replaces_the_bundled_release(built, monkeypatch, tmp_path):
    monkeypatch.setattr(package, "MINI", tmp_path / "mini")
    for _ in range(2):
        package.bundle_release(built / "a" / "lite")
        assert verify_release(tmp_path / "mini").ok


@pytest.fixture(scope="module", autouse=True)
def quick_measurements():
    """Replace the slow measurements of learned teammates' distances and returns by fixed values."""
    measure_checkpoints = labeller._measure

    def measure_unless_learned(checkpoints, task, suite) -> CheckpointReturns:
        if task.teammate_family != "rl":
            return measure_checkpoints(checkpoints, task, suite)
        returns = [[float(number)] * LABEL_EPISODES for number, _ in enumerate(checkpoints)]
        return CheckpointReturns(returns, returns)

    def fixed_nearest(layout, policies) -> list[NearestTestTeammate]:
        return [NearestTestTeammate("H4/t0", 0.5, number) for number, _ in enumerate(policies)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(labeller, "_measure", measure_unless_learned)
        patch.setattr(measures, "nearest_test", fixed_nearest)
        yield


@pytest.fixture(scope="module")
def learned_rebuild(tmp_path_factory) -> Path:
    """Return generated releases with learned teammates, selected without a minimum return (read-only)."""
    profile = tmp_path_factory.mktemp("learned") / "learned.toml"
    out = profile.parent / "out"
    profile.write_text(LEARNED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(select, "THRESHOLD", -np.inf)
        patch.setattr(suite, "cross_play_returns", partial(suite.cross_play_returns, episodes=2))
        rebuild(profile, out, "lite", "full")
    return out


@pytest.mark.slow
def test_learned_teammates_of_a_release_reproduce_recorded_actions(learned_rebuild):
    """On the observations of a recorded episode, a teammate restored from the release takes the recorded actions."""
    dataset = load_icrl4aht(learned_rebuild / "lite")
    assert [task.teammate_kind for task in dataset.entries[::3]] == ["fcp", "brdiv"]
    assert {entry.teammate_family for entry in dataset.entries} == {"rl"}
    layout = get_layout("demo_wide")
    for history in (dataset[0], dataset[3]):
        mate = recover_teammate(dataset, history.entry.history_id)
        act = jax.jit(mate.act)
        obs = observe(layout, history.state[:100], TEAMMATE)
        memory, played = mate.init(mate.params, jax.random.key(0)), []
        for view in np.asarray(obs):
            action, memory = act(mate.params, memory, view, jax.random.key(0))
            played.append(int(action))
        assert played == history.teammate_actions[:100].tolist()


@pytest.mark.slow
def test_release_is_rebuilt_from_its_tasks_and_teammates(learned_rebuild, tmp_path):
    """The rebuild trains no populations and writes the same bytes as the first build."""
    profile = tmp_path / "learned.toml"
    profile.write_text(LEARNED)
    given = ("--tasks", learned_rebuild / "lite/meta/tasks.jsonl", "--suite", learned_rebuild / "lite/teammates")
    arguments = ["generate", "--profile", profile, "--out", tmp_path / "again", *given]
    run_cli(*[str(part) for part in arguments])
    assert not (tmp_path / "again/suite").exists()
    compared = compare_rebuilds(learned_rebuild / "lite", tmp_path / "again/lite")
    assert not compared.differences
    assert compared.files > 10


@pytest.mark.slow
def test_verify_reports_the_changed_file_of_a_teammate(learned_rebuild, tmp_path):
    root = tmp_path / "lite"
    shutil.copytree(learned_rebuild / "lite", root)
    assert verify_release(root, level="deep").ok
    assert verify_release(learned_rebuild / "full", level="deep").ok
    weights = next(root.glob("teammates/**/policy.safetensors"))
    flip_bit(weights)
    write_manifest(root)
    (finding,) = verify_release(root).findings
    assert finding.file == str(weights.relative_to(root))
    assert "the name of its folder" in finding.problem


@pytest.mark.slow
def test_verify_and_recover_report_missing_teammate_checkpoints(learned_rebuild, tmp_path):
    dataset = load_icrl4aht(learned_rebuild / "lite")
    root = to_release(dataset, tmp_path / "lite", "lite")
    shutil.rmtree(root / "teammates")
    write_manifest(root)
    report = verify_release(root)
    assert report.ok
    assert any("2 tasks have learned teammates whose checkpoints" in note for note in report.notes)
    with pytest.raises(OptionError, match=r"no checkpoint \w{64}, the teammate of history 0; copy the checkpoint"):
        recover_teammate(load_icrl4aht(root), 0)


@pytest.mark.slow
def test_repeated_rebuild_runs_no_job_again(learned_rebuild, monkeypatch):
    def fail_if_called(*arguments):
        raise AssertionError("a finished job was run again")

    monkeypatch.setattr(select, "THRESHOLD", -np.inf)
    monkeypatch.setattr(suite._PopulationTraining, "train", fail_if_called)
    monkeypatch.setitem(job._GENERATORS, "ppo", fail_if_called)
    (learned_rebuild / ".packing.lock").touch()  # as if the build had been killed while it packed the release
    assert rebuild(learned_rebuild.parent / "learned.toml", learned_rebuild).count("finished before") == 4


@pytest.mark.slow
def test_rebuild_fails_if_all_teammates_are_below_the_threshold(learned_rebuild, tmp_path):
    shutil.copytree(learned_rebuild / "suite", tmp_path / "suite")
    with pytest.raises(
        FailedJobsError, match=r"no checkpoint of fcp, brdiv exceeds the return of 20 .*raise teammates"
    ):
        rebuild(learned_rebuild.parent / "learned.toml", tmp_path)
    assert not (tmp_path / "lite").exists()
