"""Test releases that store their own layouts, and tasks that replace the recipes of their layout."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click import BadParameter

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.tasks import parse_task, read_tasks, task_fields, write_tasks
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.commands.options import LAYOUT
from icrl4aht_data.errors import EmptySelectionError, IndexFormatError, OptionError, TaskFormatError, UnknownNameError
from icrl4aht_data.format.layouts_file import read_tasks_and_layouts
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import FORMAT_VERSION, LAYOUTS_FILE, TASKS
from icrl4aht_data.overcooked import layouts as known_layouts
from icrl4aht_data.overcooked.layouts import Layout, add_layouts, get_layout
from icrl4aht_data.overcooked.state import columns
from icrl4aht_data.utils.text import listed_names
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import make_tasks, random_release
from tests.helpers.tampered import read_lines, tamper

ROWS = ("WPWWW", "0A A1", "W   W", "WBWXW")
OTHER = {"family": "other", "seed": None, "number": None}
MINE = Layout("mine-3-5", "mine-3-5", ROWS, ((0, 0, 1), (0, 1, 1)))


@pytest.fixture(autouse=True)
def forget_release_layouts(monkeypatch):
    """Forget the layouts of opened releases, so each test starts like a new process."""
    monkeypatch.setattr(known_layouts, "_RELEASE_LAYOUTS", {})


@pytest.fixture
def root(tmp_path, forget_release_layouts, monkeypatch) -> Path:
    """Return a release on a published layout and on a layout that only this release defines."""
    add_layouts([MINE])
    random_release(tmp_path / "release", layouts=("coord_simple", "mine-3-5"), teammates=1, streams=2)
    monkeypatch.setattr(known_layouts, "_RELEASE_LAYOUTS", {})
    with pytest.raises(UnknownNameError):
        get_layout("mine-3-5")
    return tmp_path / "release"


def test_reading_tasks_of_a_release_also_reads_its_layouts(root):
    with pytest.raises(TaskFormatError, match="unknown layout 'mine-3-5'"):
        read_tasks(root / TASKS)
    tasks = read_tasks_and_layouts(root / TASKS)
    assert {task.layout.name for task in tasks} == {"coord_simple", "mine-3-5"}
    assert get_layout("mine-3-5").rows == ROWS
    (root / LAYOUTS_FILE).write_text("{}\n")
    with pytest.raises(IndexFormatError, match=r"layouts\.jsonl, line 1"):
        read_tasks_and_layouts(root / TASKS)


def test_listed_names_shortens_long_lists():
    assert listed_names([str(i) for i in range(200)]) == "0, 1, 2, 3, 4, 5, 6, 7, 8 and 191 others"


class TestReleaseWithLayouts:
    def test_release_stores_and_loads_its_own_layouts(self, root):
        line = {"name": "mine-3-5", "map": [*ROWS], "recipes": [[0, 0, 1], [0, 1, 1]], "indicates_delivery": False}
        assert read_lines(root / LAYOUTS_FILE) == [line | {"family": "mine", "seed": 3, "number": 5}]
        ds = load_icrl4aht(root, obs="uint8", channels="canonical")
        assert ds.info.format_version == FORMAT_VERSION
        assert [layout.name for layout in ds.layouts] == ["coord_simple", "mine-3-5"]
        assert ds.layouts[1].rows == ROWS and ds.layouts[1].recipes == MINE.recipes
        batch = ds.ad(batch_size=4, length=20, seed=0)[0]
        assert batch.obs.shape == (4, 20, 5, 5, 46)
        assert verify_release(root, level="deep").ok

    def test_commands_accept_names_of_release_layouts(self, root):
        """Commands always accept the package's layouts; they accept layouts of a release after reading the release."""
        printed = run_cli("list", root, "--layout", "mine-3-5")
        assert "mine-3-5" in printed and "coord_simple" not in printed
        with pytest.raises(UnknownNameError, match="unknown layout 'nowhere'"):
            run_cli("list", root, "--layout", "nowhere")
        assert LAYOUT.convert("asymm_both_plain", None, None) == "asymm_both_plain"
        with pytest.raises(BadParameter, match="unknown layout 'nowhere'"):
            LAYOUT.convert("nowhere", None, None)

    def test_layout_family_filter_selects_histories(self, root):
        ds = load_icrl4aht(root, layout_family="mine")
        assert set(ds.column("layout")) == {"mine-3-5"} and len(ds) == 2
        assert set(load_icrl4aht(root, layout_family="published").column("layout")) == {"coord_simple"}
        assert len(load_icrl4aht(root, layout_family=["mine", "published"])) == 4
        with pytest.raises(EmptySelectionError, match=r"no history has layout_family='rooms'.* published, mine"):
            load_icrl4aht(root, layout_family="rooms")

    def test_layout_and_kind_that_exist_elsewhere_give_an_empty_selection(self, root):
        absent: list[dict[str, Any]] = [{"layout": ["mine-3-5", "mine-3-6"]}, {"teammate_kind": "comedi"}]
        for wanted in absent:
            with pytest.raises(EmptySelectionError, match=r"no history has .*This release has"):
                load_icrl4aht(root, **wanted)

    def test_unpickled_dataset_restores_its_layouts(self, root, monkeypatch):
        sent = pickle.dumps(load_icrl4aht(root))
        monkeypatch.setattr(known_layouts, "_RELEASE_LAYOUTS", {})
        ds = pickle.loads(sent)
        assert ds[-1].obs.shape == (120, 5, 5, 35) and get_layout("mine-3-5").rows == ROWS

    def test_release_of_published_layouts_has_no_layouts_file(self, lite):
        assert not (lite[0] / LAYOUTS_FILE).exists()

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"name": "coord_simple"} | OTHER, "layout 'coord_simple': differs from the known layout"),
            ({"map": ["WPWWW", *ROWS[1:3], "WBWWW"]}, "no agent can face a goal"),
            ({"map": ["WP2W3", *ROWS[1:]]}, "20 cells and piles of 4 ingredient types"),
            ({"recipes": [[0, 0, 2]]}, r"recipes use ingredients \[2\]"),
            ({"name": "mine\x1b[31m"}, "printable characters, found 'mine"),
            ({"map": ["WPWXW", *ROWS[1:3], "WWWBW"], "recipes": [[0, 0, 0]] * 2}, "no recipe twice"),
            ({"map": ["WPWWW", "0A AW", "W   W", "WBWX1"]}, "ingredient 1 cannot reach a pot"),
            ({"family": "rooms"}, r"found \('rooms', 3, 5\)"),
            ({"number": 6}, r"expected .* \('mine', 3, 5\)"),
            ({"seed": None}, r"found \('mine', None, 5\)"),
            ({"name": "mine"}, r"expected .* \('other', None, None\)"),
        ],
    )
    def test_invalid_stored_layouts_are_refused(self, root, fields, message):
        tamper(root, LAYOUTS_FILE, lambda lines: lines[0].update(fields))
        with pytest.raises(IndexFormatError, match=message):
            load_icrl4aht(root)

    def test_repeated_and_missing_lines_of_layouts_are_refused(self, root):
        (line,) = read_lines(root / LAYOUTS_FILE)
        tamper(root, LAYOUTS_FILE, list.clear)
        with pytest.raises(IndexFormatError, match=r"unknown layout .*'mine-3-5'"):
            load_icrl4aht(root)
        tamper(root, LAYOUTS_FILE, lambda lines: lines.extend([line, line]))
        with pytest.raises(IndexFormatError, match="line 2: layout 'mine-3-5' is listed twice"):
            load_icrl4aht(root)

    def test_missing_layouts_file_is_refused_even_if_the_layout_is_known(self, root):
        load_icrl4aht(root)
        (root / LAYOUTS_FILE).unlink()
        write_manifest(root)
        with pytest.raises(
            IndexFormatError, match=r"layout 'mine-3-5' is neither in the benchmark nor in meta/layouts.jsonl"
        ):
            load_icrl4aht(root)

    def test_two_releases_cannot_use_one_name_for_different_maps(self, root):
        load_icrl4aht(root)
        tamper(root, LAYOUTS_FILE, lambda lines: lines[0].update(map=["WWPWW", *ROWS[1:]]))
        with pytest.raises(IndexFormatError, match="give the new layout another name"):
            load_icrl4aht(root)


