"""Checks of a shard's HDF5 structure: libhdf5 and `Shard` read the same, and the chunk table covers every byte."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.errors import ShardCorruptError
from icrl4aht_data.format import safe_hdf5
from icrl4aht_data.format.chunks import BETWEEN, chunk_locations
from icrl4aht_data.format.schema import Entry, Field
from icrl4aht_data.reading.shard import Shard


def check_structure(shard: Shard, values: bool = False) -> list[str]:
    """Return faults in the bytes between the chunks, and differences between what libhdf5 and `Shard` read.

    Args:
        shard: the shard.
        values: also compare every value.
    """
    ordered = np.sort(shard.table, order="offset")
    stops, starts = (ordered["offset"] + ordered["size"]).tolist(), ordered["offset"].tolist()
    size = shard.path.stat().st_size
    most = 2 * np.count_nonzero(ordered["rows"]) + 1 + size // BETWEEN  # the same rows as the writer makes
    faults, between = [], np.flatnonzero(shard.table["rows"] == 0).tolist()
    if len(ordered) > most or [0, *stops] != [*starts, size]:
        faults, between = [f"the chunk table does not cover the file's {size} bytes, each once"], []
        if size > 2 * int(ordered["size"].sum(dtype=np.int64)) + 2**20:  # libhdf5 must not open a sparse terabyte
            return faults
    for row in between:
        try:
            shard.checked_bytes(row)
        except ShardCorruptError as error:
            faults.append(str(error))
    try:
        safe_hdf5.check_no_local_heap(shard.path)
        with h5py.File(shard.path, "r") as file:
            found = list(_structure_faults(shard, file))
            return faults + (found or list(_value_faults(shard, file) if values else ()))
    except Exception as error:  # damaged files cause errors of any type in h5py
        return [*faults, f"not an HDF5 file as the index describes it: {error}"]


def _structure_faults(shard: Shard, file: h5py.File) -> Iterator[str]:
    expected = {"format_version": shard.format_version, "layout": str}
    if (found := safe_hdf5.attributes(file)) != expected:
        yield f"attributes: expected {expected}, found {found}"
    entries = list(shard.entries.values())
    groups = Counter(entry.h5_group for entry in entries)
    if {f"/{name}" for name in file} != set(groups):
        yield f"groups: expected {sorted(groups)}, found {sorted(f'/{name}' for name in file)}"
        return
    for group, entry in {entry.h5_group: entry for entry in entries}.items():
        names, stored = {field.name for field in entry.stored_fields(shard.kind)}, set(safe_hdf5.find(file, group))
        if stored != names:
            yield f"{group}: expected {sorted(names)}, found {sorted(stored)}"
            return
    faults = [
        fault
        for entry in entries
        for field in entry.stored_fields(shard.kind)
        if (fault := _dataset_fault(shard, file, entry, field, groups[entry.h5_group]))
    ]
    yield from faults
    if not faults:
        chunks = [chunk for entry in entries for chunk in chunk_locations(file, shard.kind, entry)]
        table = shard.table[["offset", "size", "rows"]][: len(chunks)].tolist()
        wrong = [row for row, (a, b) in enumerate(zip(chunks, table, strict=True)) if a != b]
        if wrong:
            yield f"the chunk table places {shard.describe(wrong[0])} where HDF5 has {chunks[wrong[0]]}"


def _dataset_fault(shard: Shard, file: h5py.File, entry: Entry, field: Field, stacked: int) -> str | None:
    """Return a fault in the storage of a dataset in a group with `stacked` histories; None if there is none."""
    dataset, rows = safe_hdf5.find(file, f"{entry.h5_group}/{field.name}"), entry.rows(field)
    element = field.element(shard.layout, shard.kind)
    filters = [safe_hdf5.SHUFFLE] * (element.itemsize > 1) + [safe_hdf5.DEFLATE]
    chunk = min(field.chunk, rows)
    shapes = ((rows,), (chunk,)) if entry.h5_row is None else ((stacked, rows), (1, chunk))
    found = safe_hdf5.filters(dataset), dataset.dtype, dataset.shape, dataset.chunks
    if found == (filters, element, *shapes):
        return None
    return f"{dataset.name}: expected filters, type, shape and chunks {(filters, element, *shapes)}, found {found}"


def _value_faults(shard: Shard, file: h5py.File) -> Iterator[str]:
    for entry in shard.entries.values():
        for field in entry.stored_fields(shard.kind):
            dataset: Any = file[f"{entry.h5_group}/{field.name}"]
            try:
                ours = shard.read(entry.history_id, field, 0, entry.rows(field))
            except ShardCorruptError:
                continue  # already reported, and unsafe to inflate with libhdf5
            theirs = dataset[()] if entry.h5_row is None else dataset[entry.h5_row]
            if not np.array_equal(theirs, ours):
                yield f"history {entry.history_id}: HDF5 reads other values of {field.name} than we do"
