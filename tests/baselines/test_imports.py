"""Test the names that users import from the package icrl4aht_baselines."""

from __future__ import annotations

import pytest

from icrl4aht_data.errors import EmptySelectionError, UnknownNameError
from tests.helpers.commands import run_python

USE = """
import dataclasses
import sys
import icrl4aht_baselines
assert "jax" not in sys.modules, "importing the package imports JAX"
import icrl4aht_baselines.evaluate.protocols  # the package `evaluate` is imported first
from icrl4aht_baselines import evaluate, find_agent, from_host, report, test_tasks
agent = find_agent("stay")
tasks = test_tasks("teammate", "coord_simple", "H4")[:1]
protocol = icrl4aht_baselines.evaluate.get_protocol("published", 2)
settings = {"agent": "stay", "seeds": [0], "protocol": dataclasses.asdict(protocol), "code_version": "0"}
result = icrl4aht_baselines.evaluate.results.Result(tasks[0].task_id, settings, [[40.0, 40.0]])
assert report([result]).startswith("# Returns per layout")
try:
    evaluate(agent.name, agent.make, tasks, "publishd")
except ValueError as error:
    print(error)
"""


def test_main_functions_are_imported_from_the_package_without_jax():
    """The program passes an unknown protocol to `evaluate`, because a real evaluation takes seconds to compile."""
    assert run_python("-c", USE).startswith("unknown protocol 'publishd'; valid: published, ")


def test_unknown_name_in_the_package_raises_attribute_error():
    import icrl4aht_baselines

    with pytest.raises(AttributeError, match="module 'icrl4aht_baselines' has no attribute 'evalute'"):
        icrl4aht_baselines.evalute  # noqa: B018


def test_test_tasks_can_be_chosen_by_track_layout_and_family():
    from icrl4aht_baselines import test_tasks as tasks_of  # pytest would collect `test_tasks` as a test

    sizes = [
        len(tasks_of(track, layout))
        for track, layout in (("teammate", None), ("layout", None), ("layout", "cramped_down"))
    ]
    assert sizes == [120, 40, 20]
    assert {task.layout.name for task in tasks_of("teammate", "demo_cook_wide")} == {"demo_wide"}
    assert [task.teammate_family for task in tasks_of("teammate", family="H1")] == ["H1"] * 30
    with pytest.raises(EmptySelectionError, match=r"family = H9: no test task of .*, which has .* H1, H2, H3, H4"):
        tasks_of("teammate", family="H9")
    with pytest.raises(UnknownNameError, match="unknown layout 'demo_wid'"):
        tasks_of("teammate", "demo_wid")
