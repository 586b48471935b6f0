"""Checks of the arrays of histories: checksums, ranges, episodes, and the values that the index derives from them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from icrl4aht_data.checking.physics import observation_faults, replay_faults
from icrl4aht_data.checking.report import Report
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.format.info import ReleaseInfo
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
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import faults
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.system import free_memory

_COPIES = 4  # memory of checking a history, in multiples of the size of its arrays


def check_chunks(shard: Shard, report: Report) -> set[int]:
    """Decode every chunk of a shard, and return the ids of histories with a damaged chunk."""
    damaged = set()
    for row, history_id, field in shard.chunks():
        try:
            shard.decode(row, history_id, field)
        except Icrl4ahtError as error:
            report.add(shard.name, str(error))
            damaged.add(history_id)
        report.chunks += 1
    return damaged


def check_history(
    history: History, layout: Layout, info: ReleaseInfo, contents: dict[tuple[str, bytes], int], report: Report
) -> None:
    """Check one history whose chunks are valid.

    Args:
        history: the history.
        layout: its layout, with the recipes of its task.
        info: the release's info.
        contents: (task id, hash of the ego's observations and actions) -> history id, of the histories checked so far;
            receives this one.
        report: receives the problems.
    """
    entry = history.entry
    try:
        step_bytes = sum(field.element(layout, info.kind).itemsize for field in entry.stored_fields(info.kind))
        if (size := _COPIES * entry.T * step_bytes) > free_memory():
            raise OptionError(f"takes {size / 1e9:.3g} GB of memory, more than is free")
        for fault in _history_faults(history, layout, info.environment.kept_steps, deep=report.level == "deep"):
            report.add(entry.shard, f"history {entry.history_id}: {fault}")
        arrays = (history.read(name) for name in (record_field(info.kind).name, "actions"))
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).digest()
        other = contents.setdefault((entry.task_id, digest), entry.history_id)
        if other != entry.history_id:
            report.add(entry.shard, f"history {entry.history_id}: has the content of history {other}")
        report.transitions += entry.T
    except (Icrl4ahtError, MemoryError) as error:
        report.add(entry.shard, f"history {entry.history_id}: could not be checked: {error!r}")


def _history_faults(history: History, layout: Layout, kept_steps: int, deep: bool) -> Iterator[str]:
    entry = history.entry
    dones, rewards, has_states = history.read("dones"), history.read("rewards"), history.kind in KINDS
    # Only a release of observations may end a history within an episode.
    counted = entry.episodes == entry.T // kept_steps and not (has_states and entry.T % kept_steps)
    if not counted or not np.array_equal(dones, episode_ends(entry.T, kept_steps)):
        yield f"dones: expected {entry.episodes} episodes of {kept_steps} steps, found {dones.sum()} in {entry.T} steps"
        return
    for name in (name for name in ACTION_FIELDS if entry.has(FIELDS[name])):
        values = history.read(name)
        if values.min() < 0 or values.max() >= len(ACTIONS):
            yield f"{name}: expected 0..{len(ACTIONS) - 1}, found {values.min()}..{values.max()}"
    if entry.source == "noise" and entry.has_expert_actions and entry.has_oracle_actions:
        wrong = np.flatnonzero(history.read("expert_actions") != history.read("oracle_actions"))
        if len(wrong):
            yield f"expert_actions: {len(wrong)} differ from the script's, oracle_actions, first step {wrong[0]}"
    if (rewards != np.rint(rewards)).any() or np.abs(rewards).max() > np.iinfo(FIELDS["rewards"].compact).max:
        yield f"rewards: expected integers that fit into a byte, found {rewards.min()}..{rewards.max()}"
    possible = True
    for name in ("state", "episode_end_state") if has_states else ():
        for fault in faults(layout, history.read(name)):
            possible = False
            yield f"{name} has {fault}"
    returns = episode_returns(rewards, dones)[None]
    start, end = curve_ends(returns)
    derived = {"return_start": start[0], "return_end": end[0], "return_mean": returns.mean()}
    derived["score"] = stream_score(returns)[0]
    for name, value in derived.items():
        if not np.isclose(value, getattr(entry, name), rtol=0, atol=1e-9):
            yield f"{name}: the index says {getattr(entry, name)}, the rewards give {value}"
    if deep and not has_states:
        yield from observation_faults(layout, history)
    elif deep and possible:  # the rules accept only possible states
        yield from replay_faults(layout, history, dones, rewards)
