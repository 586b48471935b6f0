"""Writer of a release folder: shards, chunk tables, index, tasks, statistics, manifest. All of it appears, or none."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import NamedTask, Task, write_tasks
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.format.info import LeftOutTask, check_version, describe, shard_sizes
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import (
    ALL_KINDS,
    HISTORIES,
    INFO,
    KINDS,
    OBSERVATIONS,
    PROVENANCE,
    RELEASE_CARD,
    SOURCE_CARD,
    TASKS,
    Entry,
    Kind,
    curve_ends,
    episode_ends,
    episode_returns,
    held_fields,
    stream_score,
)
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.reading.history import History
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.writing.card import write_card
from icrl4aht_data.writing.release_folder import as_path, atomic_folder
from icrl4aht_data.writing.shard_writer import EncodedChunk, encode_history, write_shard
from icrl4aht_data.writing.statistics import layout_statistics

SHARD_BYTES = 256 * 2**20
"""Intended size of a shard; small releases have smaller ones."""


@dataclass(frozen=True)
class NewHistory:
    """One history to write.

    Args:
        env_idx: environment stream within the learner's parallel rollout, or number of a noise history.
        arrays: field name -> array, for the fields `schema.held_fields` of the release's kind; a full release renders
            `obs` from the states. Accessing a mapping may read the array, so that few are in memory at a time.
        learner: which of the task's independent learners made it, from 0.
    """

    env_idx: int
    arrays: Mapping[str, np.ndarray]
    learner: int = 0

    @classmethod
    def from_history(cls, history: History) -> NewHistory:
        """Return a history of any release with states, as a lite release stores it."""
        names = [field.name for field in history.entry.stored_fields("lite")]
        return cls(history.entry.env_idx, {name: history.read(name) for name in names}, history.entry.learner)


@dataclass(frozen=True)
class NewTask:
    """One task to write, with its histories.

    Args:
        task: the task; a `NamedTask` only in a release of observations.
        provenance: how its histories were made; `source`, "ppo" where it says none, is that of their index entries.
        streams: the number of histories that `load` returns, of all learners.
        load: returns the histories; called once, when their shard is written.
        files: path in the release -> file to copy there; see `checkpoint_files`.
    """

    task: Task
    provenance: Provenance
    streams: int
    load: Callable[[], Iterable[NewHistory]]
    files: Mapping[str, Path] = field(default_factory=dict)


def write_release(
    target: str | Path,
    kind: Kind,
    tasks: Iterable[NewTask],
    *,
    data_version: str,
    card: str | None = None,
    source_card: str | None = None,
    kept_steps: int = KEPT_STEPS,
    left_out: Sequence[LeftOutTask] = (),
    files: Mapping[str, Path] = MappingProxyType({}),
    shard_histories: int = 1024,
    shard_bytes: int = SHARD_BYTES,
    overwrite: bool = False,
    sources: Iterable[str | Path] = (),
    done: Callable[[Task], None] = lambda task: None,
) -> Path:
    """Write a release folder, which appears when it is complete.

    Args:
        target: the folder to write.
        kind: "full" (observations stored), "lite" (observations rendered from the states on reading) or "observations"
            (no states; an unfinished episode may end a history).
        tasks: the tasks to write; their histories are numbered in this order.
        data_version: version of the data, SemVer.
        card: README.md of the release; by default `card.write_card` describes the release.
        source_card: cards of the releases that this one is made of, to keep with its own.
        kept_steps: steps of every episode.
        left_out: tasks without histories, to be listed in meta/info.json.
        files: path in the release -> file to copy there, such as a figure that the card shows.
        shard_histories: maximum number of histories in a shard.
        shard_bytes: intended size of a shard, estimated from the first history of each layout.
        overwrite: replace a release at `target`, if nothing else is in its folder.
        sources: folders that the tasks are read from; `target` must be outside of them, and they outside of it.
        done: called after the histories of a task, for progress.

    Raises:
        UnknownNameError: if there is no such kind.
        OptionError: if `target` may not be written, see `release_folder.check_target`, if there is no task or one
            twice, if only some tasks are known by name only, or if a history's arrays are missing, of unequal length or
            lossy.
    """
    target = as_path(target)
    check_version(data_version)
    if kind not in ALL_KINDS:
        raise unknown("kind", kind, ALL_KINDS)
    new = list(tasks)
    ids = [task.task.task_id for task in new]
    if not new or len(set(ids)) < len(ids):
        raise OptionError(f"expected at least one task and none twice, found {ids}")
    named = [task.task.task_id for task in new if isinstance(task.task, NamedTask)]
    if named and (kind in KINDS or len(named) < len(ids)):
        raise OptionError(
            f"{len(named)} of {len(ids)} tasks, such as {named[0]!r}, are known by name only: give all tasks or, in a "
            f"release of {OBSERVATIONS}, none"
        )
    with atomic_folder(target, overwrite=overwrite, sources=sources) as root:
        writer = _ShardWriter(root, kind, kept_steps, shard_histories, shard_bytes, done)
        groups: dict[tuple[str, str, str], list[NewTask]] = defaultdict(list)
        for one in new:
            groups[one.task.track, one.task.layout.name, one.task.split].append(one)
        for (track, layout, split), members in groups.items():
            writer.write(f"data/{track}/{layout}/{split}", members)
        for name, source in chain(files.items(), *(one.files.items() for one in new)):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, root / name)
        _write_meta(root, kind, new, writer.entries, data_version, kept_steps, left_out)
        if source_card is not None:
            (root / SOURCE_CARD).write_text(source_card, encoding="utf-8")
        if card is None:
            write_card(root)
        else:
            (root / RELEASE_CARD).write_text(card, encoding="utf-8")
        write_manifest(root)
    return target


def _write_meta(
    root: Path,
    kind: Kind,
    new: list[NewTask],
    entries: list[Entry],
    data_version: str,
    kept_steps: int,
    left_out: Sequence[LeftOutTask],
) -> None:
    """Write index, tasks, provenance and info."""
    with (root / HISTORIES).open("w", encoding="utf-8") as stream:
        stream.writelines(json.dumps(entry.to_json()) + "\n" for entry in entries)
    tasks = [one.task for one in new if not isinstance(one.task, NamedTask)]
    write_tasks(root / TASKS, tasks)
    provenance = {one.task.task_id: one.provenance for one in new}
    write_json(root / PROVENANCE, {task_id: of_task.to_json() for task_id, of_task in provenance.items()})
    sizes = shard_sizes(root, entries)
    statistics = layout_statistics(entries, tasks, provenance, kept_steps, sizes)
    info = describe(kind, data_version, kept_steps, entries)
    info = replace(info, shards=sizes, statistics=statistics, left_out=list(left_out))
    write_json(root / INFO, info.to_json())


class _LoadedHistory(NamedTuple):
    """One history to write.

    Attributes:
        task: the task of the history.
        entry: the index entry, without id and position in a shard.
        arrays: field -> array (T, ...), or (E, S) for `episode_end_state`.
    """

    task: Task
    entry: Entry
    arrays: Mapping[str, np.ndarray]


@dataclass
class _ShardWriter:
    """Writer of a release's shards; `entries` are the index entries of the histories written so far."""

    root: Path
    kind: Kind
    kept_steps: int
    shard_histories: int
    shard_bytes: int
    done: Callable[[Task], None]
    entries: list[Entry] = field(default_factory=list)

    def write(self, stem: str, tasks: list[NewTask]) -> None:
        """Write the histories of tasks of one track, layout and split into the shards `stem`-*.h5."""
        histories = (history for new in tasks for history in self._load(new))
        total = sum(new.streams for new in tasks)
        first = list(islice(histories, 1))
        encoded = [self._encode(history) for history in first]
        size = sum(len(chunk.data) for chunks in encoded for chunk in chunks)
        shards = max(1, -(-total // self.shard_histories), min(total, round(total * size / self.shard_bytes)))
        histories = chain(first, histories)
        for number in range(shards):
            part = list(islice(histories, total * (number + 1) // shards - total * number // shards))
            name = f"{stem}-{number:05}-of-{shards:05}.h5"
            entries = self._with_positions([history.entry for history in part], name)
            chunks = chain(encoded, (self._encode(history) for history in part[len(encoded) :]))
            write_shard(self.root, name, self.kind, entries, chunks)
            self.entries += entries
            encoded = []
        for _ in histories:  # to the end, where `_load` notices a wrong count and reports the last task
            pass

    def _load(self, new: NewTask) -> Iterator[_LoadedHistory]:
        given = 0
        for history in new.load():
            yield _LoadedHistory(new.task, self._entry(new, history), history.arrays)
            given += 1
        if given != new.streams:
            raise OptionError(f"task {new.task.task_id}: {given} histories, but {new.streams} were announced")
        self.done(new.task)

    def _encode(self, history: _LoadedHistory) -> list[EncodedChunk]:
        arrays = history.arrays
        if self.kind == "full":
            arrays = {**arrays, "obs": observe(history.task.layout, arrays["state"], EGO)}
        return encode_history(self.kind, history.entry, arrays)

    def _entry(self, new: NewTask, history: NewHistory) -> Entry:
        """Return the index entry of a history, without id and position in a shard."""
        arrays, task = history.arrays, new.task
        if not 0 <= history.env_idx < 2**63:
            raise OptionError(
                f"task {task.task_id}: env_idx: expected a stream's number from 0, found {history.env_idx}"
            )
        if not 0 <= history.learner < (learners := new.provenance.learners or 1):
            raise OptionError(
                f"task {task.task_id}: learner: expected 0 to {learners - 1}, since provenance has {learners} "
                f"learners, found {history.learner}"
            )
        needed = {field.name for field in held_fields(self.kind) if self.kind not in field.optional}
        if not needed <= arrays.keys():
            raise OptionError(f"task {task.task_id}: a history has no arrays {sorted(needed - arrays.keys())}")
        dones = arrays["dones"]
        unfinished = len(dones) % self.kept_steps if self.kind in KINDS else len(dones) < self.kept_steps
        if unfinished or not np.array_equal(dones, episode_ends(len(dones), self.kept_steps)):
            raise OptionError(f"task {task.task_id}: a history's episodes do not all have {self.kept_steps} steps")
        returns = episode_returns(arrays["rewards"], dones)[None]
        start, end = curve_ends(returns)
        return Entry(
            history_id=-1,
            task_id=task.task_id,
            env_idx=history.env_idx,
            T=len(arrays["actions"]),
            obs_shape=task.layout.obs_shape,
            action_dim=len(ACTIONS),
            track=task.track,
            split=task.split,
            layout=task.layout.name,
            teammate_family=task.teammate_family,
            teammate_kind=task.teammate_kind,
            h5_group="",
            has_teammate_actions="teammate_actions" in arrays,
            has_expert_actions="expert_actions" in arrays,
            h5_row=None,
            shard="",
            seed=task.seed,
            episodes=returns.shape[1],
            score=float(stream_score(returns)[0]),
            return_start=float(start[0]),
            return_end=float(end[0]),
            return_mean=float(returns.mean()),
            source=new.provenance.source or "ppo",
            learner=history.learner,
            has_oracle_actions="oracle_actions" in arrays,
            **new.provenance.entry_fields(),
        )

    def _with_positions(self, entries: list[Entry], shard: str) -> list[Entry]:
        """Assign ids and positions in a shard: a lite one stacks histories of one shape in a group, others do not."""
        rows: dict[tuple, int] = defaultdict(int)  # shape of a group -> its rows so far
        placed: list[Entry] = []
        for number, entry in enumerate(entries):
            stacked = self.kind == "lite"
            labels = entry.has_expert_actions, entry.has_oracle_actions
            shape = (entry.T, entry.episodes, labels) if stacked else (number,)
            row = rows[shape]
            rows[shape] += 1
            group, history_id = f"/{list(rows).index(shape)}", len(self.entries) + number
            row = row if stacked else None
            position = {"shard": shard, "history_id": history_id, "h5_group": group, "h5_row": row}
            placed.append(msgspec.structs.replace(entry, **position))
        return placed
