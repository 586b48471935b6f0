"""Test files of the published code: family names, views of 4 x 5 cells, duplicates and interrupted conversions."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import OptionError, PublishedFormatError
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import PROVENANCE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import fixed_channels
from icrl4aht_data.writing.published import from_published, to_published
from icrl4aht_data.writing.release_folder import HISTORIES_INDEX
from tests.helpers.damages import file_contents
from tests.helpers.published_files import KEPT
from tests.helpers.random_releases import random_release
from tests.helpers.tampered import change_file


def copy_with_index_changes(source: Path, target: Path, changes: dict[int, dict[str, Any]]) -> Path:
    """Copy published files and change lines of the copied index."""
    shutil.copytree(source, target)
    change_file(target / HISTORIES_INDEX, lambda lines: [lines[number].update(changes[number]) for number in changes])
    return target


@pytest.mark.parametrize(
    ("family", "kind", "expected"),
    [
        ("ippo", "rl", ("rl", "ippo")),
        ("fcp", "rl", ("rl", "fcp")),
        ("BRDiv", "rl", ("rl", "brdiv")),
        ("utility_greedy", "heuristic", ("H4", "utility_greedy")),
        ("recipe_aware", "heuristic", ("H1", "recipe_aware_button")),
        ("H2", "heuristic", ("H2", "territory")),
        ("rl", "fcp", ("rl", "fcp")),
        ("H2", "some_variant", ("H2", "some_variant")),
    ],
)
def test_family_names_of_the_published_code_are_converted(published_folder, tmp_path, family, kind, expected):
    names = {"teammate_family": family, "teammate_kind": kind}
    files = copy_with_index_changes(published_folder[0], tmp_path / "files", {2: names})
    from_published(files, tmp_path / "out", kept_steps=KEPT)
    (entry,) = load_icrl4aht(tmp_path / "out", layout="coord_simple").entries
    assert (entry.teammate_family, entry.teammate_kind) == expected
    assert verify_release(tmp_path / "out", level="deep").ok


@pytest.fixture(scope="module")
def short_views(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]], np.ndarray]:
    """Return a folder of published files with views of 4 x 5 cells, the written arrays, and views of 5 x 5 cells."""
    folder = tmp_path_factory.mktemp("short")
    written = random_release(folder / "release", layouts=("cramped_up",), teammates=1, streams=2)
    dataset = load_icrl4aht(folder / "release", obs="uint8")
    to_published(dataset, folder / "files", states=False)
    complete = np.stack([history.obs[:] for history in dataset])
    with h5py.File(folder / "files" / "histories.h5", "r+") as file:
        for name, group in file.items():
            del group["obs"]
            group["obs"] = complete[int(name)][:, :4].astype("f4")
    path = folder / "files" / "histories_index.jsonl"
    path.write_text(path.read_text().replace("[5, 5, 35]", "[4, 5, 35]"))
    return folder / "files", written, complete


def test_short_views_are_padded_to_5_by_5(short_views, tmp_path):
    files, written, complete = short_views
    assert from_published(files, tmp_path / "out", kept_steps=20) == "observations"
    dataset = load_icrl4aht(tmp_path / "out", obs="uint8")
    found = np.stack([history.obs[:] for history in dataset])
    assert found.shape == complete.shape == (2, 120, 5, 5, 35)
    np.testing.assert_array_equal(found[:, :, :4], complete[:, :, :4])
    fixed = fixed_channels(get_layout("cramped_up"))
    np.testing.assert_array_equal(found[..., fixed], complete[..., fixed])
    # If the ego is in the lower row, the last row of the view is outside the map.
    outside = ~complete[:, :, 4, :, fixed].any(axis=(-2, -1))
    assert 0.1 < outside.mean() < 0.9
    assert not found[:, :, 4][outside].any() and not complete[:, :, 4][outside].any()
    np.testing.assert_array_equal(dataset[1].actions[:], written[1]["actions"])
    (of_task,) = read_provenance(tmp_path / "out" / PROVENANCE).values()
    assert of_task.other["published"]["obs_shape"] == [4, 5, 35]
    assert "padded to 5 x 5" in of_task.other["published"]["padding"]
    assert verify_release(tmp_path / "out", level="deep").ok


@pytest.mark.parametrize("kind", ["lite", "full"])
def test_short_views_are_completed_from_states(short_views, tmp_path, kind):
    """Missing cells are rendered from state records; observations that differ from the rendered ones are refused."""
    files, _, complete = short_views
    shutil.copytree(files, tmp_path / "files")
    dataset = load_icrl4aht(files.parent / "release")
    with h5py.File(tmp_path / "files" / "histories.h5", "r+") as file:
        for name, group in file.items():
            for field in ("state", "episode_end_state"):
                group[field] = dataset[int(name)].read(field)
    from_published(tmp_path / "files", tmp_path / "out", kind, kept_steps=20)
    found = load_icrl4aht(tmp_path / "out", obs="uint8")
    np.testing.assert_array_equal(np.stack([history.obs[:] for history in found]), complete)
    (of_task,) = read_provenance(tmp_path / "out" / PROVENANCE).values()
    assert "padding" not in of_task.other.get("published", {})
    assert verify_release(tmp_path / "out", level="deep").ok
    with h5py.File(tmp_path / "files" / "histories.h5", "r+") as file:
        stored: Any = file["/1/obs"]
        stored[7] = stored[8]
    with pytest.raises(PublishedFormatError, match="group /1: obs does not match the observations rendered from state"):
        from_published(tmp_path / "files", tmp_path / "again", kind, kept_steps=20)


def test_short_views_that_match_no_position_are_refused(short_views, tmp_path):
    shutil.copytree(short_views[0], tmp_path / "files")
    with h5py.File(tmp_path / "files" / "histories.h5", "r+") as file:
        stored: Any = file["/1/obs"]
        stored[7] = 0
    with pytest.raises(
        PublishedFormatError, match="group /1: obs: the observation of step 7 does not match cramped_up from any cell"
    ):
        from_published(tmp_path / "files", tmp_path / "out", kept_steps=20)


def test_duplicate_and_contradictory_index_lines_are_refused(published_folder, tmp_path):
    cases = {
        "line 2: group '0' is already used by line 1": {1: {"h5_group": "0"}},
        "line 2: stream 10 of task 'task_a' is already used by line 1": {1: {"env_idx": 10}},
        r"line 2: Expected `int` >= 0 - at `\$\.env_idx`": {1: {"env_idx": -1}},
        "line 3: unknown teammate_family 'my_pbt'; valid: rl, H1, ": {
            2: {"teammate_family": "my_pbt", "teammate_kind": "rl"}
        },
        "line 3: teammate_family 'ippo' is rl, but teammate_kind is 'heuristic'": {
            2: {"teammate_family": "ippo", "teammate_kind": "heuristic"}
        },
    }
    for number, (message, changes) in enumerate(cases.items()):
        files = copy_with_index_changes(published_folder[0], tmp_path / str(number), changes)
        with pytest.raises(PublishedFormatError, match=message):
            from_published(files, tmp_path / "out", kept_steps=KEPT)


@pytest.mark.parametrize("link", [True, False])
def test_verification_finds_a_history_stored_twice(lite, tmp_path, link):
    to_published(load_icrl4aht(lite[0]), tmp_path / "files")
    with h5py.File(tmp_path / "files" / "histories.h5", "r+") as file:
        del file["/1"]
        if link:
            file["/1"] = file["/0"]
        else:
            file.copy("/0", "/1")
    from_published(tmp_path / "files", tmp_path / "out", kept_steps=20)
    (finding,) = verify_release(tmp_path / "out").findings
    assert finding.problem == "history 1: has the content of history 0"


def test_conversion_overwrites_its_own_files_but_no_other_folders(lite, tmp_path):
    dataset, out = load_icrl4aht(lite[0]), tmp_path / "out"
    to_published(dataset, out)
    before = file_contents(out)
    assert before.keys() == {"histories.h5", "histories_index.jsonl", "tasks.jsonl", "provenance.json"}
    (tmp_path / ".out.partial").mkdir()  # an interrupted conversion leaves such a folder
    (tmp_path / ".out.partial" / "histories.h5").write_bytes(before["histories.h5"][:1000])
    to_published(dataset.filter(layout="demo_wide"), out, overwrite=True)
    assert file_contents(out)["histories_index.jsonl"] != before["histories_index.jsonl"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OptionError, match=r"is not a release: it has no MANIFEST\.sha256"):
        to_published(dataset, out, overwrite=True)
