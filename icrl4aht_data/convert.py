"""Releases in other forms: full <-> lite, the published code's two files, a Parquet index.

The published code keeps all histories in `histories.h5`, a group each, observations as float32 in gzip-6 chunks of 4096
steps, action ids in its own order, and an index `histories_index.jsonl` of the paper's 14 fields (App. D.3). What we
write beside that, its readers pass over: each group's `state` and `episode_end_state`, `tasks.jsonl` and
`provenance.json`. With them the way back loses nothing; without states there is no way back, since an observation shows
a part of the kitchen only.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.benchmark import ACTIONS, KEPT_STEPS, PUBLISHED_ACTIONS
from icrl4aht_data.combine import stored_histories
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import Icrl4ahtError, OptionError, PublishedFormatError
from icrl4aht_data.files import file_in_place_of, parse_json, read_text, write_json
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.paint import paint
from icrl4aht_data.release import NewHistory, NewTask, checkpoint_files, write_release
from icrl4aht_data.schema import PROVENANCE, TASKS, TEAMMATES, Kind
from icrl4aht_data.store import HELD
from icrl4aht_data.tasks import Task, read_tasks, write_tasks

if TYPE_CHECKING:
    import h5py

HISTORIES_H5, HISTORIES_INDEX = "histories.h5", "histories_index.jsonl"
"""File names of the published code."""

PUBLISHED_CHUNK = 4096
"""Steps per chunk in the published files."""

PUBLISHED_FIELDS = (
    "history_id",
    "task_id",
    "env_idx",
    "T",
    "obs_shape",
    "action_dim",
    "track",
    "split",
    "layout",
    "teammate_family",
    "teammate_kind",
    "h5_group",
    "has_teammate_actions",
    "has_expert_actions",
)
"""Fields of an index line (paper, App. D.3)."""

_TO_PUBLISHED = np.array([PUBLISHED_ACTIONS.index(name) for name in ACTIONS], np.int32)
_FROM_PUBLISHED = np.array([ACTIONS.index(name) for name in PUBLISHED_ACTIONS], np.int32)
_ACTIONS = ("actions", "teammate_actions", "expert_actions")

Advance = Callable[[int, int], None]
"""Called with how many histories are done, and how many there are."""


def _quiet(done: int, total: int) -> None:
    pass


def to_release(dataset: Dataset, target: Path, kind: Kind, *, advance: Advance = _quiet) -> Path:
    """The selection as a release of that kind, histories in order, numbered anew from 0.

    Args:
        dataset: all of a release, or a part.
        target: the folder to make; a release that is there is replaced.
        kind: "full" or "lite".
        advance: progress.

    Raises:
        OptionError: if `target` holds something else, or is the dataset's own folder.
    """
    if target.resolve() == dataset.root.resolve():
        raise OptionError(f"{target}: the release itself; give another folder")
    given = {task.task_id: task for task in read_tasks(dataset.root / TASKS)}
    provenance = _read_json(dataset.root / PROVENANCE)
    by_task: dict[str, list[int]] = {}
    for entry in dataset.entries:
        by_task.setdefault(entry.task_id, []).append(entry.history_id)
    done = iter(range(1, len(dataset) + 1))

    def load(ids: list[int]) -> Iterator[NewHistory]:
        for history in stored_histories(dataset.select(ids)):
            yield history
            advance(next(done), len(dataset))

    tasks = [
        NewTask(
            given[name],
            provenance.get(name, {}),
            len(ids),
            lambda ids=ids: load(ids),
            checkpoint_files(dataset.root / TEAMMATES, given[name]),
        )
        for name, ids in by_task.items()
    ]
    return write_release(
        target,
        kind,
        tasks,
        data_version=dataset.info["data_version"],
        card=read_text(dataset.root / "README.md"),
        kept_steps=dataset.info["environment"]["kept_steps"],
    )


def _read_json(path: Path) -> Any:
    try:
        return parse_json(read_text(path))
    except Icrl4ahtError as error:
        raise PublishedFormatError(f"{path}: {error}") from error


def to_published(
    dataset: Dataset, target: Path, *, chunk: int = PUBLISHED_CHUNK, states: bool = True, advance: Advance = _quiet
) -> Path:
    """The selection as the published code's two files, numbered anew from 0.

    Args:
        dataset: all of a release, or a part.
        target: the folder to make.
        chunk: steps per chunk.
        states: also store the state records, without which `from_published` cannot make a release.
        advance: progress.

    Raises:
        OptionError: if `target` exists and is not empty.
    """
    import h5py

    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OptionError(f"{target}: exists; give a new folder")
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        with h5py.File(partial / HISTORIES_H5, "w") as file, (partial / HISTORIES_INDEX).open("w") as index:
            for number, history in enumerate(dataset):
                group = file.create_group(f"/{number}")
                for field in history.entry.stored_fields("full"):
                    if states or field.row != "state":
                        _write_published(group, field.name, history.read(field.name), chunk)
                line = history.entry.to_json() | {"history_id": number, "h5_group": f"/{number}"}
                index.write(json.dumps({name: line[name] for name in PUBLISHED_FIELDS}) + "\n")
                advance(number + 1, len(dataset))
        wanted = {entry.task_id for entry in dataset.entries}
        write_tasks(partial / "tasks.jsonl", [t for t in read_tasks(dataset.root / TASKS) if t.task_id in wanted])
        provenance = _read_json(dataset.root / PROVENANCE)
        write_json(partial / "provenance.json", {name: value for name, value in provenance.items() if name in wanted})
        if target.exists():
            target.rmdir()
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def _write_published(group: h5py.Group, name: str, array: np.ndarray, chunk: int) -> None:
    if name in _ACTIONS:
        array = _TO_PUBLISHED[array]
    elif name == "obs":
        array = array.astype(np.float32)
    chunks = (min(chunk, len(array)), *array.shape[1:])
    group.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=6)


def from_published(
    source: Path,
    target: Path,
    kind: Kind,
    *,
    tasks: Path | None = None,
    data_version: str = "0.1.0",
    kept_steps: int = KEPT_STEPS,
    advance: Advance = _quiet,
) -> Path:
    """A release from a folder with the published code's two files.

    Args:
        source: a folder with `histories.h5` and `histories_index.jsonl`.
        target: the folder to make; a release that is there is replaced.
        kind: "full" or "lite".
        tasks: a JSONL file with the tasks that the index names; by default `tasks.jsonl` in `source`.
        data_version: SemVer of the data.
        kept_steps: steps of every episode.
        advance: progress.

    Raises:
        PublishedFormatError: if a file is missing or malformed, or a group lacks the state records; names it.
    """
    import h5py

    lines = _read_index(source / HISTORIES_INDEX)
    tasks = source / "tasks.jsonl" if tasks is None else tasks
    if not tasks.is_file():
        raise PublishedFormatError(f"{tasks}: missing; give a file with the tasks that the index names")
    known = {task.task_id: task for task in read_tasks(tasks)}
    noted = source / "provenance.json"
    provenance = _read_json(noted) if noted.is_file() else {}
    by_task: dict[str, list[dict]] = {}
    for line in lines:
        by_task.setdefault(line["task_id"], []).append(line)
    absent = by_task.keys() - known.keys()
    if absent:
        raise PublishedFormatError(f"{tasks}: lacks {len(absent)} tasks of the index, such as {min(absent)!r}")
    done = iter(range(1, len(lines) + 1))
    try:
        file = h5py.File(source / HISTORIES_H5, "r")
    except OSError as error:
        raise PublishedFormatError(f"{source / HISTORIES_H5}: cannot be opened as HDF5: {error}") from error

    def load(task: Task, members: list[dict]) -> Iterator[NewHistory]:
        for line in members:
            yield NewHistory(line["env_idx"], _read_published(file, source / HISTORIES_H5, task, line))
            advance(next(done), len(lines))

    with file:
        new = [
            NewTask(known[name], provenance.get(name, {}), len(members), lambda n=name, m=members: load(known[n], m))
            for name, members in by_task.items()
        ]
        card = f"# Converted from {HISTORIES_H5}\n"
        return write_release(target, kind, new, data_version=data_version, card=card, kept_steps=kept_steps)


def _read_index(path: Path) -> list[dict[str, Any]]:
    lines = []
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        try:
            line = parse_json(text)
        except Icrl4ahtError as error:
            raise PublishedFormatError(f"{path}, line {number}: {error}") from error
        missing = set(PUBLISHED_FIELDS) - set(line) if isinstance(line, dict) else set(PUBLISHED_FIELDS)
        if missing:
            raise PublishedFormatError(f"{path}, line {number}: lacks the fields {sorted(missing)}")
        lines.append(line)
    if not lines:
        raise PublishedFormatError(f"{path}: no histories")
    return lines


def _read_published(file: h5py.File, path: Path, task: Task, line: dict[str, Any]) -> dict[str, np.ndarray]:
    """A group's arrays in our action order; its observations are checked against its states."""
    where, layout = f"{path}, group {line['h5_group']}", get_layout(line["layout"])
    names = [name for name in HELD if name != "expert_actions" or line["has_expert_actions"]]
    try:
        group: Any = file[line["h5_group"]]
        missing = [name for name in ("obs", *names) if name not in group]
        if missing:
            raise PublishedFormatError(
                f"{where}: lacks {', '.join(missing)}; a release is made of state records, which observations alone do "
                f"not determine: convert from a release, or from files that `convert --to published` wrote"
            )
        arrays = {name: group[name][()] for name in names}
        obs = group["obs"][()]
    except (KeyError, OSError, ValueError) as error:
        raise PublishedFormatError(f"{where}: {error}") from error
    if obs.shape != (line["T"], *layout.obs_shape) or task.layout != layout:
        raise PublishedFormatError(
            f"{where}: expected obs of shape {(line['T'], *layout.obs_shape)} on {task.layout.name}, found {obs.shape} "
            f"on {layout.name}"
        )
    if not np.array_equal(obs, paint(layout, arrays["state"], np.empty(obs.shape, np.uint8))):
        raise PublishedFormatError(f"{where}: obs is not what state shows")
    for name in _ACTIONS:
        if name in arrays:
            if arrays[name].min() < 0 or arrays[name].max() >= len(ACTIONS):
                raise PublishedFormatError(f"{where}: {name}: expected 0..{len(ACTIONS) - 1}")
            arrays[name] = _FROM_PUBLISHED[arrays[name]]
    return arrays


def to_parquet(dataset: Dataset, path: Path) -> Path:
    """The selection's index as a Parquet file, one row a history. Needs pyarrow, which the extra `hf` brings.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise OptionError("Parquet needs pyarrow: pip install icrl4aht-data[hf]") from error
    with_rows = pa.Table.from_pylist([entry.to_json() for entry in dataset.entries])
    with file_in_place_of(path) as partial:
        pq.write_table(with_rows, partial)
    return path
