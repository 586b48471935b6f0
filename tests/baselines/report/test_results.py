"""Results in one table: cells, kinds of tasks, overlap with training data, merged and stored runs."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.results import Result, write_result
from icrl4aht_baselines.report import merge, rows
from icrl4aht_baselines.report.comparison import StoredResults, add_results, read_stored, results_file, write_stored
from icrl4aht_baselines.report.figures import split_cells
from icrl4aht_baselines.report.results import ResultCell, as_run, bundled_by_id, cell_of
from icrl4aht_baselines.training.seen import OVERLAPS

from icrl4aht_data.benchmark.tasks import Task, make_task, teammate_id
from icrl4aht_data.errors import OptionError
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

H4 = next(task.teammate for task in TEST_TASKS if (task.layout.name, task.teammate_family) == ("demo_wide", "H4"))


def own_h4(number: int) -> dict[str, Any]:
    return H4 | {"theta_id": 50 + number, "theta": H4["theta"] | {"inertia": number / 100}}


def learned(number: int) -> dict[str, Any]:
    theta = {"checkpoint": f"fcp/{number}", "sha256": f"{number:064x}"[::-1]}
    return {"kind": "rl", "family": "fcp", "theta_id": number, "base_seed": 0, "theta": theta}


TASKS: dict[str, list[Task]] = {
    "test": [task for task in TEST_TASKS if task.teammate == H4 and task.layout.name == "demo_wide"][:1],
    "training": [make_task("teammate", "train", "demo_wide", own_h4(1), 1)],
    "validation": [make_task("teammate", "validation", "demo_wide", own_h4(2), 2)],
    "held out": [make_task("layout", "heldout", "cramped_up", learned(1), 3)],
    "own": [make_task("teammate", "test", "demo_wide", own_h4(3), 4)],
}
LAYOUT_TEST = [task for task in TEST_TASKS if task.layout.name == "asymm_right" and task.teammate_family == "H1"]


def test_a_table_has_a_row_for_each_task_seed_and_block():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide" and task.teammate_family == "H4"][:2]
    settings = {"agent": "mine", "seeds": [3, 4], "protocol": asdict(get_protocol("seeded", 5)), "code_version": "0"}
    returns = [[[1.0, 2, 3, 5, 8], [0.0] * 5], [[10.0] * 5, [20.0] * 5]]
    run = as_run([Result(task.task_id, settings, found) for task, found in zip(tasks, returns, strict=True)])
    (cell,) = run.cells
    assert cell == ("demo_wide", "H4", "test") and cell.group == "H4"
    np.testing.assert_array_equal(run.cells[cell], [[0.5, 1, 1.5, 2.5, 4], [15.0] * 5])
    found = run.table.set_index(["task", "seed"])
    assert len(found) == 2 * 2
    blocks = found.loc[(tasks[0].task_id, 3), ["mean", "first", "last", "opening"]]
    assert blocks.to_dict() == {"mean": 3.8, "first": 1.5, "last": 6.5, "opening": 1.0}
    assert set(run.table["overlap"]) == {"unknown"}
    with pytest.raises(OptionError, match="results of different settings in one run"):
        as_run([Result(tasks[0].task_id, settings, [[1.0]]), Result(tasks[1].task_id, {}, [[1.0]])])


@pytest.mark.parametrize("kind", TASKS)
def test_kinds_of_tasks_never_share_a_cell(kind):
    (task,) = TASKS[kind]
    cell = cell_of(task)
    assert cell.kind == kind and cell.group == task.teammate_family + ("" if kind == "test" else f" ({kind})")
    run = evaluated_run("AD", protocol="published", tasks=[task, *TASKS["test" if kind != "test" else "own"]])
    assert len(run.cells) == 2
    assert [row["published_mean"] is None for row in rows(run)] == [row["tasks"] != "test" for row in rows(run)]


@pytest.mark.parametrize(
    ("tasks", "record", "expected"),
    [
        (TASKS["validation"], None, ["unknown"]),
        (TASKS["validation"], [], []),
        (TASKS["validation"], [{"family": "rl", "algorithm": "comedi", "teammates": ["00"]}], []),
        (TASKS["validation"], [{"family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}], ["family"]),
        (TASKS["validation"], [{"family": "H4", "teammates": [teammate_id(own_h4(2))]}], ["teammate"]),
        (TASKS["held out"], [{"family": "rl", "algorithm": "brdiv", "teammates": None}], []),
        (TASKS["held out"], [{"family": "rl", "algorithm": "fcp", "teammates": None}], ["family"]),
        (LAYOUT_TEST, [{"layout": "asymm_right", "family": "rl", "algorithm": "fcp", "teammates": []}], ["layout"]),
    ],
)
def test_overlaps_of_training_and_tasks(tasks, record, expected):
    """Training on a test layout is an overlap only in the layout track."""
    entries = None if record is None else [{"layout": "demo_wide", **entry} for entry in record]
    run = evaluated_run("AD", tasks=tasks, trained_on=entries)
    assert rows(run)[0]["overlap"].split() == expected
    assert set(run.table["overlap"]) == {" ".join(expected)}
    assert set(expected) <= set(OVERLAPS)


def test_only_reference_egos_may_have_no_training_record():
    assert rows(evaluated_run("stay", trained_on=None))[0]["overlap"] == ""
    with pytest.raises(OptionError, match=r"runs/mine: trained_on: expected a layout, a family"):
        evaluated_run("mine", trained_on=[{"layout": "demo_wide"}])


def test_models_of_different_layouts_are_one_agent():
    one, two = evaluated_run("AD", ("demo_wide",)), evaluated_run("AD", ("coord_simple",))
    (both,) = merge([one, two])
    assert next(iter(both.cells)) == ResultCell("coord_simple", "H1") and len(both.cells) == 8
    assert len(both.table) == len(one.table) + len(two.table)
    assert [source.layouts for source in both.sources] == [("demo_wide",), ("coord_simple",)]


def test_results_of_other_conditions_are_not_merged():
    one = evaluated_run("AD", acting="cached")
    for other, label in (
        (evaluated_run("AD", value=3.0), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), acting="exact"), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), variant=("K", 250)), "AD, K = 250"),
        (evaluated_run("AD", ("coord_simple",), acting="cached", details={"sampled": True}), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), acting="cached", details={"forget": True}), "AD [runs/AD]"),
    ):
        assert [run.label for run in merge([one, other])] == ["AD", label]
    assert other.sources[0].conditions == (
        "protocol seeded, 1 seed (0), 40 episodes of 100 steps, cached acting, memory cleared before each episode"
    )


def test_cells_are_split_by_kind_and_layout():
    run = evaluated_run("AD", ("coord_ring", "test_wide", "demo_simple", "demo_wide"))
    cells = [*run.cells, ResultCell("demo_wide", "H1", "validation")]
    parts = split_cells(cells, 12)
    assert [len(part) for part in parts] == [12, 4, 1]
    assert [cell for part in parts for cell in part] == cells


@pytest.fixture
def ramp(tmp_path):
    """Return results of one cell with episode returns 0..99 plus the seed in every task."""
    settings = {"agent": "ramp", "seeds": [0, 1], "protocol": asdict(get_protocol("seeded")), "code_version": "0"}
    settings |= {"details": {"trained_on": [{"layout": "demo_wide", "family": "H4"}]}}
    for task in bundled_by_id("test").values():
        if cell_of(task) == ("demo_wide", "H4", "test"):
            returns = [[float(seed + number) for number in range(100)] for seed in range(2)]
            write_result(tmp_path / "ramp", Result(task.task_id, settings, returns))
    return tmp_path / "ramp"


def test_stored_results_round_trip(ramp, tmp_path):
    stored = add_results(add_results(StoredResults(), ramp, "a ramp"), ramp, "")
    write_stored(tmp_path / "results.json", stored)
    again = read_stored(tmp_path / "results.json")
    assert again.about == {"ramp": "a ramp"}
    for found in (stored, again):
        blocks = found.protocol("seeded")["ramp"][ResultCell("demo_wide", "H4")]
        expected = {"mean": [49.5, 50.5], "first": [9.5, 10.5], "last": [89.5, 90.5], "opening": [0.0, 1.0]}
        expected |= {"gain": [80.0, 80.0]}
        assert {name: getattr(blocks, name).tolist() for name in expected} == {
            name: [of] * 5 for name, of in expected.items()
        }
        assert blocks.overlaps == ("family",)


def test_bundled_results_are_in_canonical_form(tmp_path):
    write_stored(tmp_path / "results.json", read_stored(results_file()))
    for suffix in (".json", ".csv"):
        path = results_file().with_suffix(suffix)
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_results_that_cannot_be_stored(ramp, tmp_path):
    with pytest.raises(OptionError, match="results of ramp, a new agent: say how it was made by --about"):
        add_results(StoredResults(), ramp, "")
    for path in (ramp / "tasks").iterdir():
        content = json.loads(path.read_text())
        content["returns"] = [row[:30] for row in content["returns"]]
        (tmp_path / "short" / "tasks").mkdir(parents=True, exist_ok=True)
        (tmp_path / "short" / "tasks" / path.name).write_text(json.dumps(content))
    with pytest.raises(OptionError, match="30 episodes, expected at least 40; evaluate more"):
        add_results(StoredResults(), tmp_path / "short", "short")
    next((ramp / "tasks").iterdir()).unlink()
    with pytest.raises(OptionError, match="4 of the 5 published tasks of demo_wide H4; evaluate all of them"):
        add_results(StoredResults(), ramp, "a part")


@pytest.mark.parametrize("texts", ["{", "[]", '{"abut": {}}', "{}"])
def test_damaged_stored_results(texts, tmp_path):
    assert len(read_stored(tmp_path / "none.json").table) == 0
    (tmp_path / "bad.json").write_text(texts)
    (tmp_path / "bad.csv").write_text("agent,protocol\n")
    with pytest.raises(OptionError, match=r"bad\.json: not stored results: .*restore it and bad\.csv"):
        read_stored(tmp_path / "bad.json")


def test_results_are_kept_for_each_track(tmp_path):
    """A bundled model has separate parameters and training data for each track."""
    record = {"teammate": [{"layout": "demo_wide", "family": "H4"}], "layout": []}
    run = evaluated_run("ad-reference", ("demo_wide", "cramped_down"), details={"trained_on": record}, trained_on=None)
    assert [source.layouts for source in run.sources] == [("demo_wide",), ("cramped_down",)]
    marked = {(row["layout"], row["family"]) for row in rows(run) if row["overlap"]}
    assert marked == {("demo_wide", "H4")}
    assert dataclasses.replace(run, note="x").label == "ad-reference [x]"
