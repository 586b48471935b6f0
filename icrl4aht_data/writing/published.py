"""Conversion between releases and the files of the published code.

The published code stores all histories in `histories.h5`, one group each, with float32 observations in gzip-6 chunks of
4096 steps and another order of action ids. The index `histories_index.jsonl` has the paper's 14 fields (App. D.3).
`to_published` also writes `tasks.jsonl`, `provenance.json`, and for each group `state` and `episode_end_state`, which
the published readers ignore. With these files, converting back loses only checkpoints and oracle actions. The published
index has no field for learners, so the streams of a task's learners are numbered consecutively.

Files without states become a release of observations, since states cannot be derived from observations. Without
`tasks.jsonl`, only the names of the tasks are known in such a release.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, named_task, read_tasks, write_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import Icrl4ahtError, PublishedFormatError
from icrl4aht_data.format.provenance import Provenance, ProvenanceByTask, read_provenance
from icrl4aht_data.format.safe_hdf5 import find_node, read_dataset
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS, OBSERVATIONS, Kind, episode_ends, memory_fields
from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import add_filename, resolve_inside, write_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.writing.convert import HistoryProgress
from icrl4aht_data.writing.published_index import PUBLISHED_FIELDS, read_published_index
from icrl4aht_data.writing.published_views import PADDING, complete_views, has_missing_rows
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import HISTORIES_H5, HISTORIES_INDEX, as_path, atomic_folder

PUBLISHED_CHUNK = 4096
"""Number of steps per chunk in the published files."""

_TO_PUBLISHED = np.array([PUBLISHED_ACTIONS.index(name) for name in ACTIONS], np.int32)

FROM_PUBLISHED = np.array([ACTIONS.index(name) for name in PUBLISHED_ACTIONS], np.int32)
"""Action ids of this package by action id of the published files, int32 (6,)."""


def to_published(
    dataset: Dataset,
    target: str | Path,
    *,
    chunk: int = PUBLISHED_CHUNK,
    states: bool = True,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Path:
    """Write a selection of histories in the file format of the paper's code, with history ids from 0.

    Args:
        dataset: a release, or a selection of its histories.
        target: the folder to write.
        chunk: number of steps per chunk.
        states: whether to store the state records, if the release has any; from files without state records,
            `from_published` makes a release of observations.
        overwrite: whether to replace a folder written by this function, or a release.
        advance: function called with the number of written histories and the number of all histories.

    Raises:
        OptionError: if `target` may not be written, see `release_folder.check_target`.
    """
    target = as_path(target)
    kind: Kind = "full" if states and dataset.has_states else OBSERVATIONS
    names = {entry.task_id for entry in dataset.entries}
    provenance = {name: of_task for name, of_task in dataset.provenance.items() if name in names}
    with atomic_folder(target, overwrite=overwrite, sources=[dataset.root]) as folder:
        with _new_hdf5(folder / HISTORIES_H5) as new, (folder / HISTORIES_INDEX).open("w") as index:
            for number, history in enumerate(dataset):
                group = new.create_group(f"/{number}")
                for field in (one for one in history.entry.stored_fields(kind) if one.name != "oracle_actions"):
                    _write_published_array(group, field.name, history.read(field.name), chunk)
                line = history.entry.to_json() | {"history_id": number, "h5_group": f"/{number}"}
                line["env_idx"] += history.entry.learner * _streams_per_learner(provenance.get(history.entry.task_id))
                index.write(json.dumps({name: line[name] for name in PUBLISHED_FIELDS}) + "\n")
                advance(number + 1, len(dataset))
        tasks = [task for name, task in dataset.tasks.items() if name in names]
        if tasks:
            write_tasks(folder / "tasks.jsonl", tasks)
        write_json(folder / "provenance.json", {name: of_task.to_json() for name, of_task in provenance.items()})
    return target


class _SafeFile(io.FileIO):
    """File that stores write errors instead of raising them, because libhdf5 may crash on a full disk.

    Attributes:
        error: the first write error; later writes do nothing.
    """

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        view, done = memoryview(data).cast("B"), 0
        try:
            while self.error is None and done < len(view):  # a full disk may cut a write short
                done += super().write(view[done:]) or 0
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0


@contextmanager
def _new_hdf5(path: Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file to write to; raise OSError with the file's name if the disk is full."""
    with add_filename(path), _SafeFile(path, "w+") as stream:
        with h5py.File(stream, "w") as file:
            yield file
        if stream.error is not None:
            raise stream.error


def _streams_per_learner(provenance: Provenance | None) -> int:
    """Return the number of `env_idx` values that `to_published` reserves for each learner of a task.

    This is the number of environments in the ego's training, or 2**31 if the provenance does not record an ego.
    """
    ego = None if provenance is None else provenance.ego
    return 2**31 if ego is None else ego["environments"]


def _write_published_array(group: h5py.Group, name: str, array: np.ndarray, chunk: int) -> None:
    if name in ACTION_FIELDS:
        array = _TO_PUBLISHED[array]
    elif name == "obs":
        array = array.astype(np.float32)
    chunks = (min(chunk, len(array)), *array.shape[1:])
    group.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=6)


