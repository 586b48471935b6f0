"""What stands beside results for the report: `run.json` of a trained model, `tasks.jsonl` of unpublished tasks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from baselines.report.results import ABOUT, OWN_TASKS
from baselines.training.run_folder import read_config
from icrl4aht_data.benchmark.tasks import Task, read_tasks, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash, write_json


def note_results(results: Path, run: str | Path | None = None, tasks: Sequence[Task] = ()) -> None:
    """After an evaluation: what a report of it will need beside the results.

    Args:
        results: their folder.
        run: the folder of the model that is evaluated, if it is one.
        tasks: those that are played, if they are not the published ones.
    """
    results.mkdir(parents=True, exist_ok=True)
    if run is not None:
        note_run(Path(run), results)
    if tasks:
        path = results / OWN_TASKS
        known = {task.task_id: task for task in read_tasks(path)} if path.exists() else {}
        with atomic_write(path) as partial:
            write_tasks(partial, (known | {task.task_id: task for task in tasks}).values())


def note_run(run: Path, results: Path) -> None:
    """Write run.json beside results: the run's folder, settings and their hash, and the hash of its data's manifest.

    Raises:
        OptionError: if the folder is not a run on learning histories.
    """
    config = read_config(run)
    if "histories" not in config:
        raise OptionError(f"{run}: its config.json has no `histories`: expected a run on learning histories")
    content: dict[str, Any] = {
        "run": str(run.resolve()),
        "run_hash": json_hash(config),
        "manifest_sha256": config["histories"]["manifest_sha256"],
        "config": config,
    }
    with atomic_write(results / ABOUT) as partial:
        write_json(partial, content)
