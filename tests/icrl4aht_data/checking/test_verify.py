"""Test that `verify_release` finds every fault in any file of a release."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys

import h5py
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import ExpertLabels, Provenance
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST
from icrl4aht_data.writing import release
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.shard_writer import metadata_rows
from tests.helpers.commands import run_cli
from tests.helpers.damages import flip_bit
from tests.helpers.random_releases import SHARD, make_tasks, one_history_release, random_history, random_release
from tests.helpers.tampered import problems, tamper


def test_deep_verification_accepts_a_valid_release(lite_or_full):
    report = verify_release(lite_or_full[0], level="deep")
    assert report.ok
    assert (report.histories, report.transitions) == (12, 1440)
    assert report.files == 9
    assert report.chunks >= 84


@pytest.mark.parametrize(
    ("release", "flips"), [("tiny", 40), ("observations", 20), pytest.param("tiny", 250, marks=pytest.mark.slow)]
)
def test_verify_finds_every_flipped_bit(converted_release, tmp_path, release, flips):
    root = tmp_path / "release"
    if release == "tiny":
        random_release(root, layouts=("cramped_up",), teammates=1, streams=1, episodes=3)
    else:
        shutil.copytree(converted_release, root)
    rng, files = np.random.default_rng(1), sorted(p for p in root.rglob("*") if p.is_file() and p.stat().st_size)
    for number in range(flips):
        path = files[number % len(files)]
        content = path.read_bytes()
        position = int(rng.integers(len(content)))
        flip_bit(path, position, int(rng.integers(8)))
        report = verify_release(root)
        assert not report.ok, (path, position)
        if path.name != "MANIFEST.sha256":
            assert path.relative_to(root).as_posix() in report.files_at_fault
        path.write_bytes(content)
    assert verify_release(root).ok


def test_verify_lists_missing_and_extra_files(release_copy):
    (release_copy / "meta" / "provenance.json").unlink()
    (release_copy / "data" / "notes.txt").write_text("hello")
    assert problems(release_copy) == [
        "meta/provenance.json: listed in the manifest, but missing",
        "data/notes.txt: not listed in the manifest",
    ]


@pytest.mark.parametrize("name", ["meta/info.json", HISTORIES, "meta/tasks.jsonl", "meta/provenance.json"])
def test_quick_verification_checks_the_checksums_of_meta_files(release_copy, name):
    """Append a space to a file of meta/; only its checksum reveals the change."""
    path = release_copy / name
    path.write_text(path.read_text() + " ")
    assert name in verify_release(release_copy, level="quick").files_at_fault


def test_verify_finds_weights_that_do_not_match_their_folder_name(tmp_path):
    """Replace a policy's weights and update the manifest: the folder name still reveals the change."""
    root = shutil.copytree(MINI, tmp_path / "release")
    weights = next(root.glob("teammates/*/policy.safetensors"))
    weights.write_bytes(weights.read_bytes()[:-1] + b"?")
    write_manifest(root)
    found = verify_release(root, level="quick")
    assert found.files_at_fault == {weights.relative_to(root).as_posix()}
    assert f"expected {weights.parent.name}, the name of its folder" in found.findings[0].problem


def test_verify_finds_expert_returns_that_differ_from_provenance(tmp_path):
    labels = ExpertLabels("ab" * 32, "greedy", step=7, return_greedy=0.0, return_sampled=16.9, episodes=200)
    root = one_history_release(tmp_path / "r", provenance=Provenance(source="dqn", expert=labels))
    to_release(load_icrl4aht(root), tmp_path / "converted", "full")
    for folder in (root, tmp_path / "converted"):
        (entry,) = load_icrl4aht(folder).entries
        assert entry.source == "dqn"
        assert (entry.expert_return, entry.expert_return_sampled, entry.expert_step) == (0, 16.9, 7)
        assert not problems(folder)
    wrong = {"expert_return": 0.5, "expert_return_sampled": None, "expert_step": 8}
    tamper(root, HISTORIES, lambda lines: lines[0].update(wrong))
    for (name, value), problem in zip(wrong.items(), problems(root), strict=True):
        assert f"history 0: {name} {value}, but meta/provenance.json has" in problem


