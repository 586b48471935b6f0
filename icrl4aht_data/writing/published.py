"""TODO."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, named_task, read_tasks, write_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import Icrl4ahtError, OptionError, PublishedFormatError
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import (
    ACTION_FIELDS,
    FIELDS,
    OBSERVATIONS,
    PROVENANCE,
    TASKS,
    Kind,
    check_value,
    episode_ends,
    held_fields,
)
from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import parse_json, read_lines, write_json
from icrl4aht_data.utils.paths import resolve_inside
from icrl4aht_data.utils.validation import check_int
from icrl4aht_data.writing.combine import Deferred
from icrl4aht_data.writing.convert import HistoriesDone, _quiet
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

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


FROM_PUBLISHED = np.array([ACTIONS.index(name) for name in PUBLISHED_ACTIONS], np.int32)
"""Action id of the published files -> ours."""


@contextmanager
def _errors_as(what: str) -> Iterator[None]:
    """What h5py raises for a file of others, which may be anything, as ours."""
    try:
        yield
    except Icrl4ahtError:
        raise
    except Exception as error:
        raise PublishedFormatError(f"{what}: {error}") from error


def to_published(
    dataset: Dataset,
    target: Path,
    *,
    chunk: int = PUBLISHED_CHUNK,
    states: bool = True,
    advance: HistoriesDone = _quiet,
) -> Path:
    """The selection as the published code's two files, numbered anew from 0.

    Args:
        dataset: all of a release, or a part.
        target: the folder to make.
        chunk: steps per chunk.
        states: also store the state records, if there are any: without them `from_published` makes a release of
            observations.
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
    kind: Kind = "full" if states and dataset.has_states else OBSERVATIONS
    try:
        with h5py.File(partial / HISTORIES_H5, "w") as file, (partial / HISTORIES_INDEX).open("w") as index:
            for number, history in enumerate(dataset):
                group = file.create_group(f"/{number}")
                for field in history.entry.stored_fields(kind):
                    _write_published(group, field.name, history.read(field.name), chunk)
                line = history.entry.to_json() | {"history_id": number, "h5_group": f"/{number}"}
                index.write(json.dumps({name: line[name] for name in PUBLISHED_FIELDS}) + "\n")
                advance(number + 1, len(dataset))
        wanted = {entry.task_id for entry in dataset.entries}
        tasks = [task for task in read_tasks(dataset.origin.file(TASKS)) if task.task_id in wanted]
        if tasks:
            write_tasks(partial / "tasks.jsonl", tasks)
        provenance = read_provenance(dataset.origin.file(PROVENANCE))
        write_json(
            partial / "provenance.json", {name: value.to_json() for name, value in provenance.items() if name in wanted}
        )
        if target.exists():
            target.rmdir()
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def _write_published(group: h5py.Group, name: str, array: np.ndarray, chunk: int) -> None:
    if name in ACTION_FIELDS:
        array = _TO_PUBLISHED[array]
    elif name == "obs":
        array = array.astype(np.float32)
    chunks = (min(chunk, len(array)), *array.shape[1:])
    group.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=6)


