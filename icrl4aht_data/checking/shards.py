"""Checks of shards: HDF5 structure, checksums of chunks, and each history's values, index entry and replay."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.checking.report import Report
from icrl4aht_data.errors import Icrl4ahtError, OptionError, ShardCorruptError
from icrl4aht_data.format import safe_hdf5
from icrl4aht_data.format.chunks import METADATA_ROW_BYTES, chunk_locations
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS, KINDS, curve_fields, episode_ends, record_field
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import columns, faults, initial_record
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.system import free_memory
from icrl4aht_data.writing.published_views import views_without_items

_COPIES = 4  # memory needed to check a history, as a multiple of the size of the history's arrays


def check_chunks(shard: Shard, report: Report) -> set[int]:
    """Decode every chunk of a shard, and return the ids of histories with a damaged chunk."""
    damaged = set()
    of_chunks = ((entry, field) for entry, field in shard.datasets for _ in range(entry.chunks(field)))
    for row, (entry, field) in enumerate(of_chunks):
        try:
            shard.decode(row, entry.history_id, field)
        except Icrl4ahtError as error:
            report.add(shard.name, str(error))
            damaged.add(entry.history_id)
        report.chunks += 1
    return damaged


def check_history(
    history: History, layout: Layout, info: ReleaseInfo, contents: dict[bytes, int], report: Report
) -> None:
    """Check the content of one history; the chunks must be valid.

    Args:
        history: the history.
        layout: the history's layout, with the recipes of the task.
        info: the release's info.
        contents: hash of a history's records and actions -> history id, for the histories checked so far; this history
            is added.
        report: receives the problems.
    """
    entry = history.entry
    try:
        step_bytes = sum(field.element(layout, info.kind).itemsize for field in entry.stored_fields(info.kind))
        if (size := _COPIES * entry.T * step_bytes) > free_memory():
            raise OptionError(
                f"checking this history takes {size / 1e9:.3g} GB of memory, more than is free; use a larger machine"
            )
        for fault in _history_faults(history, layout, info.environment.kept_steps, deep=report.level == "deep"):
            report.add(entry.shard, f"history {entry.history_id}: {fault}")
        arrays = (history.read(name) for name in (record_field(info.kind).name, "actions"))
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).digest()
        other = contents.setdefault(digest, entry.history_id)
        if other != entry.history_id:
            report.add(entry.shard, f"history {entry.history_id}: has the content of history {other}")
        report.transitions += entry.T
    except (Icrl4ahtError, MemoryError) as error:
        report.add(entry.shard, f"history {entry.history_id}: could not be checked: {error!r}")


def _history_faults(history: History, layout: Layout, kept_steps: int, deep: bool) -> Iterator[str]:
    entry = history.entry
    dones, rewards, has_states = history.read("dones"), history.read("rewards"), history.kind in KINDS
    if not np.array_equal(dones, episode_ends(entry.T, kept_steps)):
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
    for name, value in curve_fields(history.returns()).items():
        if not np.isclose(value, getattr(entry, name), rtol=0, atol=1e-9):
            yield f"{name}: the index says {getattr(entry, name)}, the rewards give {value}"
    if deep and not has_states:
        yield from observation_faults(layout, history)
    elif deep and possible:  # the rules are defined only for possible states
        yield from replay_faults(layout, history, dones, rewards)


def observation_faults(layout: Layout, history: History) -> Iterator[str]:
    """Yield a problem if observations contradict the fixed cells of the layout, without using state records."""
    fixed = fixed_channels(layout)
    views = {view.tobytes() for view in views_without_items(layout)[..., fixed]}
    wrong = [t for t, seen in enumerate(history.read("obs")[..., fixed]) if seen.tobytes() not in views]
    if wrong:
        yield f"obs: {len(wrong)} steps do not show {layout.name} from any cell of the ego's, first step {wrong[0]}"


def replay_faults(layout: Layout, history: History, dones: np.ndarray, rewards: np.ndarray) -> Iterator[str]:
    """Replay every step of a history from its state records, and describe where the history contradicts the rules.

    Args:
        layout: the history's layout.
        history: the history; all of its states must be possible.
        dones: bool of shape (T,), True at the last step of each episode.
        rewards: the recorded rewards, of shape (T,).
    """
    states, ends = history.read("state"), history.read("episode_end_state")
    if history.kind == "full":
        wrong = np.flatnonzero((history.read("obs") != observe(layout, states, EGO)).any(axis=(1, 2, 3)))
        if len(wrong):
            yield f"obs: {len(wrong)} steps differ from what their state shows, first step {wrong[0]}"
    following = np.concatenate([states[1:], states[:1]])
    following[dones] = ends
    recipe = columns(layout).recipe
    actions = np.stack([history.read("actions"), history.read("teammate_actions")], axis=-1)
    # New recipes are random, so the replay uses the recorded recipes.
    played = step(layout, states, np.clip(actions, 0, len(ACTIONS) - 1), following[:, recipe])
    wrong = np.flatnonzero((played.state != following).any(axis=-1))
    if len(wrong):
        yield f"replay: {len(wrong)} steps do not lead to the recorded next state, first step {wrong[0]}"
    wrong = np.flatnonzero(played.reward != rewards)
    if len(wrong):
        t = int(wrong[0])
        yield f"replay: {len(wrong)} rewards differ, first at step {t}: rules {played.reward[t]}, found {rewards[t]}"
    if not np.isin([*states[:, recipe], *ends[:, recipe]], layout.recipe_items).all():
        yield "a recipe is not one of the layout's"
    starts = states[np.concatenate([[0], np.flatnonzero(dones)[:-1] + 1])]
    positions = starts[:, columns(layout).positions]
    fresh = initial_record(layout, positions, starts[:, columns(layout).facings], starts[:, recipe])
    differs = (fresh != starts).any(axis=-1)
    for agent in (0, 1):
        differs |= ~np.isin(positions[:, agent], layout.rooms[agent])
    if differs.any():
        yield f"{differs.sum()} episodes do not start as the environment starts, first episode {differs.argmax()}"


def check_structure(shard: Shard, values: bool = False) -> list[str]:
    """Return faults in the bytes between chunks, and differences between what libhdf5 and `Shard` read from the file.

    Args:
        shard: the shard.
        values: also compare every value.
    """
    ordered = np.sort(shard.table, order="offset")
    stops, starts = (ordered["offset"] + ordered["size"]).tolist(), ordered["offset"].tolist()
    size = shard.path.stat().st_size
    most = 2 * np.count_nonzero(ordered["rows"]) + 1 + size // METADATA_ROW_BYTES  # the writer makes no more rows
    faults, between = [], np.flatnonzero(shard.table["rows"] == 0).tolist()
    if len(ordered) > most or [0, *stops] != [*starts, size]:
        faults, between = [f"the chunk table does not cover the file's {size} bytes, each once"], []
        if size > 2 * int(ordered["size"].sum(dtype=np.int64)) + 2**20:  # libhdf5 must not open a huge sparse file
            return faults
    for row in between:
        try:
            shard.checked_bytes(row)
        except ShardCorruptError as error:
            faults.append(str(error))
    try:
        safe_hdf5.check_no_local_heap(shard.path)
        # HDF5's chunk cache is off, because each chunk is read once, and every open dataset would allocate a cache.
        with h5py.File(shard.path, "r", rdcc_nbytes=0) as file:
            open_dataset = cache(partial(safe_hdf5.find_node, file))  # histories of a task share datasets
            found = list(_structure_faults(shard, file, open_dataset))
            return faults + (found or list(_value_faults(shard, open_dataset) if values else ()))
    except Exception as error:  # damaged files cause errors of any type in h5py
        return [*faults, f"not an HDF5 file as the index describes it: {error}"]


def _structure_faults(shard: Shard, file: h5py.File, open_dataset: Callable[[str], Any]) -> Iterator[str]:
    expected = {"format_version": shard.format_version, "layout": str}
    if (found := safe_hdf5.read_attributes(file)) != expected:
        yield f"attributes: expected {expected}, found {found}"
    entries = list(shard.entries.values())
    groups = Counter(entry.h5_group for entry in entries)
    if {f"/{name}" for name in file} != set(groups):
        yield f"groups: expected {sorted(groups)}, found {sorted(f'/{name}' for name in file)}"
        return
    for group, entry in {entry.h5_group: entry for entry in entries}.items():
        names, stored = {field.name for field in entry.stored_fields(shard.kind)}, set(safe_hdf5.find_node(file, group))
        if stored != names:
            yield f"{group}: expected {sorted(names)}, found {sorted(stored)}"
            return

    @cache
    def stored_form(path: str) -> tuple[Any, ...]:
        dataset = open_dataset(path)
        return safe_hdf5.filter_ids(dataset), dataset.dtype, dataset.shape, dataset.chunks

    faults = 0
    for entry, field in shard.datasets:
        path, rows = f"{entry.h5_group}/{field.name}", entry.rows(field)
        element, chunk = field.element(shard.layout, shard.kind), min(field.chunk, rows)
        filters = [safe_hdf5.SHUFFLE] * (element.itemsize > 1) + [safe_hdf5.DEFLATE]
        shapes = ((rows,), (chunk,)) if entry.h5_row is None else ((groups[entry.h5_group], rows), (1, chunk))
        found = stored_form(path)
        if found != (filters, element, *shapes):
            faults += 1
            expected = f"expected filters, type, shape and chunks {(filters, element, *shapes)}"
            yield f"{path}: {expected}, found {found}"
    if not faults:
        chunks = chunk_locations(open_dataset, shard.kind, entries)
        table = shard.table[["offset", "size", "rows"]][: len(chunks)].tolist()
        wrong = [row for row, (a, b) in enumerate(zip(chunks, table, strict=True)) if a != b]
        if wrong:
            yield f"the chunk table places {shard.describe(wrong[0])} where HDF5 has {chunks[wrong[0]]}"


def _value_faults(shard: Shard, open_dataset: Callable[[str], Any]) -> Iterator[str]:
    for entry, field in shard.datasets:
        dataset = open_dataset(f"{entry.h5_group}/{field.name}")
        try:
            ours = shard.read(entry.history_id, field, 0, entry.rows(field))
        except ShardCorruptError:
            continue  # the damage is already reported, and libhdf5 must not inflate the chunk
        theirs = dataset[()] if entry.h5_row is None else dataset[entry.h5_row]
        if not np.array_equal(theirs, ours):
            yield f"history {entry.history_id}: libhdf5 and this package read different values of {field.name}"