def from_published(
    source: str | Path,
    target: str | Path,
    kind: Kind | None = None,
    *,
    data_version: str = "0.1.0",
    kept_steps: int = KEPT_STEPS,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Kind:
    """Write a release from files of the published code.

    The published names of teammates are translated: family `fcp` of kind `rl` becomes family `rl` of kind `fcp`. Views
    of 4 x 5 cells on the cramped layouts are padded to 5 x 5.

    Args:
        source: a folder with `histories.h5`, `histories_index.jsonl` and the tasks of the index in `tasks.jsonl`.
            Without `tasks.jsonl`, the result can only be a release of observations, in which tasks have only names.
        target: the folder to write.
        kind: kind of the release; by default "lite" if a group has state records, else "observations".
        data_version: version of the data, in the form of SemVer.
        kept_steps: number of steps of every episode; the last episode of a history may be unfinished.
        overwrite: whether to replace a release at `target`.
        advance: function called with the number of converted histories and the number of all histories.

    Returns:
        The kind of the written release.

    Raises:
        OptionError: if `target` may not be written, see `release_folder.check_target`.
        PublishedFormatError: if a file is missing or malformed, if an array that the kind of release needs is
            missing from a group, or if two histories have the same group, or the same task and `env_idx`; the message
            has the file and the group.
    """
    kept_steps, source = check_int("kept_steps", kept_steps, 1), as_path(source)
    lines = read_published_index(resolve_inside(source, HISTORIES_INDEX))
    provenance_path = resolve_inside(source, "provenance.json")
    provenance = read_provenance(provenance_path) if provenance_path.is_file() else ProvenanceByTask()
    numbers = iter(range(1, len(lines) + 1))
    path = resolve_inside(source, HISTORIES_H5)
    with _wrap_errors(f"{path}: cannot be opened as HDF5"):
        file = h5py.File(path, "r")

    def load_histories(task: Task, groups: list[_PublishedHistory]) -> Iterator[NewHistory]:
        made = provenance.of(task.task_id)
        for group in groups:
            learner, stream = 0, group.line["env_idx"]
            if (made.learners or 1) > 1:
                learner, stream = divmod(stream, _streams_per_learner(made))
            yield NewHistory(stream, {name: group.read(name) for name in group.field_names()}, learner)
            advance(next(numbers), len(lines))

    with file:
        present = [_array_names(file, line["h5_group"]) for line in lines]
        found: Kind = kind or ("lite" if any("state" in names for names in present) else OBSERVATIONS)
        histories = [_PublishedHistory(file, line, found, kept_steps) for line in lines]
        for history, names in zip(histories, present, strict=True):
            history.check_arrays(names)
        new = [
            NewTask(
                task,
                _with_padding_note(provenance.of(task.task_id), members[0]),
                len(members),
                lambda task=task, members=members: load_histories(task, members),
            )
            for task, members in _tasks(histories, source, found)
        ]
        write_release(
            target, found, new, data_version=data_version, kept_steps=kept_steps, overwrite=overwrite, sources=[source]
        )
    return found


@contextmanager
def _wrap_errors(what: str) -> Iterator[None]:
    """Raise any error of h5py as `PublishedFormatError`, since damaged files cause errors of any type."""
    try:
        yield
    except Icrl4ahtError:
        raise
    except Exception as error:
        raise PublishedFormatError(f"{what}: {error}") from error


def _with_padding_note(provenance: Provenance, history: _PublishedHistory) -> Provenance:
    """Return the provenance, and add a note about padding if the history's observations will be padded."""
    if not (history.needs_padding and history.kind == OBSERVATIONS):
        return provenance
    rows = get_layout(history.line["layout"]).height
    notes = {"obs_shape": history.line["obs_shape"], "padding": PADDING.format(rows=rows)}
    return msgspec.structs.replace(provenance, other={**provenance.other, "published": notes})


def _array_names(file: h5py.File, group: str) -> set[str]:
    """Return the names of the known arrays in a group."""
    where = f"{file.filename}, group {group}"
    with _wrap_errors(f"{where}: cannot be read"):
        found = find_node(file, group)
        if not isinstance(found, h5py.Group):
            raise PublishedFormatError(f"{where} is missing, but the index has a line for it")
        return {name for name in FIELDS if find_node(found, name)}


def _tasks(histories: list[_PublishedHistory], source: Path, kind: Kind) -> list[tuple[Task, list[_PublishedHistory]]]:
    """Return the tasks of the index with their histories, in the order of the index."""
    by_task = grouped(histories, lambda history: history.line["task_id"])
    found = resolve_inside(source, "tasks.jsonl")
    if found.is_file():
        known = {task.task_id: task for task in read_tasks(found)}
    elif kind == OBSERVATIONS:
        known = {name: named_task(members[0].line) for name, members in by_task.items()}
    else:
        raise PublishedFormatError(f"{found} is missing; add a file with the tasks that the index names")
    absent = by_task.keys() - known.keys()
    if absent:
        raise PublishedFormatError(f"{found}: {len(absent)} tasks of the index are missing, such as {min(absent)!r}")
    for history in histories:
        task, line = known[history.line["task_id"]], named_task(history.line)
        one, two = ((t.track, t.split, t.layout.name, t.teammate_family, t.teammate_kind) for t in (line, task))
        if one != two:
            raise PublishedFormatError(
                f"{source / HISTORIES_INDEX}: history {history.line['history_id']}: expected track, split, layout, "
                f"family and kind {two} as in task {task.task_id!r}, found {one}; correct the index or the tasks"
            )
    return [(known[name], members) for name, members in by_task.items()]


@dataclass(frozen=True)
class _PublishedHistory:
    """One history of a published file; its arrays are read, checked and converted on access.

    Args:
        file: the open HDF5 file.
        line: the history's line of the index.
        kind: kind of the release to write.
        kept_steps: number of steps of every episode.
    """

    file: h5py.File
    line: dict[str, Any]
    kind: Kind
    kept_steps: int

    @property
    def location(self) -> str:
        """Names of the file and of the history's group, for messages."""
        return f"{self.file.filename}, group {self.line['h5_group']}"

    @property
    def needs_padding(self) -> bool:
        """Whether the observations have fewer than 5 rows and need padding, see `published_views`."""
        return has_missing_rows(get_layout(self.line["layout"]), self.line["obs_shape"])

    def field_names(self) -> list[str]:
        """Return the names of the arrays to convert."""
        fields = memory_fields(self.kind)
        return [f.name for f in fields if self.kind not in f.optional or self.line.get(f"has_{f.name}")]

    def check_arrays(self, present: set[str]) -> None:
        """Check that the history's group has `obs` and all arrays to convert.

        Args:
            present: names of the arrays in the group.

        Raises:
            PublishedFormatError: if arrays are missing; the message has the group and the names of the arrays.
        """
        missing = [name for name in dict.fromkeys(("obs", *self.field_names())) if name not in present]
        if missing:
            raise PublishedFormatError(
                f"{self.location}: missing {', '.join(missing)}: complete the file or correct the index; if state "
                f"records are missing, convert with `--to {OBSERVATIONS}`"
            )

    def read(self, name: str) -> np.ndarray:
        """Return one array in its field's compact dtype, of shape (T, ...); `episode_end_state` has the shape (E, S).

        Raises:
            PublishedFormatError: if the array is invalid; the message has its name and the expected and found values.
        """
        layout, steps = get_layout(self.line["layout"]), self.line["T"]
        array = self._read_recorded(name)
        if name == "obs" and self.needs_padding:
            try:
                return complete_views(layout, array)
            except PublishedFormatError as error:
                raise PublishedFormatError(f"{self.location}: obs: {error}") from error
        if name in ACTION_FIELDS:
            return FROM_PUBLISHED[array]
        if name == "dones" and not (array.any() and np.array_equal(array, episode_ends(steps, self.kept_steps))):
            raise PublishedFormatError(
                f"{self.location}: dones: expected an episode end every {self.kept_steps} steps, found {array.sum()} "
                f"in {steps} steps, first at {np.flatnonzero(array)[:3].tolist()}; give the steps "
                f"of an episode with --kept-steps"
            )
        if name == "state":
            obs, shown = self._read_recorded("obs"), np.empty((steps, *layout.obs_shape), np.uint8)
            if not np.array_equal(obs, fast_observe(layout, array, shown)[:, : obs.shape[1]]):
                raise PublishedFormatError(f"{self.location}: obs does not match the observations rendered from state")
        return array

    def _read_recorded(self, name: str) -> np.ndarray:
        """Return one array as recorded, without padding of observations, in the field's compact dtype."""
        field, layout, steps = FIELDS[name], get_layout(self.line["layout"]), self.line["T"]
        rows = steps if field.axis == "T" else steps // self.kept_steps
        shape = self.line["obs_shape"] if name == "obs" and self.needs_padding else field.memory_dtype(layout).shape
        with _wrap_errors(f"{self.location}: {name}: {steps} steps on {layout.name}"):
            found = read_dataset(find_node(self.file, f"{self.line['h5_group']}/{name}"), (rows, *shape))
        compact = np.dtype(field.compact)
        low, high = (0, 1) if compact.kind == "b" else (np.iinfo(compact).min, np.iinfo(compact).max)
        if name in ACTION_FIELDS:
            low, high = 0, len(ACTIONS) - 1
        with np.errstate(invalid="ignore"):  # the comparison below finds values that the cast changes
            array = found.astype(compact)
        wrong = (array != found) | (found < low) | (found > high)
        if wrong.any():
            first = tuple(np.argwhere(wrong)[0].tolist())
            raise PublishedFormatError(
                f"{self.location}: {name}{list(first)}: expected an integer {low}..{high}, found {found[first]}"
            )
        return array