def change_value(name, index, value):
    def copy_with_value(arrays):
        changed = arrays[name].copy()
        changed[index] = value(changed[index]) if callable(value) else value
        return arrays | {name: changed}

    return copy_with_value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_value("actions", 7, 6), "actions: expected 0..5, found"),
        (change_value("teammate_actions", 7, -1), "teammate_actions: expected 0..5, found -1..5"),
        (change_value("state", (7, 0), 255), "state has a position that is not reachable floor"),
        (change_value("state", (7, 2), 255), "state has an unknown facing"),
        (change_value("state", (3, 4), 2), "state has an impossible item in hand"),
        (change_value("episode_end_state", (1, 6), 5), "episode_end_state has an impossible recipe"),
    ],
)
def test_verify_finds_values_out_of_range(tmp_path, change, message):
    root = one_history_release(tmp_path / "tampered", change)
    for level in ("full", "deep"):
        found = problems(root, level)
        assert any(message in line for line in found), found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_value("rewards", 33, 20), "replay: 1 rewards differ, first at step 33: rules 0.0, found 20.0"),
        (change_value("state", (45, 3), lambda facing: (facing + 1) % 4), "do not lead to the recorded next state"),
        (change_value("state", (40, 7), 1), "1 episodes do not start as the environment starts, first episode 2"),
        (change_value("episode_end_state", (2, 5), 1), "do not lead to the recorded next state, first step 59"),
        (lambda a: a | {"actions": np.roll(a["actions"], 1)}, "do not lead to the recorded next state"),
        (
            lambda a: a | {"state": np.where(np.arange(a["state"].shape[1]) == 6, 0b01010100, a["state"])},
            "a recipe is not one of the layout's",
        ),
    ],
)
def test_deep_verification_finds_impossible_transitions(tmp_path, change, message):
    root = one_history_release(tmp_path / "tampered", change)
    assert problems(root) == [], "only --deep looks at the physics"
    found = problems(root, level="deep")
    assert any(message in line for line in found), found


def test_deep_verification_finds_observations_that_differ_from_the_state(tmp_path, monkeypatch):
    real = release.observe

    def wrong_observe(layout, record, agent):
        seen = real(layout, record, agent).copy()
        seen[17, 2, 2, 0] = 0
        return seen

    monkeypatch.setattr(release, "observe", wrong_observe)
    root = one_history_release(tmp_path / "tampered", kind="full")
    assert problems(root) == []
    (found,) = problems(root, level="deep")
    assert found.endswith("obs: 1 steps differ from what their state shows, first step 17")


def test_verify_finds_equal_histories_in_different_shards_and_tasks(tmp_path):
    tasks = make_tasks(["demo_simple"], teammates=2)
    arrays = random_history(tasks[0].layout, 6, 20, np.random.default_rng(5))
    new = [
        NewTask(tasks[0], Provenance(), 2, lambda: [NewHistory(0, arrays), NewHistory(1, arrays)]),
        NewTask(tasks[1], Provenance(), 1, lambda: [NewHistory(0, arrays)]),
    ]
    write_release(tmp_path / "r", "lite", new, data_version="0.0.1", card="", kept_steps=20, shard_histories=1)
    for copy in (1, 2):
        assert any(f"history {copy}: has the content of history 0" in problem for problem in problems(tmp_path / "r"))


def test_verify_finds_the_chunk_table_of_another_shard(release_copy):
    random_release(release_copy.with_name("other"), streams=2)
    shutil.copy(release_copy.with_name("other") / chunk_table_name(SHARD), release_copy / chunk_table_name(SHARD))
    write_manifest(release_copy)
    assert any("the index implies 42 chunks, the chunk table has 28" in line for line in problems(release_copy))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[1].update(env_idx=lines[0]["env_idx"]), "history 1: stream 0 of its task appears twice"),
        (lambda lines: lines[0].update(layout="test_simple"), "line 1: expected obs_shape"),
        (lambda lines: lines[0].update(score=lines[0]["score"] + 1), "history 0: score: the index says"),
        (lambda lines: lines[1].update(seed=77), "history 1: index and task"),
        (lambda lines: lines[2].update(task_id="unknown"), "history 2: its task 'unknown' is missing"),
        (lambda lines: lines[0].update(split="test"), "line 1: shard"),
    ],
)
def test_verify_finds_false_index_lines(release_copy, change, message):
    tamper(release_copy, HISTORIES, change)
    assert any(message in problem for problem in problems(release_copy)), problems(release_copy)


def test_verify_finds_a_shard_without_index_lines(tmp_path):
    random_release(tmp_path / "r", layouts=("cramped_up",), teammates=1, streams=2, shard_histories=1)
    assert problems(tmp_path / "r") == []
    tamper(tmp_path / "r", INFO, lambda content: content.update(histories=1))
    tamper(tmp_path / "r", HISTORIES, lambda lines: lines.pop())
    found = problems(tmp_path / "r")
    assert sum("00001-of-00002.h5: names of other shards imply" in problem for problem in found) == 1, found


def test_verify_finds_episode_lengths_that_differ_from_info(release_copy):
    tamper(release_copy, INFO, lambda content: content["environment"].update(kept_steps=40))
    assert any("found 6 episodes in 120 steps" in p for p in problems(release_copy))


