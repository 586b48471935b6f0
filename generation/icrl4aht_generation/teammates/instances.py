"""Published test instances: the teammates of the 160 published test tasks, on each layout five of each of 4 families.

The bundled manifests contain their parameters and the published task ids, which end in a hash of the task and its
parameters. The families H1 and H2 have other parameters on cramped_down; H3 and H4 have the same on every layout.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS, layout_track
from icrl4aht_data.benchmark.tasks import Task, make_task, manifest_path, read_tasks
from icrl4aht_data.errors import check_choice
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.groups import grouped

TESTED_FAMILIES = tuple(HEURISTIC_KINDS)
"""Families with test instances, which are the families of the paper."""

INSTANCES = 5
"""Number of test instances of each family, t0 to t4."""

INSTANCE_NAMES = tuple(f"{short}/t{number}" for short in HEURISTIC_KINDS.values() for number in range(INSTANCES))
"""Names of the test instances, such as "H3/t1", by family and number."""


def published_tasks(track: str) -> list[Task]:
    """Return the published test tasks of a track, by layout, family and instance."""
    return read_tasks(manifest_path(track, "test"))


@cache
def _test_tasks() -> dict[tuple[str, str], list[Task]]:
    """Return the published test tasks with the instances t0..t4, by layout and family."""
    tasks = (task for track in TRACKS for task in published_tasks(track))
    return grouped(tasks, lambda task: (task.layout.name, task.teammate_kind))


def published_teammates(layout: str, family: str) -> list[dict[str, Any]]:
    """Return the teammate entries of the test instances t0..t4 of a family on a layout (short name).

    A layout without test tasks has the parameters that all layouts except cramped_down share.
    """
    found = _test_tasks()
    return [task.teammate for task in found.get((layout, family), found["demo_wide", family])]


def published_task(layout: str, teammate: str) -> Task:
    """Return the task of a layout and a test teammate such as "H3/t1"; split "test" on test layouts, else "train".

    Raises:
        UnknownNameError: if the layout, family or instance does not exist.
    """
    name = get_layout(layout).name
    check_choice("teammate", teammate, INSTANCE_NAMES)
    family, number = divmod(INSTANCE_NAMES.index(teammate), INSTANCES)
    entry = published_teammates(name, TESTED_FAMILIES[family])[number]
    track = layout_track(name)
    split = "test" if name in TRACKS[track]["test"] else "train"
    return make_task(track, split, name, entry, seed=0)