def from_published(
    source: Path,
    target: Path,
    kind: Kind | None = None,
    *,
    tasks: Path | None = None,
    data_version: str = "0.1.0",
    kept_steps: int = KEPT_STEPS,
    advance: HistoriesDone = _quiet,
) -> Kind:
    """A release from a folder with the published code's two files.

    Args:
        source: a folder with `histories.h5` and `histories_index.jsonl`.
        target: the folder to make; a release that is there is replaced.
        kind: by default "lite" if the groups have state records, "observations" if none has.
        tasks: a JSONL file with the tasks that the index names; by default `tasks.jsonl` in `source`. A release of
            observations may do without: it then knows of its tasks what the index says.
        data_version: SemVer of the data.
        kept_steps: steps of every episode; an unfinished one may end a history.
        advance: progress.

    Returns:
        The kind of release that was made.

    Raises:
        PublishedFormatError: if a file is missing or malformed, or a group lacks what a release of that kind is made
            of; names file and group.
    """
    import h5py

    kept_steps = check_int("kept_steps", kept_steps, 1)
    lines = _read_index(resolve_inside(source, HISTORIES_INDEX))
    noted = resolve_inside(source, "provenance.json")
    provenance = read_provenance(noted) if noted.is_file() else {}
    done = iter(range(1, len(lines) + 1))
    path = resolve_inside(source, HISTORIES_H5)
    with _errors_as(f"{path}: cannot be opened as HDF5"):
        file = h5py.File(path, "r")

    def load(members: list[_Group]) -> Iterator[NewHistory]:
        for group in members:
            yield NewHistory(group.line["env_idx"], Deferred(group.names, group.read))
            advance(next(done), len(lines))

    with file:
        made: Kind = kind or _kind_of(file, lines)
        groups = [_Group(file, line, made, kept_steps) for line in lines]
        new = [
            NewTask(
                task, provenance.get(task.task_id, Provenance()), len(members), lambda members=members: load(members)
            )
            for task, members in _tasks_of(groups, source, tasks, made)
        ]
        write_release(target, made, new, data_version=data_version, kept_steps=kept_steps)
    return made


def _kind_of(file: h5py.File, lines: list[dict[str, Any]]) -> Kind:
    """Lite if every group has states, observations if none has."""
    from icrl4aht_data.format.safe_hdf5 import exists

    with _errors_as(f"{file.filename}: cannot be read"):
        groups = [line["h5_group"] for line in lines if exists(file, line["h5_group"])]
        lacking = [group for group in groups if not exists(file, f"{group}/state")]
    if 0 < len(lacking) < len(groups):
        raise PublishedFormatError(
            f"{file.filename}, group {lacking[0]}: lacks state, which other groups have; leave them all out with "
            f"`convert --to observations`"
        )
    return OBSERVATIONS if lacking else "lite"


def _tasks_of(groups: list[_Group], source: Path, path: Path | None, kind: Kind) -> list[tuple[Task, list[_Group]]]:
    """The tasks that the index names, in its order, with their histories."""
    by_task: dict[str, list[_Group]] = {}
    for group in groups:
        by_task.setdefault(group.line["task_id"], []).append(group)
    found = path or resolve_inside(source, "tasks.jsonl")
    if found.is_file():
        known = {task.task_id: task for task in read_tasks(found)}
    elif kind == OBSERVATIONS and path is None:
        known = {name: named_task(members[0].line) for name, members in by_task.items()}
    else:
        raise PublishedFormatError(f"{found}: missing; give a file with the tasks that the index names")
    absent = by_task.keys() - known.keys()
    if absent:
        raise PublishedFormatError(f"{found}: lacks {len(absent)} tasks of the index, such as {min(absent)!r}")
    for group in groups:
        task, line = known[group.line["task_id"]], named_task(group.line)
        one, two = ((t.track, t.split, t.layout.name, t.teammate_family, t.teammate_kind) for t in (line, task))
        if one != two:
            raise PublishedFormatError(
                f"{source / HISTORIES_INDEX}: history {group.line['history_id']} is of {one}, its task "
                f"{task.task_id!r} of {two}; mend the index or the tasks"
            )
    return [(known[name], members) for name, members in by_task.items()]


def _read_index(path: Path) -> list[dict[str, Any]]:
    lines = []
    for number, text in enumerate(read_lines(path), start=1):
        try:
            line = parse_json(text)
            missing = set(PUBLISHED_FIELDS) - set(line) if isinstance(line, dict) else set(PUBLISHED_FIELDS)
            if missing:
                raise PublishedFormatError(f"lacks the fields {sorted(missing)}")
            for name in PUBLISHED_FIELDS:
                check_value(name, line[name])
            named_task(line)
        except Icrl4ahtError as error:
            raise PublishedFormatError(f"{path}, line {number}: {error}") from error
        lines.append(line)
    if not lines:
        raise PublishedFormatError(f"{path}: no histories")
    return lines


