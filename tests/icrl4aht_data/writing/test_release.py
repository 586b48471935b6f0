"""Test writing releases: equality of written and read arrays, refused inputs, and interrupted writing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import OptionError, RootNotFoundError
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout
from icrl4aht_data.utils.files import file_hash
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.damages import file_contents
from tests.helpers.paths import ROOT
from tests.helpers.random_releases import make_tasks, random_history, random_release


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    layouts=st.tuples(st.sampled_from(sorted(LAYOUTS))),
    episodes=st.integers(1, 12),
    length=st.sampled_from([1, 7, 100, 260]),
    kind=st.sampled_from(["lite", "full"]),
    shard_histories=st.sampled_from([1, 2, 1024]),
    labels=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_any_release_round_trips_and_verifies(tmp_path, episodes, length, shard_histories, **options):
    root = tmp_path / f"{time.monotonic_ns()}"
    options |= {"episodes": episodes, "length": length, "shard_histories": shard_histories}
    written = random_release(root, teammates=1, **options)
    report = verify_release(root, level="deep")
    assert report.ok, report.findings
    assert report.transitions == 3 * episodes * length
    dataset = load_icrl4aht(root)
    assert len({entry.shard for entry in dataset.entries}) == -(-3 // shard_histories)
    for history in dataset:
        for name, array in written[history.entry.history_id].items():
            np.testing.assert_array_equal(history.read(name), array)


def test_writing_a_release_twice_gives_equal_bytes(tmp_path):
    for name in ("a", "b"):
        random_release(tmp_path / name)
    assert file_contents(tmp_path / "a") == file_contents(tmp_path / "b")
    assert len(file_contents(tmp_path / "a")) >= 9


def sorted_names(folder):
    """Return the sorted names of the entries of a folder."""
    return sorted(path.name for path in folder.iterdir())


def write_cramped_up_release(
    root: Path, load: Callable[[], list[NewHistory]], streams: int = 1, **options: Any
) -> None:
    """Write a release of one task on cramped_up with episodes of 10 steps."""
    (task,) = make_tasks(["cramped_up"])
    new = NewTask(task, Provenance(), streams, load)
    write_release(root, "lite", [new], data_version="0.0.1", card="", kept_steps=10, **options)


def random_arrays() -> dict[str, np.ndarray]:
    """Return the arrays of one history on cramped_up with 5 episodes of 10 steps."""
    return random_history(get_layout("cramped_up"), 5, 10, np.random.default_rng(0))


def raise_error() -> list[NewHistory]:
    raise RuntimeError("no data")


@pytest.mark.parametrize(
    ("tamper", "streams", "message"),
    [
        (lambda a: a | {"rewards": a["rewards"] + 0.5}, 2, "values that int8 cannot represent"),
        (lambda a: a | {"actions": a["actions"][:-1], "state": a["state"][:-1]}, 2, "expected 49 rows, found 50"),
        (lambda a: {name: a[name] for name in a if name != "episode_end_state"}, 2, "a history does not have arrays"),
        (lambda a: a | {"dones": np.roll(a["dones"], 1)}, 2, "10 steps"),
        (lambda a: a, 1, "expected 1 histories, found 2"),
        (lambda a: a, 3, "expected 3 histories, found 2"),
        (lambda a: a, 0, "has no histories; add at least one"),
    ],
)
def test_invalid_histories_are_refused_without_leftovers(tmp_path, tamper, streams, message):
    with pytest.raises(OptionError, match=message):
        write_cramped_up_release(
            tmp_path / "out",
            lambda: [NewHistory(k, tamper(random_arrays())) for k in (0, 1)],
            streams,
            shard_histories=1,
        )
    assert sorted_names(tmp_path) == []


def test_failed_overwrite_keeps_the_old_release(tmp_path):
    root = tmp_path / "release"
    random_release(root, seed=1)
    before = (root / "MANIFEST.sha256").read_bytes()
    with pytest.raises(OptionError, match="release: exists; give another folder, or use --overwrite to replace it"):
        write_cramped_up_release(root, raise_error)
    with pytest.raises(RuntimeError, match="no data"):
        write_cramped_up_release(root, raise_error, overwrite=True)
    assert (root / "MANIFEST.sha256").read_bytes() == before
    assert verify_release(root).ok
    random_release(root, seed=2, overwrite=True)
    assert (root / "MANIFEST.sha256").read_bytes() != before
    assert sorted_names(tmp_path) == ["release"], "no lock is left"


def test_write_release_refuses_missing_and_duplicate_tasks(tmp_path):
    (task,) = make_tasks(["cramped_up"])
    new = NewTask(task, Provenance(), 1, list)
    for tasks in ([], [new, new]):
        with pytest.raises(OptionError, match="at least one task, and each task once"):
            write_release(tmp_path / "out", "lite", tasks, data_version="0.0.1", card="")


def test_second_writer_of_a_release_is_refused(tmp_path):
    def load_during_write() -> list[NewHistory]:
        with pytest.raises(OptionError, match="another process is writing this folder"):
            random_release(tmp_path / "release")
        return [NewHistory(0, random_arrays())]

    write_cramped_up_release(tmp_path / "release", load_during_write)
    assert verify_release(tmp_path / "release").histories == 1


def test_old_release_is_restored_if_a_writer_was_killed_between_two_renames(tmp_path):
    random_release(tmp_path / "release", seed=1)
    before = (tmp_path / "release" / "MANIFEST.sha256").read_bytes()
    (tmp_path / "release").rename(tmp_path / ".release.old")
    (tmp_path / ".release.partial").mkdir()
    with pytest.raises(OptionError, match="release: exists"):
        write_cramped_up_release(tmp_path / "release", raise_error)
    assert (tmp_path / "release" / "MANIFEST.sha256").read_bytes() == before


def add_note(root: Path) -> None:
    root.mkdir(exist_ok=True)
    (root / "note.txt").write_text("mine")


def add_listed_note(root: Path) -> None:
    add_note(root)
    (root / "MANIFEST.sha256").write_text(f"{file_hash(root / 'note.txt')}  note.txt\n")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda root: root.write_text("mine"), "is not a folder"),
        (add_note, r"is not a release: it has no MANIFEST\.sha256; --overwrite replaces only"),
        (add_listed_note, "is not a release: .*'note.txt' is not a file that a release may contain"),
        (
            lambda root: (add_note(root), (root / "MANIFEST.sha256").touch()),
            "is not a release: .* empty: expected a line",
        ),
        (
            lambda root: (random_release(root), add_note(root)),
            r"contains note\.txt, which MANIFEST\.sha256 does not list",
        ),
    ],
    ids=["file", "folder", "listed", "empty manifest", "release"],
)
def test_overwrite_refuses_folders_with_other_files(tmp_path, make, message):
    root = tmp_path / "release"
    make(root)
    before = file_contents(tmp_path)
    with pytest.raises(OptionError, match="exists; give another folder, or use --overwrite to replace it"):
        write_cramped_up_release(root, raise_error)
    with pytest.raises(OptionError, match=message):
        write_cramped_up_release(root, raise_error, overwrite=True)
    assert file_contents(tmp_path) == before


def test_folders_created_during_writing_are_not_replaced(tmp_path):
    root = tmp_path / "release"

    def load_during_write() -> list[NewHistory]:
        add_note(root)
        return [NewHistory(0, random_arrays())]

    for overwrite, message in ((False, "exists"), (True, r"contains note\.txt")):
        with pytest.raises(OptionError, match=message):
            write_cramped_up_release(root, load_during_write, overwrite=overwrite)
        assert (root / "note.txt").read_text() == "mine"
        shutil.rmtree(root)
        random_release(root, seed=1)


@pytest.mark.parametrize(
    ("pause", "delay", "streams"),
    [
        (60, 0.0, 2),  # the writer is killed after the first shard
        pytest.param(0, 0.05, 8, marks=pytest.mark.slow),  # the writer is killed after more shards
        pytest.param(0, 0.2, 8, marks=pytest.mark.slow),
    ],
)
def test_a_killed_writer_leaves_no_readable_release(tmp_path, pause, delay, streams):
    root = tmp_path / "release"
    code = f"""
import sys, time
from pathlib import Path
from icrl4aht_data.writing import release
from tests.helpers.random_releases import random_release

def write_shard(*arguments, write=release.write_shard):
    write(*arguments)
    print("written", flush=True)
    time.sleep({pause})

release.write_shard = write_shard
random_release(Path(sys.argv[1]), streams={streams}, episodes=60, length=100, shard_histories=1)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, str(root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "written\n"
        time.sleep(delay)
        writer.send_signal(signal.SIGKILL)
    assert not root.exists()
    with pytest.raises(RootNotFoundError):
        load_icrl4aht(root)
    assert (tmp_path / ".release.partial").exists(), "the writer was killed too late for this test"
    assert not verify_release(tmp_path / ".release.partial").ok
    random_release(root, streams=1)  # the next writer removes the leftovers
    assert verify_release(root).ok
    assert sorted_names(tmp_path) == ["release"]