class TestRecipesOfATask:
    def test_recipes_of_a_task_replace_the_recipes_of_its_layout(self, tmp_path):
        (plain,), (task,) = make_tasks(["demo_wide"]), make_tasks(["demo_wide"], recipes=((0, 0, 1),))
        assert task.task_id != plain.task_id and task.layout.recipes == ((0, 0, 1),)
        assert plain.layout is get_layout("demo_wide") and task.layout is task.layout
        assert task.teammate_key != plain.teammate_key
        write_tasks(tmp_path / "tasks.jsonl", [plain, task])
        assert read_tasks(tmp_path / "tasks.jsonl") == [plain, task]
        assert "recipes" not in json.loads((tmp_path / "tasks.jsonl").read_text().splitlines()[0])

    @pytest.mark.parametrize(
        ("recipes", "message"),
        [
            ([], "expected at least one recipe, and no recipe twice"),
            ([[0, 0, 1], [0, 1, 0]], "expected at least one recipe, and no recipe twice"),
            ([[0, 0, 9]], r"recipes use ingredients \[9\] that have no pile"),
            ("000", "recipes"),
        ],
    )
    def test_parse_task_refuses_invalid_recipes(self, recipes, message):
        (task,) = make_tasks(["demo_wide"])
        with pytest.raises(TaskFormatError, match=message):
            parse_task(task_fields(task) | {"recipes": recipes})
        with pytest.raises(TaskFormatError, match="no pile"):
            make_tasks(["demo_wide"], recipes=((0, 0, 7),))

    def test_histories_and_verification_use_the_recipes_of_the_task(self, tmp_path):
        root = tmp_path / "release"
        random_release(root, layouts=("coord_simple",), teammates=1, streams=1, recipes=((0, 0, 1),))
        ds = load_icrl4aht(root)
        wanted = get_layout("coord_simple").recipe_item((0, 0, 1))
        assert set(ds[0].state[:, columns(ds.layouts[0]).recipe]) == {wanted}
        np.testing.assert_array_equal(ds[0].obs, load_icrl4aht(root, cache="stream")[0].obs)
        assert ds.environment_parameters(0)["recipes"] == [[0, 0, 1]]
        assert verify_release(root, level="deep").ok
        (task,) = read_tasks(root / TASKS)
        plain = dataclasses.replace(task, recipes=None)
        write_tasks(root / TASKS, [plain])  # the stored task id is still the hash of the task with recipes
        write_manifest(root)
        with pytest.raises(TaskFormatError, match="does not match the task's content"):
            read_tasks(root / TASKS)


def test_add_layouts_refuses_to_change_a_layout_of_the_package():
    known = get_layout("rooms-0-46")
    assert add_layouts([known]) == [known]
    with pytest.raises(OptionError, match="layout 'rooms-0-46': differs from the known layout of this name"):
        add_layouts([dataclasses.replace(known, rows=tuple(row.replace("P", "W", 1) for row in known.rows))])
