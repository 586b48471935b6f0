"""TODO."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash


@dataclass(frozen=True)
class Result:
    """One task's outcome."""

    task_id: str
    settings: dict[str, Any]
    returns: list[list[float]]  # team return of each episode, by seed

    def to_json(self) -> dict[str, Any]:
        return {"settings_hash": json_hash(self.settings), **asdict(self)}


def _path(out: Path, task_id: str) -> Path:
    return out / "tasks" / f"{task_id}.json"


def _stored(out: Path | None, task: Task, settings: dict[str, Any]) -> Result | None:
    if out is None or not _path(out, task.task_id).exists():
        return None
    path = _path(out, task.task_id)
    result = read_result(path)
    if result.settings != settings:
        raise OptionError(
            f"{path}: holds a result of other settings ({result.settings}), asked for {settings}; give another --out"
        )
    return result


def read_result(path: Path) -> Result:
    """One task's result.

    Raises:
        OptionError: if the file is not a result, or its settings do not match their hash.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        digest = content.pop("settings_hash")
        result = Result(**content)
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise OptionError(f"{path}: not a result: {error!r}; remove it and evaluate again") from error
    if digest != json_hash(result.settings):
        raise OptionError(f"{path}: its settings do not match their hash; remove it and evaluate again")
    return result


def _store(out: Path | None, result: Result) -> None:
    if out is None:
        return
    path = _path(out, result.task_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
