"""Atomic writing of a release folder: shards, chunk tables, index, tasks, statistics and manifest."""

from __future__ import annotations

import json
import shutil
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import NamedTask, Task, write_tasks
from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.format.info import LeftOutTask, check_version, layout_statistics, make_info
from icrl4aht_data.format.layouts_file import write_layouts_file
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import Provenance, ProvenanceByTask
from icrl4aht_data.format.schema import (
    ALL_KINDS,
    FORMAT_VERSION,
    HISTORIES,
    INFO,
    KINDS,
    LAYOUTS_FILE,
    OBSERVATIONS,
    PROVENANCE,
    RELEASE_CARD,
    TASKS,
    Entry,
    Kind,
    curve_fields,
    episode_ends,
    episode_returns,
    memory_fields,
)
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.reading.history import History
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_data.writing.card import write_card
from icrl4aht_data.writing.release_folder import as_path, atomic_folder
from icrl4aht_data.writing.shard_writer import EncodedChunk, encode_history, write_shard

SHARD_BYTES = 256 * 2**20
"""Intended size of a shard in bytes; sizes are estimated from the first history of each layout."""

_ENCODED_AHEAD = 2  # number of histories in memory besides the one that is written


@dataclass(frozen=True)
class NewHistory:
    """One history to write to a release.

    Args:
        env_idx: index of the stream in the learner's parallel rollout; without a learner, number of the history.
        arrays: arrays by field name, for the fields `schema.memory_fields` of the release's kind; for a full release,
            `obs` is rendered from the states.
        learner: number of the independent learner that made the history, counted from 0.
    """

    env_idx: int
    arrays: Mapping[str, np.ndarray]
    learner: int = 0

    @classmethod
    def from_history(cls, history: History, kind: Kind = "lite", without: Collection[str] = ()) -> NewHistory:
        """Return a `NewHistory` from a history of a release, with the fields that a kind of release needs.

        Args:
            history: the history of an existing release.
            kind: kind of the release to write; for a full release, observations are rendered from the states.
            without: names of fields to leave out.
        """
        fields = history.entry.stored_fields("lite" if kind in KINDS else kind)
        names = [field.name for field in fields if field.name not in without]
        return cls(history.entry.env_idx, {name: history.read(name) for name in names}, history.entry.learner)


