"""Measured distances between a release's validation and training teammates, for the release's dataset card.

`icrl4aht-data research diversity --release FOLDER` measures them; `cards/split_distances.json` has those of the bundled
release.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.format.provenance import ProvenanceByTask
from icrl4aht_data.utils.files import json_hash, read_json
from icrl4aht_data.utils.text import card_file

DISTANCES_FILE = "split_distances.json"


class SplitDistance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distances between the teammates of two splits on a layout.

    Attributes:
        train: number of training teammates.
        validation: number of validation teammates.
        least: smallest share of states in which a validation teammate acts differently from a training teammate.
    """

    train: int
    validation: int
    least: float


def played_teammates(tasks: Iterable[Task], provenance: ProvenanceByTask) -> list[Task]:
    """Return one task for each teammate of each layout and split, including those that join within a history."""
    found: dict[tuple[str, str, str], Task] = {}
    for task in tasks:
        for one in provenance.of(task.task_id).played_tasks(task):
            found.setdefault((one.layout.name, one.split, teammate_id(one.teammate)), one)
    return [found[key] for key in sorted(found)]


def teammates_hash(played: Sequence[Task]) -> str:
    """Return a hash of the teammates that `played_teammates` returns, with their layouts and splits."""
    return json_hash([[task.layout.name, task.split, teammate_id(task.teammate)] for task in played])


def read_distances(played: Sequence[Task]) -> dict[str, SplitDistance]:
    """Return the distances in `cards/split_distances.json` by layout; empty if the file is for other teammates."""
    content = read_json(card_file(DISTANCES_FILE))
    if content["teammates"] != teammates_hash(played):
        return {}
    return msgspec.convert(content["layouts"], dict[str, SplitDistance])
