"""What a model was trained on: the layouts and teammates that it has seen, which reports compare with its tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import NotStoredError, OptionError, UnknownNameError
from icrl4aht_data.utils.files import json_hash

SEEN = "seen_in_training"
"""Key of the record in a run's config.json, under `histories`, and in the `details` of evaluation settings."""


class SeenInTraining(NamedTuple):
    """Layouts and teammates of the histories that a model was trained on.

    Attributes:
        layouts: short names.
        teammates: teammate kind, such as "utility_greedy" or "fcp" -> ids of its teammates, see `teammate_id`; None if
            the release does not say which teammates of this kind it has.
    """

    layouts: tuple[str, ...] = ()
    teammates: Mapping[str, tuple[str, ...] | None] = {}

    def to_json(self) -> dict[str, Any]:
        """Returns the record as JSON values; `parse_seen` reads it."""
        teammates = {kind: None if ids is None else list(ids) for kind, ids in self.teammates.items()}
        return {"layouts": list(self.layouts), "teammates": teammates}


def teammate_id(teammate: Mapping[str, Any]) -> str:
    """Returns the id of a teammate's policy, 16 hexadecimal digits that are equal for equal policies of one kind.

    Args:
        teammate: kind and theta, as in a task. The numbers of a heuristic are compared in single precision, since some
            manifests round them.
    """
    theta = teammate["theta"]
    if teammate["kind"] == "rl":
        return theta["sha256"][:16]
    return json_hash({name: float(np.float32(value)) for name, value in theta.items()})


def seen_in(dataset: Dataset) -> SeenInTraining:
    """Returns the record of training on all histories of a selection."""
    _, first = np.unique(dataset.column("task_id"), return_index=True)
    ids: dict[str, set[str | None]] = {}
    for history_id in dataset.ids[first].tolist():
        ids.setdefault(dataset.index.entry(history_id).teammate_kind, set()).add(_recovered_id(dataset, history_id))
    known = {kind: None if None in found else tuple(sorted(map(str, found))) for kind, found in sorted(ids.items())}
    return SeenInTraining(tuple(layout.name for layout in dataset.layouts), known)


def _recovered_id(dataset: Dataset, history_id: int) -> str | None:
    try:
        return teammate_id(dataset.recover_teammate(history_id))
    except (NotStoredError, UnknownNameError):  # a release of observations may have been made without its tasks
        return None


def parse_seen(content: Any, where: str) -> SeenInTraining:
    """Returns the record in JSON values.

    Args:
        content: see `SeenInTraining.to_json`.
        where: origin of the content, for the message.

    Raises:
        OptionError: if it is no such record.
    """
    layouts = content.get("layouts") if isinstance(content, dict) else None
    teammates = content.get("teammates") if isinstance(content, dict) else None
    if not _are_names(layouts) or not isinstance(teammates, dict):
        raise OptionError(
            f"{where}: {SEEN}: expected layouts, a list of names, and teammates, a list of ids by kind; found "
            f"{content!r:.200}"
        )
    for kind, ids in teammates.items():
        if ids is not None and not _are_names(ids):
            raise OptionError(f"{where}: {SEEN}: ids of {kind}: expected a list of names or null, found {ids!r:.200}")
    known = {kind: None if ids is None else tuple(ids) for kind, ids in teammates.items()}
    return SeenInTraining(tuple(layouts), known)


def _are_names(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