@dataclass(frozen=True)
class NewTask:
    """One task to write to a release, with its histories.

    Args:
        task: the task; may be a `NamedTask` only in a release of observations.
        provenance: how the histories were made; its `source` (default "ppo") becomes the source of the index entries.
        streams: number of histories that `load` returns, over all learners.
        load: function that returns the histories; it is called once, when the histories' shard is written.
        files: files to copy to the release, by path in the release; see `checkpoint_files`.
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
    kept_steps: int = KEPT_STEPS,
    left_out: Sequence[LeftOutTask] = (),
    files: Mapping[str, Path] = MappingProxyType({}),
    shard_histories: int = 1024,
    overwrite: bool = False,
    sources: Iterable[str | Path] = (),
    done: Callable[[Task], None] = lambda task: None,
) -> Path:
    """Write a release folder atomically.

    Args:
        target: the folder to write.
        kind: "full" (observations stored), "lite" (observations rendered from the states on reading) or "observations"
            (no states; the last episode of a history may be unfinished).
        tasks: the tasks to write; their order determines the order of the histories.
        data_version: version of the data, in the form of SemVer.
        card: content of README.md; by default generated by `card.write_card`.
        kept_steps: number of steps of every episode.
        left_out: tasks without histories, to be listed in meta/info.json.
        files: files to copy to the release, by path in the release, such as a figure of the card.
        shard_histories: maximum number of histories in a shard.
        overwrite: whether to replace a release at `target` if its folder has no other files.
        sources: folders that the tasks are read from; they may neither be inside `target` nor contain it.
        done: function called with a task after the task's histories are written.

    Raises:
        UnknownNameError: if the kind does not exist.
        OptionError: if `target` may not be written, see `release_folder.check_target`; if `tasks` is empty, has
            duplicates, or mixes `Task` with `NamedTask`; if an array of a history is missing, has a wrong length, or
            has values that the stored dtype cannot represent.
    """
    target = as_path(target)
    check_version(data_version)
    check_choice("kind", kind, ALL_KINDS)
    new = list(tasks)
    ids = [task.task.task_id for task in new]
    if not new or len(set(ids)) < len(ids):
        raise OptionError(f"expected at least one task, and each task once, found {ids}")
    if empty := [task.task.task_id for task in new if task.streams < 1]:
        raise OptionError(f"task {empty[0]} has no histories; add at least one history, or leave the task out")
    named = [task.task.task_id for task in new if isinstance(task.task, NamedTask)]
    if named and (kind in KINDS or len(named) < len(ids)):
        raise OptionError(
            f"{len(named)} of {len(ids)} tasks, such as {named[0]!r}, have only names: give complete tasks; in a "
            f"release of {OBSERVATIONS}, all tasks may have only names"
        )
    with atomic_folder(target, overwrite=overwrite, sources=sources) as root:
        writer = _ShardWriter(root, kind, kept_steps, shard_histories, done)
        stems = grouped(new, lambda one: f"data/{one.task.track}/{one.task.layout.name}/{one.task.split}")
        for stem, members in stems.items():
            writer.write(stem, members)
        for name, source in chain(files.items(), *(one.files.items() for one in new)):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, root / name)
        with (root / HISTORIES).open("w", encoding="utf-8") as stream:
            stream.writelines(json.dumps(entry.to_json()) + "\n" for entry in writer.entries)
        named_layouts = [*(one.task.layout_name for one in new), *(one.layout for one in left_out)]
        write_layouts_file(root / LAYOUTS_FILE, map(get_layout, named_layouts))  # without the tasks' own recipes
        known = [] if named else [one.task for one in new]
        write_tasks(root / TASKS, known)
        provenance = ProvenanceByTask((one.task.task_id, one.provenance) for one in new)
        content = {task_id: of_task.to_json() for task_id, of_task in provenance.items()}
        write_json(root / PROVENANCE, content, indent=None)  # 1 kB per task, even without indentation
        sizes = {name: (root / name).stat().st_size for name in dict.fromkeys(entry.shard for entry in writer.entries)}
        info = make_info(kind, data_version, kept_steps, writer.entries, FORMAT_VERSION)
        info = replace(info, shards=sizes, left_out=list(left_out))
        info = replace(info, statistics=layout_statistics(info, writer.entries, known, provenance))
        write_json(root / INFO, info.to_json())
        if card is None:
            write_card(root)
        else:
            (root / RELEASE_CARD).write_text(card, encoding="utf-8")
        write_manifest(root)
    return target


@dataclass
class _ShardWriter:
    """Writer of a release's shards; `entries` are the index entries of all histories written so far."""

    root: Path
    kind: Kind
    kept_steps: int
    shard_histories: int
    done: Callable[[Task], None]
    entries: list[Entry] = field(default_factory=list)

    def write(self, stem: str, tasks: list[NewTask]) -> None:
        """Write the histories of tasks that share track, layout and split into shards named `stem`-*.h5."""
        total = sum(new.streams for new in tasks)
        with ThreadPoolExecutor(usable_cores()) as pool:
            histories = self._encode(tasks, pool)
            first = list(islice(histories, 1))
            size = sum(len(chunk.data) for _, chunks in first for chunk in chunks)
            shards = max(1, -(-total // self.shard_histories), min(total, round(total * size / SHARD_BYTES)))
            histories = chain(first, histories)
            for number in range(shards):
                part = list(islice(histories, total * (number + 1) // shards - total * number // shards))
                name = f"{stem}-{number:05}-of-{shards:05}.h5"
                entries = self._with_positions([entry for entry, _ in part], name)
                write_shard(self.root, name, self.kind, entries, [chunks for _, chunks in part])
                self.entries += entries
            for _ in histories:  # finish the generator, so `_load` checks and reports the last task
                pass

    def _encode(self, tasks: list[NewTask], pool: Executor) -> Iterator[tuple[Entry, list[EncodedChunk]]]:
        """Yield the index entry and the chunks of each history of tasks, while threads encode the next histories."""
        waiting: deque[tuple[Entry, Callable[[], list[EncodedChunk]]]] = deque()
        for history in chain.from_iterable(self._load(new, pool) for new in tasks):
            waiting.append(history)
            if len(waiting) > _ENCODED_AHEAD:
                entry, chunks = waiting.popleft()
                yield entry, chunks()
        for entry, chunks in waiting:
            yield entry, chunks()

    def _load(self, new: NewTask, pool: Executor) -> Iterator[tuple[Entry, Callable[[], list[EncodedChunk]]]]:
        """Yield the index entry of each history of a task, and a function that waits for the history's chunks."""
        given = 0
        for history in new.load():
            entry, arrays = self._entry(new, history), history.arrays
            if self.kind == "full":
                arrays = {**arrays, "obs": observe(new.task.layout, arrays["state"], EGO)}
            yield entry, encode_history(pool, self.kind, entry, arrays)
            given += 1
        if given != new.streams:
            raise OptionError(f"task {new.task.task_id}: expected {new.streams} histories, found {given}")
        self.done(new.task)

    def _entry(self, new: NewTask, history: NewHistory) -> Entry:
        """Return the index entry of a history; the history's id and position in a shard are not set yet."""
        arrays, task = history.arrays, new.task
        if not 0 <= history.env_idx < 2**63:
            raise OptionError(f"task {task.task_id}: env_idx: expected at least 0, found {history.env_idx}")
        if not 0 <= history.learner < (learners := new.provenance.learners or 1):
            raise OptionError(
                f"task {task.task_id}: learner: expected 0 to {learners - 1}, since provenance has {learners} "
                f"learners, found {history.learner}"
            )
        needed = {field.name for field in memory_fields(self.kind) if self.kind not in field.optional}
        if not needed <= arrays.keys():
            raise OptionError(f"task {task.task_id}: a history does not have arrays {sorted(needed - arrays.keys())}")
        dones = arrays["dones"]
        unfinished = len(dones) % self.kept_steps if self.kind in KINDS else len(dones) < self.kept_steps
        if unfinished or not np.array_equal(dones, episode_ends(len(dones), self.kept_steps)):
            raise OptionError(f"task {task.task_id}: expected histories with episodes of {self.kept_steps} steps")
        returns = episode_returns(arrays["rewards"], dones)
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
            episodes=len(returns),
            source=new.provenance.source or "ppo",
            learner=history.learner,
            has_oracle_actions="oracle_actions" in arrays,
            **curve_fields(returns),
            **new.provenance.entry_fields(len(returns), "expert_actions" in arrays),
        )

    def _with_positions(self, entries: list[Entry], shard: str) -> list[Entry]:
        """Return entries with ids and positions in a shard; in a lite shard, histories of equal shape share a group."""
        rows: dict[tuple, int] = {}  # last row used in each group, by the group's shape
        placed: list[Entry] = []
        for number, entry in enumerate(entries):
            stacked = self.kind == "lite"
            shape = (entry.T, entry.episodes, entry.has_expert_actions, entry.has_oracle_actions)
            key = shape if stacked else (number,)
            row = rows[key] = rows.get(key, -1) + 1
            position = {"h5_group": f"/{list(rows).index(key)}", "h5_row": row if stacked else None, "shard": shard}
            placed.append(msgspec.structs.replace(entry, history_id=len(self.entries) + number, **position))
        return placed
