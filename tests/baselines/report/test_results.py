"""Test the table of results: kinds of tasks, blocks of episodes, overlap with training data, and merged runs."""

from __future__ import annotations

import dataclasses
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report import merge
from icrl4aht_baselines.report.results import BLOCKS, ResultCell, as_run, cell_of, episode_blocks, task_label
from icrl4aht_baselines.training.seen import OVERLAPS

from icrl4aht_data.benchmark.tasks import Task, make_task, teammate_id
from icrl4aht_data.errors import OptionError
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

H4 = next(task.teammate for task in TEST_TASKS if (task.layout.name, task.teammate_family) == ("demo_wide", "H4"))


def h4_teammate(number: int) -> dict[str, Any]:
    return H4 | {"theta_id": 50 + number, "theta": H4["theta"] | {"inertia": number / 100}}


def learned_teammate(number: int) -> dict[str, Any]:
    theta = {"checkpoint": f"fcp/{number}", "sha256": f"{number:064x}"[::-1]}
    return {"kind": "rl", "family": "fcp", "theta_id": number, "base_seed": 0, "theta": theta}


TASKS: dict[str, list[Task]] = {
    "test": [task for task in TEST_TASKS if task.teammate == H4 and task.layout.name == "demo_wide"][:1],
    "training": [make_task("teammate", "train", "demo_wide", h4_teammate(1), 1)],
    "validation": [make_task("teammate", "validation", "demo_wide", h4_teammate(2), 2)],
    "held out": [make_task("layout", "heldout", "cramped_up", learned_teammate(1), 3)],
    "own": [make_task("teammate", "test", "demo_wide", h4_teammate(3), 4)],
}
LAYOUT_TEST = [task for task in TEST_TASKS if task.layout.name == "asymm_right" and task.teammate_family == "H1"]


def test_results_table_has_a_row_for_each_task_seed_and_block():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide" and task.teammate_family == "H4"][:2]
    settings = {"agent": "mine", "seeds": [3, 4], "protocol": asdict(get_protocol("seeded", 5)), "code_version": "0"}
    returns = [[[1.0, 2, 3, 5, 8], [0.0] * 5], [[10.0] * 5, [20.0] * 5]]
    run = as_run([Result(task.task_id, settings, found) for task, found in zip(tasks, returns, strict=True)])
    (cell,) = run.cells
    assert cell == ("demo_wide", "H4", "test") and cell.title == "demo_wide, H4"
    np.testing.assert_array_equal(run.cells[cell], [[0.5, 1, 1.5, 2.5, 4], [15.0] * 5])
    found = run.table.set_index(["task", "seed", "block"])["return"].sort_index()
    assert len(found) == 2 * 2 * 3, "blocks of 5 episodes"
    assert found.xs((task_label(tasks[0].task_id), 3)).to_dict() == {"all": 3.8, "1": 1.0, "2-5": 4.5}
    of = run.returns[cell]
    assert (of.tasks, of.seeds) == (tuple(task_label(task.task_id) for task in tasks), (3, 4))
    np.testing.assert_array_equal(of.blocks["all"], [[[3.8, 0.0], [10.0, 20.0]]])
    assert set(run.table["overlap"]) == {"unknown"}
    with pytest.raises(OptionError, match="results with equal settings, found different settings"):
        as_run([Result(tasks[0].task_id, settings, [[1.0]]), Result(tasks[1].task_id, {}, [[1.0]])])


def test_episode_blocks_of_long_and_short_evaluations_are_means():
    found = {episodes: episode_blocks(np.arange(1.0, 1 + episodes)) for episodes in (1, 5, 20, 30, 100)}
    assert list(found[100]) == [*BLOCKS] and list(found[20]) == ["all", "1", "2-5", "6-20"]
    assert list(found[5]) == ["all", "1", "2-5"] and list(found[1]) == ["all", "1"]
    expected = {"all": 50.5, "1": 1.0, "2-5": 3.5, "6-20": 13.0, "21-100": 60.5, "last 20": 90.5}
    assert found[100] == expected and found[30]["21-100"] == 25.5


