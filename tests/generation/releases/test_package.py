"""Test how a release is packaged: selected histories, noise histories, labels, omitted tasks and measured teammates."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from icrl4aht_generation.collection.curate import oracle_labels
from icrl4aht_generation.collection.task_folder import HISTORY_ARRAYS, LABELLER_RETURNS, METADATA
from icrl4aht_generation.profiles import Profile, WorkUnit, load_profile
from icrl4aht_generation.releases import measures
from icrl4aht_generation.releases.measures import (
    TeammateFacts,
    few_spread_teammates,
    teammate_facts,
    unusable_families,
)
from icrl4aht_generation.releases.package import package_release, recorded_sources
from icrl4aht_generation.teammates import draws as draws_table
from icrl4aht_generation.teammates.draws import Draw, find_draw
from icrl4aht_generation.teammates.registry import heuristic_teammate, sample_teammate
from msgspec.structs import replace as replace_fields

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.facts import LABEL_EPISODES
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.provenance import NearestTestTeammate, ReferenceEgos, read_provenance
from icrl4aht_data.overcooked.layouts import LAYOUTS
from tests.helpers.commands import run_cli
from tests.helpers.tiny import artefact

MATTERS = TeammateFacts(ReferenceEgos(0.0, 1.0, 40.0, 20), NearestTestTeammate("H4/t0", 0.25, 3))
DOES_NOT = TeammateFacts(ReferenceEgos(40.0, 39.0, 40.0, 20), NearestTestTeammate("H4/t0", 0.25, 3))


@pytest.fixture
def profile(built) -> Profile:
    return replace(load_profile(str(built / "tiny.toml")), learners=2, keep=4)


def make_learner(built: Path, work: WorkUnit, artefacts: Path, improvements: Sequence[float], greedy: float) -> None:
    """Write the artefact of a learner with 8 histories of ten episodes; history k improves by `improvements[k]`.

    Histories beyond the end of `improvements` do not improve. Every checkpoint has the measured greedy return `greedy`.
    """
    folder = artefacts / work.name
    shutil.copytree(artefact(built / "a"), folder)
    arrays = {name: np.load(folder / f"{name}.npy") for name in HISTORY_ARRAYS}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", np.concatenate([array, array], axis=1))
    rewards = np.zeros((8, 10, 100), np.int8)
    rewards[: len(improvements), 5:, 0] = np.array(improvements)[:, None]
    np.save(folder / "rewards.npy", rewards.reshape(8, -1))
    measured = json.loads((folder / LABELLER_RETURNS).read_text())
    measured["measured"]["greedy"] = [[greedy] * LABEL_EPISODES] * 5
    (folder / LABELLER_RETURNS).write_text(json.dumps(measured))


def make_noise_task(built: Path, work: WorkUnit, artefacts: Path) -> None:
    """Write the artefact of a task with two noise histories."""
    source, folder = artefact(built / "a"), artefacts / work.name
    folder.mkdir(parents=True)
    for name in HISTORY_ARRAYS:
        np.save(folder / f"{name}.npy", np.load(source / f"{name}.npy")[:2])
    np.save(folder / "script_actions.npy", np.arange(1000).reshape(2, 500).astype(np.int8) % 6)
    metadata = json.loads((source / METADATA).read_text())
    for name in ("ego", "ego_hash", "checkpoint_updates"):
        del metadata[name]
    noise = {"histories": 2, "episodes": 5, "start": [1.0, 1.0], "end": [0.0, 0.0]}
    (folder / METADATA).write_text(json.dumps(metadata | {"noise": noise}))


def make_tasks(profile: Profile, count: int) -> list[Task]:
    (first,) = {work.task.task_id: work.task for work in profile.units()}.values()
    presets = ("default", "high_inertia")
    entries = [heuristic_teammate("utility_greedy", preset, number) for number, preset in enumerate(presets[:count])]
    return [first, *(make_task("teammate", "train", "demo_wide", entry, 7) for entry in entries[1:])]


def package_tasks(tmp_path: Path, profile: Profile, units: Sequence[WorkUnit], facts: dict[str, TeammateFacts]) -> Path:
    return package_release(tmp_path / "artefacts", tmp_path / "release", units, profile, tmp_path, "lite", facts)


@pytest.fixture
def two_learners(built, profile, tmp_path) -> list[WorkUnit]:
    """Return two learners of one task: 3 histories of the first and 1 history of the second improve by 5 or more."""
    (task,) = make_tasks(profile, 1)
    units = [WorkUnit(task, "ppo", learner) for learner in range(2)]
    make_learner(built, units[0], tmp_path / "artefacts", [10, 4, 20, 15], 5.0)
    make_learner(built, units[1], tmp_path / "artefacts", [3, 25], 7.0)
    return units


def test_improving_histories_of_both_learners_are_kept(two_learners, profile, tmp_path):
    task_id = two_learners[0].task.task_id
    strict = replace(profile, least_improvement=5.0, oracle_actions=True)
    root = package_tasks(tmp_path, strict, two_learners, {task_id: MATTERS})
    dataset = load_icrl4aht(root)
    kept = [(entry.learner, entry.env_idx, entry.return_end - entry.return_start) for entry in dataset.entries]
    assert kept == [(0, 2, 20), (0, 3, 15), (0, 0, 10), (1, 1, 25)]
    made = read_provenance(root / "meta/provenance.json")[task_id]
    assert (made.source, made.learners, made.streams_recorded, made.streams_kept) == ("ppo", 2, 16, 4)
    assert (made.references, made.nearest_test) == (MATTERS.references, MATTERS.nearest)
    assert made.filter is not None
    assert made.filter.least_improvement == 5.0
    assert made.filter.before.return_end == pytest.approx((10 + 4 + 20 + 15 + 3 + 25) / 16, abs=1e-3)
    assert made.expert is not None
    assert made.expert.return_greedy == 7.0  # labels come from a checkpoint of the better learner
    for history in dataset:
        wanted = oracle_labels(LAYOUTS["demo_wide"], history.state[:], history.actions[:].astype(np.int8))
        assert history.entry.has_oracle_actions
        np.testing.assert_array_equal(history.read("oracle_actions"), wanted)
    card = (root / "README.md").read_text()
    assert "2 independent learners a task" in card
    assert "on demo_wide: of 16 streams of a task the 4 with the highest final return + improvement" in card
    assert "if the return rises by 5 or more, divided equally" in card
    assert "![Learning curves](figures/learning_curves.png)" in card
    assert "figures/learning_curves.png" in read_manifest(root)
    assert (root / "figures/learning_curves.png").stat().st_size < 100_000
    assert verify_release(root).findings == []


def test_oracle_labels_are_omitted_if_the_oracle_earns_less_than_learners(two_learners, profile, tmp_path):
    task_id, references = two_learners[0].task.task_id, MATTERS.references
    assert references is not None
    facts = MATTERS._replace(references=replace_fields(references, oracle=-1000.0))
    dataset = load_icrl4aht(
        package_tasks(tmp_path, replace(profile, oracle_actions=True), two_learners, {task_id: facts})
    )
    assert dataset.counts("label_view") == {"ego": len(dataset)}
    assert not dataset.has_labels("oracle").any()


def test_minimum_improvement_is_not_required_without_headroom(two_learners, profile, tmp_path):
    task_id = two_learners[0].task.task_id
    root = package_tasks(tmp_path, replace(profile, least_improvement=50.0), two_learners, {task_id: DOES_NOT})
    kept = [(entry.learner, entry.env_idx) for entry in load_icrl4aht(root).entries]
    assert kept == [(0, 2), (0, 3), (1, 1), (1, 0)]
    assert not any(entry.has_oracle_actions for entry in load_icrl4aht(root).entries)
    assert "No headroom on demo_wide:" in (root / "README.md").read_text()


def test_tasks_without_improving_histories_or_headroom_are_left_out(built, two_learners, profile, tmp_path):
    flat = make_tasks(profile, 2)[1]
    units = [*two_learners, *(WorkUnit(flat, "ppo", learner) for learner in range(2))]
    for work in units[2:]:
        make_learner(built, work, tmp_path / "artefacts", [4, 4], 0.0)
    strict = replace(profile, least_improvement=5.0)
    facts = {two_learners[0].task.task_id: MATTERS, flat.task_id: MATTERS}
    root = package_tasks(tmp_path, strict, units, facts)
    (left_out,) = read_info(root).left_out
    assert (left_out.task_id, left_out.teammate, left_out.source) == (flat.task_id, "H4/t1", "ppo")
    assert (left_out.learners, left_out.streams, left_out.return_start, left_out.return_end) == (2, 16, 0, 1)
    assert "no stream's return rises by 5" in left_out.reason
    assert {entry.task_id for entry in load_icrl4aht(root).entries} == {two_learners[0].task.task_id}
    assert verify_release(root).findings == []
    (left_out,) = read_info(package_tasks(tmp_path, strict, units, facts | {flat.task_id: DOES_NOT})).left_out
    assert "no headroom: returns of these egos differ" in left_out.reason
    with pytest.raises(OptionError, match="no task has histories to keep: the learners did not learn"):
        package_tasks(tmp_path, strict, units[2:], facts)


def test_tasks_with_little_mean_improvement_are_left_out(built, two_learners, profile, tmp_path):
    """The kept histories of the first task improve by 17.5 on average, and those of the second task by 5.5."""
    flat = make_tasks(profile, 2)[1]
    make_learner(built, work := WorkUnit(flat, "ppo"), tmp_path / "artefacts", [4, 6, 3, 5], 5.0)
    units, task_id = [*two_learners, work], two_learners[0].task.task_id
    rising = replace(profile, least_improvement=5.0, least_rise=17.0)
    root = package_tasks(tmp_path, rising, units, {task_id: MATTERS, flat.task_id: MATTERS})
    (left_out,) = read_info(root).left_out
    assert (left_out.task_id, left_out.streams) == (flat.task_id, 8)
    assert left_out.reason == "its histories rise by 5.5 on average, expected 17"
    assert {entry.task_id for entry in load_icrl4aht(root).entries} == {task_id}
    with pytest.raises(OptionError, match=r"rise by 17\.5 on average, expected 17\.6"):
        package_tasks(tmp_path, replace(rising, least_rise=17.6), two_learners, {task_id: MATTERS})
    exempt = package_tasks(tmp_path, replace(rising, least_rise=50.0), two_learners, {task_id: DOES_NOT})
    assert read_info(exempt).left_out == []


def test_noise_histories_are_labelled_by_their_scripted_ego(built, profile, tmp_path):
    (task,) = make_tasks(profile, 1)
    work = WorkUnit(task, "noise")
    make_noise_task(built, work, tmp_path / "artefacts")
    both = replace(profile, sources=("noise",), oracle_actions=True, least_improvement=5.0)
    root = package_tasks(tmp_path, both, [work], {task.task_id: MATTERS})
    dataset = load_icrl4aht(root)
    assert [(entry.source, entry.learner, entry.env_idx) for entry in dataset.entries] == [
        ("noise", 0, 0),
        ("noise", 0, 1),
    ]
    for number, history in enumerate(dataset):
        wanted = np.arange(500 * number, 500 * (number + 1)).astype(np.int8) % 6
        np.testing.assert_array_equal(history.expert_actions[:], wanted)
        np.testing.assert_array_equal(history.read("oracle_actions"), wanted)
        assert (history.entry.expert_return, history.entry.expert_step) == (40.0, None)
    made = read_provenance(root / "meta/provenance.json")[task.task_id]
    assert (made.source, made.learners, made.ego, made.filter) == ("noise", None, None, None)
    assert made.noise is not None
    assert made.noise["histories"] == 2
    assert made.expert is not None
    assert made.expert.policy_sha256 is None
    assert verify_release(root).findings == []
    assert recorded_sources(root) == {task.task_id: "noise"}
    assert recorded_sources(tmp_path) == {}
    arguments = ["--profile", built / "tiny.toml", "--tasks", root / "meta/tasks.jsonl", "--out", tmp_path / "out"]
    with pytest.raises(OptionError, match=f"task {task.task_id}: the source is noise, but profile tiny only has ppo"):
        run_cli("generate", *arguments)
    without = package_tasks(tmp_path, replace(both, oracle_actions=False), [work], {task.task_id: MATTERS})
    assert not any(entry.has_oracle_actions for entry in load_icrl4aht(without).entries)


def fake_draws(layout: str, family: str, base_seed: int = 0) -> list[Draw]:
    distance = 0.01 if family == "utility_greedy" else 0.3
    return [Draw(layout, family, base_seed, k, "H3/t1", distance, k, 0.0, 1.0, 30.0) for k in range(2)]


def test_drawn_teammates_use_stored_measurements_and_other_teammates_are_measured_once(tmp_path, monkeypatch):
    key = ("demo_wide", "assembly_line", 0)
    monkeypatch.setattr(draws_table, "_bundled_draws", lambda: {key: fake_draws(*key)})
    entry = sample_teammate("assembly_line", 1, "train")
    drawn = make_task("teammate", "train", "demo_wide", entry, 0)
    other = make_task("teammate", "train", "demo_wide", entry | {"theta": dict(entry["theta"], x=1)}, 1)
    assert find_draw("demo_wide", entry) == fake_draws("demo_wide", "assembly_line")[1]
    assert find_draw("demo_wide", other.teammate) is None
    calls = []

    def measure(tasks, *arguments):
        calls.append([task.task_id for task in tasks])
        return [DOES_NOT for _ in tasks]

    monkeypatch.setattr(measures, "_measure", measure)
    for _ in range(2):  # the second call reads the stored file
        facts = teammate_facts([drawn, other], tmp_path, tmp_path)
        assert facts[drawn.task_id] == TeammateFacts(
            ReferenceEgos(0.0, 1.0, 30.0, 20), NearestTestTeammate("H3/t1", 0.3, 1)
        )
        assert facts[other.task_id] == DOES_NOT
    assert calls == [[other.task_id]]


def test_nearest_test_teammate_can_be_of_another_family(monkeypatch):
    key = ("demo_wide", "assembly_line", 0)
    first, second = fake_draws(*key)
    near = replace_fields(first, other="H1/t0", other_distance=0.006)
    draws = [near, replace_fields(second, behaviour=0, other_distance=0.4)]
    monkeypatch.setattr(draws_table, "_bundled_draws", lambda: {key: draws})
    entries = [sample_teammate("assembly_line", theta_id, "train") for theta_id in range(2)]
    tasks = [make_task("teammate", "train", "demo_wide", entry, 0) for entry in entries]
    facts = teammate_facts(tasks, Path("no artefacts"), Path("no suite"))
    nearest = [facts[task.task_id].nearest for task in tasks]
    assert nearest == [NearestTestTeammate("H1/t0", 0.006, 0), NearestTestTeammate("H3/t1", 0.3, 0)]


def test_families_without_usable_draws_are_reported_with_the_reason(monkeypatch):
    monkeypatch.setattr(draws_table, "read_draws", fake_draws)
    monkeypatch.setattr(
        measures, "usable_families", lambda layout: ["recipe_aware_button", "territory", "assembly_line"]
    )
    (found,) = unusable_families(["demo_wide", "cramped_down"])
    assert (found.layout, found.teammate, found.source) == ("demo_wide", "H4", "")
    assert found.reason == "all 2 draws act like a test teammate of the family (distance 0.010 at most)"


def test_layouts_with_fewer_spread_teammates_are_listed_with_the_reason():
    """On coord_simple no teammate has headroom, which the card says of the layout."""
    assert few_spread_teammates({"coord_simple": 2, "test_wide": 2}) == []
    (found,) = few_spread_teammates({"coord_simple": 2, "coord_ring": 2, "test_wide": 24})
    assert (found.layout, found.teammate) == ("coord_ring", "spread")
    assert found.reason == "156 of 247 candidates act unlike test teammates, 3 of these have headroom"


@pytest.mark.slow
def test_reference_returns_with_a_preset_teammate_are_measured(tmp_path):
    task = make_task("teammate", "train", "demo_wide", heuristic_teammate("utility_greedy", "default", 0), 0)
    facts = teammate_facts([task], tmp_path, tmp_path)[task.task_id]
    assert facts.references.returns_differ
    assert facts.references.stay == 0 < facts.references.oracle
    assert facts.nearest is None
