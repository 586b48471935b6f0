"""Test additions of format version 4: oracle actions, independent learners, sources, tasks left out of a release."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import IndexFormatError, LabelsMissingError, OptionError
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import LeftOutTask, read_info
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, read_provenance
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, PROVENANCE
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import from_published, to_published
from icrl4aht_data.writing.release_folder import HISTORIES_INDEX
from tests.helpers.random_releases import SHARD, one_history_release, random_release
from tests.helpers.tampered import first_value, problems, read_lines, tampered_copy

SCRIPT = ExpertLabels(None, "the oracle's", return_greedy=40.0, episodes=200)
SOURCES = ("noise", "ppo", "ppo", "noise")
OPTIONS: dict[str, Any] = {"streams": 2, "episodes": 5, "oracle": True, "learners": 2}


@pytest.fixture(scope="module", params=KINDS)
def mixed_release(request, tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Return a release with PPO and noise histories, two learners and oracle actions (read-only).

    Tests run once for each kind of release.
    """
    root = tmp_path_factory.mktemp("mixed") / request.param
    experts = [SCRIPT, None, None, SCRIPT]
    return root, random_release(root, request.param, experts=experts, sources=SOURCES, **OPTIONS)


@pytest.fixture(scope="module")
def lite_release(tmp_path_factory) -> Path:
    """Return a small lite release with a noise task, a task of two PPO learners, and all provenance fields."""
    root = tmp_path_factory.mktemp("mixed") / "lite"
    random_release(root, "lite", ("coord_simple",), experts=[SCRIPT, None], sources=SOURCES[:2], **OPTIONS)

    def add_optional_fields(content: dict[str, Any]) -> None:
        noise, ppo = content.values()
        noise["noise"] = {"histories": 2, "episodes": 5, "start": [0.9, 1.0], "end": [0, 0.1], "power": [0.5, 2.0]}
        ppo["ego"] = {"total_steps": 100, "environments": 2}
        for one in (noise, ppo):
            one["references"] = {"stay": 0.0, "random": -1.5, "oracle": 45.0, "episodes": 20}
            one["nearest_test"] = {"teammate": "H3/t1", "distance": 0.25}
        noise["nearest_test"]["behaviour"] = 3

    return tampered_copy(root, root.with_name("complete"), PROVENANCE, add_optional_fields)


def test_oracle_actions_learners_and_sources_round_trip(mixed_release):
    root, written = mixed_release
    dataset = load_icrl4aht(root)
    for history in dataset:
        found = history.read("oracle_actions")
        assert found.dtype == np.int32
        np.testing.assert_array_equal(found, written[history.entry.history_id]["oracle_actions"])
        np.testing.assert_array_equal(history.read("oracle_actions", 33, 71), found[33:71])
    shard = Shards(dataset.origin, dataset.index).open(SHARD)
    with h5py.File(shard.path) as file:
        entry = dataset.entries[0]
        stored: Any = file[f"{entry.h5_group}/oracle_actions"]
        assert stored.dtype == (np.int8 if dataset.info.kind == "lite" else np.int32)
    assert dataset.column("learner").tolist() == [0, 0, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0]
    assert dataset.column("source").tolist() == ["noise"] * 2 + ["ppo"] * 8 + ["noise"] * 2
    assert dataset.column("has_oracle_actions").all()
    assert dataset.filter(source="noise").ids.tolist() == [0, 1, 10, 11]


def test_deep_verification_lists_unchecked_values(mixed_release, lite_release):
    report = verify_release(mixed_release[0], level="deep")
    assert report.ok, report.findings
    (note,) = report.notes
    assert note.startswith("oracle actions of 12 histories: only their range was checked")
    assert verify_release(mixed_release[0]).notes == []
    report = verify_release(lite_release, level="deep")
    assert report.ok, report.findings
    assert [note.split(":")[0] for note in report.notes] == [
        "oracle actions of 6 histories",
        "returns of reference egos, of 2 tasks",
        "nearest test teammates, of 2 tasks",
        "noise schedules, of 1 tasks",
    ]


