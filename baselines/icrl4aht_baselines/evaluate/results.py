"""Results of an evaluation: one JSON file per task, which also holds the settings of the evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from icrl4aht_baselines.evaluate.protocols import PlannedTask
from icrl4aht_baselines.training.run_folder import check_same_settings
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import check_folder_content, json_hash, write_atomically


@dataclass(frozen=True)
class Result:
    """Result of an ego on one task.

    Attributes:
        task_id: id of the task.
        settings: agent, seeds, protocol, code version and further details that the result depends on.
        returns: return of the team in each episode, as one list per seed with one number per episode.
        partners: for each segment, id of the task that the teammate comes from, see `evaluate.protocols`; empty if the
            task's teammate played all episodes.
    """

    task_id: str
    settings: dict[str, Any]
    returns: list[list[float]]
    partners: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the result's JSON file, without `partners` if the list is empty."""
        content = {"settings_hash": json_hash(self.settings), **asdict(self)}
        return {name: value for name, value in content.items() if name != "partners" or value}


RESULTS = "tasks"
"""Name of the subfolder with the JSON files, in a folder of results."""


def result_path(out: Path, task_id: str) -> Path:
    """Return the path of a task's result in a folder of results."""
    return out / RESULTS / f"{task_id}.json"


def find_results(out: Path, planned: Sequence[PlannedTask], settings: dict[str, Any]) -> dict[str, Result]:
    """Return the planned tasks' results that a folder contains, by task id; tasks without a result are left out.

    Args:
        out: folder of results.
        planned: tasks to find results of, with the partners that the results must have.
        settings: settings that the results must have.

    Raises:
        OptionError: if a result has other settings or partners, a file is damaged, or the folder has other files and no
            results.
    """
    if not (out / RESULTS).is_dir():
        check_folder_content(out, (), "results of `evaluate`")
    found = {}
    for plan in planned:
        path = result_path(out, plan.task.task_id)
        if not path.exists():
            continue
        result = read_result(path)
        found[result.task_id] = result
        check_same_settings(result.settings, settings, f"{path}: holds a result")
        if result.partners != [*plan.partners]:
            raise OptionError(
                f"{path}: holds a result with the teammates of {', '.join(result.partners)}, expected those of "
                f"{', '.join(plan.partners)}, which follow from the tasks: give the same tasks again, or another --out"
            )
    return found


def read_result(path: Path) -> Result:
    """Return the result that is stored in a JSON file.

    Raises:
        OptionError: if the file is not a result, or its settings do not match their hash.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        digest = content.pop("settings_hash")
        result = Result(**content)
    except (ValueError, KeyError, TypeError, AttributeError) as error:  # ValueError: no JSON, or no UTF-8
        raise OptionError(f"{path}: not a result: {error!r}; remove the file and evaluate again") from error
    if digest != json_hash(result.settings):
        raise OptionError(f"{path}: the settings do not match their hash; remove the file and evaluate again")
    return result


def write_result(out: Path, result: Result) -> None:
    """Write a task's result into a folder of results."""
    path = result_path(out, result.task_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(result.to_json(), indent=1) + "\n")