class _Group:
    """One history of the published file; its arrays are read, checked and put in our form when they are asked for."""

    def __init__(self, file: h5py.File, line: dict[str, Any], kind: Kind, kept_steps: int) -> None:
        """Looks which arrays are there.

        Raises:
            PublishedFormatError: if one that a release of that kind takes is missing.
        """
        from icrl4aht_data.format import safe_hdf5 as hdf5

        self._file, self.line, self._kept_steps = file, line, kept_steps
        self._layout = get_layout(line["layout"])
        self._where = f"{file.filename}, group {line['h5_group']}"
        with _errors_as(f"{self._where}: cannot be read"):
            group = hdf5.member(file, line["h5_group"]) if hdf5.exists(file, line["h5_group"]) else None
            here = set() if group is None else {name for name in ("obs", *FIELDS) if hdf5.exists(group, name)}
        if not hasattr(group, "keys"):
            raise PublishedFormatError(f"{self._where}: missing, but the index names it")
        self.names = [f.name for f in held_fields(kind) if kind not in f.optional or line[f"has_{f.name}"]]
        missing = [name for name in dict.fromkeys(("obs", *self.names)) if name not in here]
        if missing:
            remedy = "the index promises it; complete the file or mend the index"
            if "state" in missing:
                remedy = (
                    f"a {kind} release is made of state records, which observations do not determine; "
                    f"convert with `--to {OBSERVATIONS}`"
                )
            raise PublishedFormatError(f"{self._where}: lacks {', '.join(missing)}: {remedy}")

    def read(self, name: str) -> np.ndarray:
        """One array: (T, ...), or (E, S) for `episode_end_state`, in the field's compact dtype.

        Raises:
            PublishedFormatError: names the array, and what was expected and found.
        """
        from icrl4aht_data.format.safe_hdf5 import member, read_dataset

        field, steps = FIELDS[name], self.line["T"]
        rows = steps if field.axis == "T" else steps // self._kept_steps
        expected = (rows, *field.held(self._layout).shape)
        with _errors_as(f"{self._where}: {name}: {steps} steps on {self._layout.name}"):
            found = read_dataset(member(self._file, f"{self.line['h5_group']}/{name}"), expected)
        array = self._whole(name, found)
        if name in ACTION_FIELDS:
            return FROM_PUBLISHED[array]
        if name == "dones" and not (array.any() and np.array_equal(array, episode_ends(steps, self._kept_steps))):
            raise PublishedFormatError(
                f"{self._where}: dones: expected an end every {self._kept_steps} steps, found {array.sum()} in {steps} "
                f"steps, the first at {np.flatnonzero(array)[:3].tolist()}; give the episodes' length with --kept-steps"
            )
        if name == "state":
            obs = self.read("obs")
            if not np.array_equal(obs, fast_observe(self._layout, array, np.empty_like(obs))):
                raise PublishedFormatError(f"{self._where}: obs is not what state shows")
        return array

    def _whole(self, name: str, found: np.ndarray) -> np.ndarray:
        """The values in the field's compact dtype, if they are whole numbers of its range."""
        compact = np.dtype(FIELDS[name].compact)
        low, high = (0, 1) if compact.kind == "b" else (np.iinfo(compact).min, np.iinfo(compact).max)
        if name in ACTION_FIELDS:
            low, high = 0, len(ACTIONS) - 1
        with np.errstate(invalid="ignore"):  # what the cast spoils is found by comparing
            array = found.astype(compact)
        wrong = (array != found) | (found < low) | (found > high)
        if wrong.any():
            place = tuple(np.argwhere(wrong)[0].tolist())
            raise PublishedFormatError(
                f"{self._where}: {name}{list(place)}: expected a whole number {low}..{high}, found {found[place]}"
            )
        return array
