"""Writes a release folder: shards, chunk tables, index, tasks, statistics, manifest. All of it appears or none."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import NamedTask, Task, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.info import describe, shard_sizes
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import (
    HISTORIES,
    INFO,
    KINDS,
    OBSERVATIONS,
    PROVENANCE,
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
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.writing.dataset_card import SOURCE_CARD, dataset_card
from icrl4aht_data.writing.release_folder import atomic_folder
from icrl4aht_data.writing.shard_writer import stored_bytes, write_shard
from icrl4aht_data.writing.statistics import layout_statistics

if TYPE_CHECKING:
    from icrl4aht_data.reading.history import History

CARD = "README.md"
"""What a release is, for people."""

SHARD_BYTES = 256 * 2**20
"""The size that shards should have, where there is data enough."""


@dataclass(frozen=True)
class NewHistory:
    """One history to be written.

    Args:
        env_idx: stream within the learner's parallel roll-out.
        arrays: field name -> array for the release's `schema.held_fields`: a full release renders `obs` from the state.
            May read on access: a shard's histories are held until it is written.
    """

    env_idx: int
    arrays: Mapping[str, np.ndarray]

    @classmethod
    def copied(cls, history: History) -> NewHistory:
        """What a history of any release is to a lite one."""
        names = [field.name for field in history.entry.stored_fields("lite")]
        return cls(history.entry.env_idx, {name: history.read(name) for name in names})


@dataclass(frozen=True)
class NewTask:
    """One task with its histories.

    Args:
        task: what was learned; a `NamedTask` only in a release of observations.
        provenance: how its histories were made.
        streams: the number of histories that `load` gives.
        load: called once, when its shard is written, so that few histories are in memory at a time.
        files: others that go into the release, path there -> file; see `checkpoint_files`.
    """

    task: Task
    provenance: Provenance
    streams: int
    load: Callable[[], Iterable[NewHistory]]
    files: Mapping[str, Path] = field(default_factory=dict)


def write_release(
    target: Path,
    kind: Kind,
    tasks: Iterable[NewTask],
    *,
    data_version: str,
    card: str | None = None,
    source_card: str | None = None,
    kept_steps: int = KEPT_STEPS,
    shard_histories: int = 1024,
    shard_bytes: int = SHARD_BYTES,
    done: Callable[[Task], None] = lambda task: None,
) -> Path:
    """Write a release folder; an existing one at `target` is replaced when the new one is complete.

    Args:
        target: the folder to make.
        kind: "full" (observations stored), "lite" (observations rendered from the states on reading) or "observations"
            (no states; an unfinished episode may end a history).
        tasks: what to write; histories are numbered in this order.
        data_version: SemVer of the data.
        card: README.md of the release; by default it is made of what the release says, see `dataset_card`.
        source_card: the cards of what the release is made of, to keep beside its own.
        kept_steps: steps of every episode.
        shard_histories: at most this many histories a shard.
        shard_bytes: about how large a shard should be, judged by the first history of each layout.
        done: called when a task's histories have been taken, for progress.

    Raises:
        OptionError: if `target` holds something else, if there is no task or one twice, if some tasks are known by name
            only and others are not, or if a history's arrays are missing, of unequal length or lossy.
    """
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
    with atomic_folder(target) as partial:
        _fill(partial, kind, new, data_version, (card, source_card), kept_steps, (shard_histories, shard_bytes), done)
    return target


def _fill(
    root: Path,
    kind: Kind,
    tasks: list[NewTask],
    data_version: str,
    cards: tuple[str | None, str | None],
    kept_steps: int,
    shard_limits: tuple[int, int],
    done: Callable[[Task], None],
) -> None:
    entries: list[Entry] = []
    groups: dict[tuple[str, str, str], list[NewTask]] = defaultdict(list)
    for new in tasks:
        groups[new.task.track, new.task.layout.name, new.task.split].append(new)
    for (track, layout, split), members in groups.items():
        histories = (pair for new in members for pair in _loaded(new, done))
        first = list(islice(histories, 1))
        total = sum(new.streams for new in members)
        shards = _shards(first, total, kind, kept_steps, *shard_limits)
        histories = chain(first, histories)
        for number in range(shards):
            part = list(islice(histories, total * (number + 1) // shards - total * number // shards))
            name = f"data/{track}/{layout}/{split}-{number:05}-of-{shards:05}.h5"
            new = [_entry(task, history, kind, name, kept_steps) for task, history in part]
            new_entries = _placed(new, kind, len(entries))
            write_shard(root, name, kind, new_entries, (_with_obs(task, h, kind) for task, h in part))
            entries += new_entries
        for _ in histories:  # to the end, where a wrong count is noticed and the last task reported
            pass
    with (root / HISTORIES).open("w", encoding="utf-8") as stream:
        stream.writelines(json.dumps(entry.to_json()) + "\n" for entry in entries)
    for name, source in chain.from_iterable(new.files.items() for new in tasks):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, root / name)
    given = [new.task for new in tasks if not isinstance(new.task, NamedTask)]
    write_tasks(root / TASKS, given)
    provenance = {new.task.task_id: new.provenance for new in tasks}
    write_json(root / PROVENANCE, {task_id: of_task.to_json() for task_id, of_task in provenance.items()})
    statistics = layout_statistics(root, entries, given, provenance, kept_steps)
    info = describe(kind, data_version, kept_steps, entries)
    write_json(root / INFO, replace(info, shards=shard_sizes(root, entries), statistics=statistics).to_json())
    card, source_card = cards
    if source_card is not None:
        (root / SOURCE_CARD).write_text(source_card, encoding="utf-8")
    (root / CARD).write_text(dataset_card(root) if card is None else card, encoding="utf-8")
    write_manifest(root)


def _shards(
    first: list[tuple[Task, NewHistory]], total: int, kind: Kind, kept_steps: int, most: int, target: int
) -> int:
    """How many shards: of about the target size if all histories are as large as the first, at most `most` in each."""
    size = 1
    for task, history in first:
        (entry,) = _placed([_entry(task, history, kind, "", kept_steps)], kind, 0)
        size = stored_bytes(kind, entry, _with_obs(task, history, kind))
    return max(1, -(-total // most), min(total, round(total * size / target)))


def _loaded(new: NewTask, done: Callable[[Task], None]) -> Iterator[tuple[Task, NewHistory]]:
    given = 0
    for history in new.load():
        yield new.task, history
        given += 1
    if given != new.streams:
        raise OptionError(f"task {new.task.task_id}: {given} histories, but {new.streams} were announced")
    done(new.task)


def _entry(task: Task, history: NewHistory, kind: Kind, shard: str, kept_steps: int) -> Entry:
    arrays = history.arrays
    needed = {field.name for field in held_fields(kind) if kind not in field.optional}
    if not needed <= arrays.keys():
        raise OptionError(f"task {task.task_id}: a history lacks the arrays {sorted(needed - arrays.keys())}")
    dones = arrays["dones"]
    unfinished = len(dones) % kept_steps if kind in KINDS else len(dones) < kept_steps
    if unfinished or not np.array_equal(dones, episode_ends(len(dones), kept_steps)):
        raise OptionError(f"task {task.task_id}: a history's episodes do not all have {kept_steps} steps")
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
        shard=shard,
        seed=task.seed,
        episodes=returns.shape[1],
        score=float(stream_score(returns)[0]),
        return_start=float(start[0]),
        return_end=float(end[0]),
        return_mean=float(returns.mean()),
    )


def _placed(entries: list[Entry], kind: Kind, first_id: int) -> list[Entry]:
    """Give ids and places: rows of one group per shape in a lite shard, a group each in the others."""
    placed: list[Entry] = []
    groups: dict[tuple, list[int]] = defaultdict(list)
    for number, entry in enumerate(entries):
        shape = (entry.T, entry.episodes, entry.has_expert_actions) if kind == "lite" else number
        rows = groups.setdefault((shape,), [])
        group = f"/{list(groups).index((shape,))}"
        placed.append(
            replace(entry, history_id=first_id + number, h5_group=group, h5_row=len(rows) if kind == "lite" else None)
        )
        rows.append(number)
    return placed


def _with_obs(task: Task, history: NewHistory, kind: Kind) -> Mapping[str, np.ndarray]:
    if kind != "full":
        return history.arrays
    return {**history.arrays, "obs": observe(task.layout, history.arrays["state"], EGO)}
