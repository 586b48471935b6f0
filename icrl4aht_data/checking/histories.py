"""TODO."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from icrl4aht_data.checking.physics import _physics_problems, _place_problems
from icrl4aht_data.checking.report import Report
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.schema import (
    ACTION_FIELDS,
    FIELDS,
    KINDS,
    curve_ends,
    episode_ends,
    episode_returns,
    record_field,
    stream_score,
)
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import faults
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.memory import free_memory

_COPIES = 4  # of a history that checking it takes


def _check_history(history: History, index: Index, seen: dict[tuple[str, bytes], int], report: Report) -> None:
    entry, kind = history.entry, index.info.kind
    layout = get_layout(entry.layout)
    bytes_a_step = sum(part.element(layout, kind).itemsize for part in entry.stored_fields(kind))
    if (size := _COPIES * entry.T * bytes_a_step) > free_memory():
        raise OptionError(f"takes {size / 1e9:.3g} GB of memory, more than is free")
    for problem in _history_problems(history, index.info.environment.kept_steps, report.deep):
        report.add(entry.shard, f"history {entry.history_id}: {problem}")
    seen_and_done = (record_field(kind).name, "actions")
    content = hashlib.sha256(b"".join(history.read(part).tobytes() for part in seen_and_done)).digest()
    twin = seen.setdefault((entry.task_id, content), entry.history_id)
    if twin != entry.history_id:
        report.add(entry.shard, f"history {entry.history_id}: the same as history {twin}")
    report.transitions += entry.T


def _check_chunks(shard: Shard, report: Report) -> set[int]:
    """Decode every chunk; the histories that have a damaged one."""
    damaged = set()
    for row, history_id, field_ in shard.chunk_rows():
        try:
            shard.decode(row, history_id, field_)
        except Icrl4ahtError as error:
            report.add(shard.name, str(error))
            damaged.add(history_id)
        report.chunks += 1
    return damaged


def _history_problems(history: History, kept_steps: int, deep: bool) -> Iterator[str]:
    entry = history.entry
    layout = get_layout(entry.layout)
    dones, rewards, replayable = history.read("dones"), history.read("rewards"), history.kind in KINDS
    counted = entry.episodes == entry.T // kept_steps and not (replayable and entry.T % kept_steps)
    if not counted or not np.array_equal(dones, episode_ends(entry.T, kept_steps)):
        yield f"dones: expected {entry.episodes} episodes of {kept_steps} steps, found {dones.sum()} in {entry.T} steps"
        return
    for name in (name for name in ACTION_FIELDS if entry.has(FIELDS[name])):
        values = history.read(name)
        if values.min() < 0 or values.max() >= len(ACTIONS):
            yield f"{name}: expected 0..{len(ACTIONS) - 1}, found {values.min()}..{values.max()}"
    if (rewards != np.rint(rewards)).any() or np.abs(rewards).max() > np.iinfo(FIELDS["rewards"].compact).max:
        yield f"rewards: expected whole numbers that a byte holds, found {rewards.min()}..{rewards.max()}"
    impossible = False
    for name in ("state", "episode_end_state") if replayable else ():
        for fault in faults(layout, history.read(name)):
            impossible = True
            yield f"{name} has {fault}"
    returns = episode_returns(rewards, dones)[None]
    first, last = curve_ends(returns)
    found = {"return_start": first[0], "return_end": last[0], "return_mean": returns.mean()}
    found["score"] = stream_score(returns)[0]
    for name, value in found.items():
        if not np.isclose(value, getattr(entry, name), rtol=0, atol=1e-9):
            yield f"{name}: the index says {getattr(entry, name)}, the rewards give {value}"
    if deep and not replayable:
        yield from _place_problems(layout, history)
    elif deep and not impossible:
        yield from _physics_problems(layout, history, dones, rewards)