@pytest.mark.parametrize("kind", TASKS)
def test_results_of_different_kinds_of_tasks_are_kept_apart(kind):
    (task,) = TASKS[kind]
    cell = cell_of(task)
    assert cell.kind == kind and cell.title.endswith("H4" if kind == "test" else f" ({kind})")
    run = evaluated_run("AD", protocol="published", tasks=[task, *TASKS["test" if kind != "test" else "own"]])
    assert len(run.cells) == 2 and all(map(run.has_full_length, run.cells))


@pytest.mark.parametrize(
    ("tasks", "record", "expected"),
    [
        (TASKS["validation"], None, ["unknown"]),
        (TASKS["validation"], [], []),
        (TASKS["validation"], [{"family": "rl", "algorithm": "comedi", "teammates": ["00"]}], []),
        (TASKS["validation"], [{"family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}], ["family"]),
        (TASKS["validation"], [{"family": "H4", "teammates": [teammate_id(h4_teammate(2))]}], ["teammate"]),
        (TASKS["held out"], [{"family": "rl", "algorithm": "brdiv", "teammates": None}], []),
        (TASKS["held out"], [{"family": "rl", "algorithm": "fcp", "teammates": None}], ["family"]),
        (LAYOUT_TEST, [{"layout": "asymm_right", "family": "rl", "algorithm": "fcp", "teammates": []}], ["layout"]),
    ],
)
def test_overlap_of_training_data_and_tasks_is_reported(tasks, record, expected):
    """Training on a test layout counts as overlap only in the layout track."""
    entries = None if record is None else [{"layout": "demo_wide", **entry} for entry in record]
    run = evaluated_run("AD", tasks=tasks, trained_on=entries)
    assert set(run.table["overlap"]) == {" ".join(expected)}
    assert set(expected) <= set(OVERLAPS)


def test_results_without_training_record_are_allowed_for_reference_egos():
    assert set(evaluated_run("stay", trained_on=None).table["overlap"]) == {""}
    with pytest.raises(OptionError, match=r"runs/mine: trained_on: expected a layout, a family"):
        evaluated_run("mine", trained_on=[{"layout": "demo_wide"}])


def test_runs_of_one_agent_on_different_layouts_are_merged():
    one, two = evaluated_run("AD", ("demo_wide",)), evaluated_run("AD", ("coord_simple",))
    (both,) = merge([one, two])
    assert next(iter(both.cells)) == ResultCell("coord_simple", "H1") and len(both.cells) == 8
    assert len(both.table) == len(one.table) + len(two.table)
    assert [source.layouts for source in both.sources] == [("demo_wide",), ("coord_simple",)]


def test_runs_with_different_conditions_or_equal_tasks_are_not_merged():
    one = evaluated_run("AD", acting="cached")
    for other, label in (
        (evaluated_run("AD", value=3.0), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), acting="exact"), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), acting="cached", details={"sampled": True}), "AD [runs/AD]"),
        (evaluated_run("AD", ("coord_simple",), acting="cached", details={"forget": True}), "AD [runs/AD]"),
    ):
        assert [run.label for run in merge([one, other])] == ["AD", label]
    assert other.sources[0].conditions == (
        "protocol seeded, 1 seed (0), 40 episodes of 100 steps, cached acting, memory cleared before each episode"
    )


def test_sources_of_results_are_separate_for_each_track(tmp_path):
    """Some bundled models have different parameters and training data for each track."""
    record = {"teammate": [{"layout": "demo_wide", "family": "H4"}], "layout": []}
    run = evaluated_run("rl2-reference", ("demo_wide", "cramped_down"), details={"trained_on": record}, trained_on=None)
    assert [source.layouts for source in run.sources] == [("demo_wide",), ("cramped_down",)]
    assert [cell[:2] for cell in run.cells if run.overlaps([cell])] == [("demo_wide", "H4")]
    assert dataclasses.replace(run, note="x").label == "rl2-reference [x]"
