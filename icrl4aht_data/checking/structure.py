"""Checks of a shard's HDF5 structure: libhdf5 and `Shard` read the same, and the chunk table covers every byte."""

from __future__ import annotations

from collections import Counter
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.errors import ShardCorruptError
from icrl4aht_data.format import safe_hdf5
from icrl4aht_data.format.chunks import BETWEEN, chunk_locations
from icrl4aht_data.format.schema import Entry, Field
from icrl4aht_data.reading.shard import Shard


def check_bytes_between(shard: Shard) -> list[str]:
    """Return faults in the HDF5 metadata, and bytes that the chunk table does not cover exactly once."""
    ordered = np.sort(shard.table, order="offset")
    stops, starts = (ordered["offset"] + ordered["size"]).tolist(), ordered["offset"].tolist()
    size = shard.path.stat().st_size
    most = 2 * np.count_nonzero(ordered["rows"]) + 1 + size // BETWEEN  # the same rows as the writer makes
    if len(ordered) > most or [0, *stops] != [*starts, size]:
        return [f"the chunk table does not cover the file's {size} bytes, each once"]
    faults = []
    for row in np.flatnonzero(shard.table["rows"] == 0).tolist():
        try:
            shard.checked_bytes(row)
        except ShardCorruptError as error:
            faults.append(str(error))
    return faults


def has_grown(shard: Shard) -> bool:
    """Return whether a shard is far larger than its chunk table says, for example a sparse file."""
    return shard.path.stat().st_size > 2 * int(shard.table["size"].sum(dtype=np.int64)) + 2**20


def check_structure(shard: Shard, values: bool = False) -> list[str]:
    """Return the differences between what libhdf5 and `Shard` read.

    Args:
        shard: the shard.
        values: also compare every value.
    """
    try:
        with h5py.File(shard.path, "r") as file:
            faults = _structure_faults(shard, file)
            if values and not faults:
                faults = _value_faults(shard, file)
            return faults
    except Exception as error:  # damaged files cause errors of any type in h5py
        return [f"not an HDF5 file as the index describes it: {error}"]


def _structure_faults(shard: Shard, file: h5py.File) -> list[str]:
    faults = []
    expected = {"format_version": shard.format_version, "layout": shard.layout.name}
    found = safe_hdf5.attributes(file)
    if found != expected:
        faults.append(f"attributes: expected {expected}, found {found}")
    groups = Counter(entry.h5_group for entry in shard.entries.values())
    if {f"/{name}" for name in file} != set(groups):
        faults.append(f"groups: expected {sorted(groups)}, found {sorted(f'/{name}' for name in file)}")
        return faults
    for group, entry in {entry.h5_group: entry for entry in shard.entries.values()}.items():
        names = sorted(field.name for field in entry.stored_fields(shard.kind))
        if sorted(safe_hdf5.find(file, group)) != names:
            faults.append(f"{group}: expected {names}, found {sorted(safe_hdf5.find(file, group))}")
            return faults
    chunks: list[tuple[int, int, int]] = []
    for entry in shard.entries.values():
        for field in entry.stored_fields(shard.kind):
            faults += _dataset_faults(shard, file, entry, field, groups[entry.h5_group])
        if not faults:
            chunks += chunk_locations(file, shard.kind, entry)
    table = list(zip(*(shard.table[name].tolist() for name in ("offset", "size", "rows")), strict=True))
    wrong = [row for row, (a, b) in enumerate(zip(chunks, table, strict=False)) if a != b]
    if wrong and not faults:
        faults.append(f"the chunk table places {shard.describe(wrong[0])} where HDF5 has {chunks[wrong[0]]}")
    return faults


def _dataset_faults(shard: Shard, file: h5py.File, entry: Entry, field: Field, stacked: int) -> list[str]:
    """Return faults in filters, chunks, shape and dtype of a dataset in a group with `stacked` histories."""
    faults = []
    dataset = safe_hdf5.find(file, f"{entry.h5_group}/{field.name}")
    used, rows = safe_hdf5.filters(dataset), entry.rows(field)
    shape = (rows,) if entry.h5_row is None else (stacked, rows)
    element = field.element(shard.layout, shard.kind)
    shuffled = [safe_hdf5.SHUFFLE] if element.itemsize > 1 else []
    if used != [*shuffled, safe_hdf5.DEFLATE]:
        faults.append(f"{dataset.name}: filters {used}, expected {[*shuffled, safe_hdf5.DEFLATE]}")
    elif dataset.chunks != (*(1 for _ in shape[1:]), min(field.chunk, rows)):
        faults.append(f"{dataset.name}: chunks {dataset.chunks}, expected {min(field.chunk, rows)} rows")
    if dataset.shape != shape or dataset.dtype != element:
        faults.append(f"{dataset.name}: expected {shape} of {element}, found {dataset.shape} of {dataset.dtype}")
    return faults


def _value_faults(shard: Shard, file: h5py.File) -> list[str]:
    faults = []
    for entry in shard.entries.values():
        for field in entry.stored_fields(shard.kind):
            dataset: Any = file[f"{entry.h5_group}/{field.name}"]
            try:
                ours = shard.read(entry.history_id, field, 0, entry.rows(field))
            except ShardCorruptError:
                continue  # already reported, and unsafe to inflate with libhdf5
            theirs = dataset[()] if entry.h5_row is None else dataset[entry.h5_row]
            if not np.array_equal(theirs, ours):
                faults.append(f"history {entry.history_id}: HDF5 reads other values of {field.name} than we do")
    return faults