def test_verify_never_raises_on_damaged_files(tmp_path):
    """With flipped bits or hostile texts in any file, verify reports problems and never raises."""
    rng, root = np.random.default_rng(7), tmp_path / "release"
    random_release(root, layouts=("cramped_up",), teammates=1, streams=1, episodes=3)
    hostile = [b'{"format_version": ' + b"9" * 5000 + b"}", b"[" * 5000, b"", b"[]", b"{}", b"null", b"\xff\xfe"]
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        content = path.read_bytes()
        for data in [*[None] * 6, *hostile, content[: len(content) // 2]]:
            path.write_bytes(content if data is None else data)
            if data is None:
                flip_bit(path, int(rng.integers(len(content))), int(rng.integers(8)))
            assert not verify_release(root, level="deep").ok, path
            if path.name != MANIFEST:  # verify again with a manifest that matches the damaged file
                write_manifest(root)
                verify_release(root, level="deep")
        path.write_bytes(content)
        write_manifest(root)
    assert verify_release(root, level="deep").ok


def test_verify_finds_chunk_offsets_beyond_the_end_of_the_shard(release_copy):
    table = np.load(release_copy / chunk_table_name(SHARD))
    table["offset"][3] = 2**63 + 5
    np.save(release_copy / chunk_table_name(SHARD), table)
    write_manifest(release_copy)
    assert any("truncated" in problem for problem in problems(release_copy))


def test_verify_finds_a_group_in_place_of_a_dataset(release_copy):
    with h5py.File(release_copy / SHARD, "r+") as file:
        del file["0/actions"]
        file.create_group("0/actions")
    update_metadata_rows(release_copy)
    assert any("hdf5" in problem.lower() for problem in problems(release_copy)), problems(release_copy)


def update_metadata_rows(root):
    """Recompute the chunk table's rows for the bytes between chunks, then rewrite the manifest."""
    path = root / chunk_table_name(SHARD)
    table = np.load(path)
    chunks = table[table["rows"] > 0]
    np.save(path, np.concatenate([chunks, metadata_rows((root / SHARD).read_bytes(), chunks)]))
    write_manifest(root)


@pytest.mark.parametrize("heap", ["local", "global"])
def test_verify_terminates_on_a_shard_with_a_cyclic_heap(release_copy, heap):
    """Regression: libhdf5 loops forever on a free list or heap object that points to itself."""
    path = release_copy / SHARD
    if heap == "local":
        with h5py.File(path, "r+", libver="earliest") as file:
            file.create_group("old").create_group("group")
    data = bytearray(path.read_bytes())
    at = data.find(b"HEAP\0" if heap == "local" else b"GCOL\1")
    if heap == "local":
        free, address = struct.unpack_from("<QQ", data, at + 16)
        struct.pack_into("<QQ", data, address + free, free, 16)
    else:
        struct.pack_into("<HHIQ", data, at + 16, 0, 0, 0, 0)
    path.write_bytes(data)
    update_metadata_rows(release_copy)
    command = [sys.executable, "-m", "icrl4aht_data", "verify", str(release_copy)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ("expected no local heap" in done.stdout) == (heap == "local"), done


class TestVerifyCommand:
    def test_verify_command_prints_what_was_checked(self, lite):
        printed = run_cli("verify", "--deep", lite[0])
        assert "valid; checked 9 files, 84 chunks, 12 histories, 1,440 transitions and their physics" in printed

    def test_verify_command_names_the_damaged_chunk(self, release_copy):
        flip_bit(release_copy / SHARD, int(np.load(release_copy / chunk_table_name(SHARD))["offset"][0]))
        assert "chunk 0 of state in history 0" in run_cli("verify", release_copy, code=1)
        content = json.loads(run_cli("verify", "--json", release_copy, code=1))
        assert not content["ok"]
        assert {finding["file"] for finding in content["findings"]} == {SHARD}


@pytest.mark.parametrize("split", ["test", "validation"])
def test_verify_finds_a_training_teammate_in_another_split(tmp_path, split):
    (train,) = make_tasks(["coord_simple"])
    copied = train.teammate | {"theta_id": 7}  # another number, but the same parameters
    tasks = [train, make_task("teammate", split, "coord_simple", copied, 9)]
    random = np.random.default_rng(0)
    arrays = [random_history(train.layout, 6, 20, random) for _ in tasks]
    new = [
        NewTask(task, Provenance(), 1, lambda own=own: [NewHistory(0, own)])
        for task, own in zip(tasks, arrays, strict=True)
    ]
    write_release(tmp_path / "r", "lite", new, data_version="0.0.1", kept_steps=20)
    assert problems(tmp_path / "r") == [
        f"meta/tasks.jsonl: task {tasks[1].task_id!r} ({split}) has the teammate of {train.task_id!r} (train)"
    ]