def test_published_files_omit_oracle_actions_and_learner_numbers(lite_release, tmp_path):
    """Published files contain no oracle actions and no learner numbers.

    `env_idx` numbers the environments of all learners of a task consecutively.
    """
    before = load_icrl4aht(lite_release)
    to_published(before, tmp_path / "files")
    with h5py.File(tmp_path / "files" / "histories.h5") as file:
        assert all("oracle_actions" not in group and "expert_actions" in group for group in file.values())
    assert [line["env_idx"] for line in read_lines(tmp_path / "files" / HISTORIES_INDEX)] == [0, 1, 0, 1, 2, 3]
    from_published(tmp_path / "files", tmp_path / "back", data_version="0.0.1", kept_steps=20)
    assert verify_release(tmp_path / "back", level="deep").ok
    after = load_icrl4aht(tmp_path / "back")
    expected = [entry.to_json() | {"has_oracle_actions": False} for entry in before.entries]
    assert [entry.to_json() for entry in after.entries] == expected
    assert read_provenance(tmp_path / "back" / PROVENANCE) == read_provenance(lite_release / PROVENANCE)
    with pytest.raises(LabelsMissingError, match=r"has no oracle actions: .* has_oracle_actions = false"):
        after[2].read("oracle_actions")
    np.testing.assert_array_equal(after[0].read("oracle_actions"), before[0].read("oracle_actions"))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (HISTORIES, lambda c: c[5].update(learner=2), "history 5: learner: expected less than the 2 learners, found 2"),
        (HISTORIES, lambda c: c[4].update(learner=0), "history 4: stream 0 of its task appears twice"),
        (HISTORIES, lambda c: c[5].update(env_idx=2), "5: env_idx: expected less than the 2 environments"),
        (HISTORIES, lambda c: c[0].update(has_oracle_actions=False), "the index implies"),
        (PROVENANCE, lambda c: first_value(c)["noise"].update(episodes=6), "noise.episodes: expected the 5 of history"),
        (
            PROVENANCE,
            lambda c: first_value(c)["noise"].update(end=[0.2, 0.1]),
            "noise.end: expected a range [least, most]",
        ),
        (PROVENANCE, lambda c: first_value(c)["nearest_test"].update(teammate="\x1b[2J"), "printable characters"),
        (
            PROVENANCE,
            lambda c: first_value(c)["expert"].update(policy_sha256="0" * 64),
            "the script labels noise histories",
        ),
    ],
)
def test_verify_finds_wrong_index_lines_and_provenance(lite_release, tmp_path, name, change, message):
    found = "\n".join(problems(tampered_copy(lite_release, tmp_path / "release", name, change), "deep"))
    assert message in found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: {"oracle_actions": a["oracle_actions"] + 3}, "oracle_actions: expected 0..5, found 3.."),
        (lambda a: {"expert_actions": (a["oracle_actions"] + 1) % 6}, "differ from the script's, oracle_actions"),
    ],
)
def test_verify_finds_false_oracle_and_expert_actions(tmp_path, change, message):
    def change_labels(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        labelled = arrays | {"oracle_actions": arrays["expert_actions"]}
        return labelled | change(labelled)

    root = one_history_release(tmp_path / "r", change_labels, provenance=Provenance(source="noise"))
    assert message in "\n".join(problems(root))


def test_a_learner_number_out_of_range_is_rejected(tmp_path):
    with pytest.raises(OptionError, match="learner: expected 0 to 1, since provenance has 2 learners, found 2"):
        one_history_release(tmp_path / "r", provenance=Provenance(learners=2), learner=2)
    assert not (tmp_path / "r").exists()


LEFT_OUT = LeftOutTask("task_x", "demo_wide", "H3/t12", "ppo", 2, 32, 0.1, 0.4, "the learners did not learn")


def set_left_out(root: Path, *tasks: LeftOutTask) -> Path:
    info = replace(read_info(root), left_out=list(tasks))
    (root / INFO).write_text(json.dumps(info.to_json()))
    write_manifest(root)
    return root


def test_conversions_keep_left_out_tasks(lite_release, tmp_path):
    other = replace(LEFT_OUT, layout="coord_simple", learners=0, streams=0, return_start=None, return_end=None)
    root = set_left_out(shutil.copytree(lite_release, tmp_path / "a"), LEFT_OUT, other)
    assert verify_release(root, level="deep").ok
    assert load_icrl4aht(root).info.left_out == [LEFT_OUT, other]
    to_release(load_icrl4aht(root), tmp_path / "out", "full")  # the copy only lists tasks on its own layout
    assert read_info(tmp_path / "out").left_out == [other]
    random_release(tmp_path / "b", layouts=("demo_wide",), teammates=1, streams=1)
    made = load_icrl4aht(tmp_path / "b").entries[0].task_id
    set_left_out(tmp_path / "b", other)
    set_left_out(root, LEFT_OUT, other, replace(LEFT_OUT, task_id=made))
    combine_releases(tmp_path / "both", [root, tmp_path / "b"])
    # `other` is listed once as left out, and `made` is not listed, because the second release has its histories
    assert read_info(tmp_path / "both").left_out == [LEFT_OUT, other]
    assert verify_release(tmp_path / "both").ok


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": "nowhere"}, "layout 'nowhere' is neither in the benchmark nor in"),
        ({"reason": "\x1b[2J"}, "printable characters"),
    ],
)
def test_invalid_left_out_tasks_are_refused(lite_release, tmp_path, change, message):
    root = set_left_out(shutil.copytree(lite_release, tmp_path / "r"), replace(LEFT_OUT, **change))
    with pytest.raises(IndexFormatError, match=message):
        read_index(root)


def test_verify_finds_histories_of_a_left_out_task(lite_release, tmp_path):
    task_id = load_icrl4aht(lite_release).entries[0].task_id
    root = set_left_out(shutil.copytree(lite_release, tmp_path / "r"), replace(LEFT_OUT, task_id=task_id))
    assert f"left_out: task '{task_id}' has histories in the index" in "\n".join(problems(root))
