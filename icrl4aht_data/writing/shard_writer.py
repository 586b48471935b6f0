"""Writing of HDF5 shards and their chunk tables."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.chunks import (
    DEFLATE_LEVEL,
    METADATA_ROW_BYTES,
    chunk_hash,
    chunk_locations,
    chunk_table_name,
    encode_chunk,
)
from icrl4aht_data.format.schema import CHUNK_DTYPE, FORMAT_VERSION, Entry, Field, Kind
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.files import add_filename

_BLOCK = 2000  # number of steps in one chunk of scalars, or in two chunks of state records


class EncodedChunk(NamedTuple):
    """One encoded chunk of a history, ready to be stored.

    Args:
        field: field that the chunk is a part of.
        start: number of the chunk's first row, which is a step or an episode of the history.
        data: shuffled and deflated bytes.
    """

    field: Field
    start: int
    data: bytes


def write_shard(
    root: Path, shard: str, kind: Kind, entries: Sequence[Entry], histories: Sequence[Sequence[EncodedChunk]]
) -> None:
    """Write a shard and its chunk table into a new release folder that no reader has opened yet.

    Args:
        root: the release folder.
        shard: path of the shard in the release, equal to `shard` of every entry.
        kind: kind of the release.
        entries: index entries of the histories, with the histories' positions in the shard (`h5_group`, `h5_row`).
        histories: encoded chunks of each entry's history, see `encode_history`.
    """
    path, table_path = root / shard, root / chunk_table_name(shard)
    path.parent.mkdir(parents=True, exist_ok=True)
    table_path.parent.mkdir(parents=True, exist_ok=True)
    layout = get_layout(entries[0].layout)
    # The file is made in memory, since libhdf5 may crash when it closes a file on a full disk. Shards are small.
    with h5py.File(path, "w", libver=("v110", "v110"), driver="core", backing_store=False) as file:
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["layout"] = layout.name
        for group in dict.fromkeys(entry.h5_group for entry in entries):
            _create_datasets(file, layout, kind, [entry for entry in entries if entry.h5_group == group])
        open_dataset = cache(lambda name: file[name])  # opening a dataset takes as long as writing a chunk
        for entry, chunks in zip(entries, histories, strict=True):
            for field, start, data in sorted(chunks, key=lambda chunk: chunk_sort_key(chunk.field, chunk.start)):
                position = (start,) if entry.h5_row is None else (entry.h5_row, start)
                open_dataset(f"{entry.h5_group}/{field.name}").id.write_direct_chunk(position, data)
        locations = chunk_locations(open_dataset, kind, entries)
        stored = [chunk.data for chunks in histories for chunk in chunks]
        rows = [(*row, *_checksums(data)) for row, data in zip(locations, stored, strict=True)]
        table = np.array(rows, CHUNK_DTYPE)
        file.flush()
        content: bytes = file.id.get_file_image()
    saved = BytesIO()
    np.save(saved, np.concatenate([table, metadata_rows(content, table)]), allow_pickle=False)
    for name, data in ((path, content), (table_path, saved.getbuffer())):
        with add_filename(name):
            name.write_bytes(data)


def metadata_rows(content: bytes, chunks: np.ndarray) -> np.ndarray:
    """Return the rows of a chunk table for the HDF5 metadata of a shard, that is, for the bytes between the chunks."""
    ordered = np.sort(chunks, order="offset")
    starts = [*ordered["offset"].tolist(), len(content)]
    stops = [0, *(ordered["offset"] + ordered["size"]).tolist()]
    lines = []
    for stop, start in zip(stops, starts, strict=True):
        for low in range(stop, start, METADATA_ROW_BYTES):
            data = content[low : min(low + METADATA_ROW_BYTES, start)]
            lines.append((low, len(data), 0, *_checksums(data)))
    return np.array(lines, CHUNK_DTYPE)


def _checksums(data: bytes) -> tuple[int, np.ndarray]:
    """Return the CRC-32 and the hash of a chunk, which are the last two values of a row of the chunk table."""
    return zlib.crc32(data), np.frombuffer(chunk_hash(data), np.uint8)


def _create_datasets(file: h5py.File, layout: Layout, kind: Kind, entries: Sequence[Entry]) -> None:
    """Create the empty datasets of a group, of shape (rows,) for one history or (histories, rows) if stacked."""
    first = entries[0]
    group = file.create_group(first.h5_group)
    for field in first.stored_fields(kind):
        rows = first.rows(field)
        chunk = min(field.chunk, rows)
        stacked = first.h5_row is not None
        element = field.element(layout, kind)
        group.create_dataset(
            field.name,
            shape=(len(entries), rows) if stacked else (rows,),
            chunks=(1, chunk) if stacked else (chunk,),
            dtype=element,
            shuffle=element.itemsize > 1,
            compression="gzip",
            compression_opts=DEFLATE_LEVEL,
        )


def chunk_sort_key(field: Field, start: int) -> tuple[int, ...]:
    """Return a sort key that orders a history's chunks so that a window of steps is one byte range of the file.

    Chunks are sorted by block of `_BLOCK` steps, then by field. In a block, the scalars that every window needs are
    between the first and the second chunk of state records.
    """
    if field.axis == "E":
        return (1,)
    order = ("actions", "rewards", "dones", "state", "teammate_actions", "expert_actions", "oracle_actions", "obs")
    leads = field.name == "state" and start % _BLOCK == 0
    return (0, start // _BLOCK, -1 if leads else order.index(field.name), start)


def encode_history(
    pool: Executor, kind: Kind, entry: Entry, arrays: Mapping[str, np.ndarray]
) -> Callable[[], list[EncodedChunk]]:
    """Start to encode all chunks of a history in the threads of a pool.

    Args:
        pool: threads that encode the chunks.
        kind: kind of the release.
        entry: the history's index entry.
        arrays: arrays by field name, of any dtype; the stored dtype must be able to represent all values.

    Returns:
        A function that waits for the chunks, and returns them in the order of the chunk table.

    Raises:
        OptionError: if the stored dtype cannot represent a value, or an array's length differs from the index entry.
    """
    layout, parts = get_layout(entry.layout), []
    for field in entry.stored_fields(kind):
        element, array, rows = field.element(layout, kind), arrays[field.name], entry.rows(field)
        where = f"task {entry.task_id}, stream {entry.env_idx}: field {field.name}"
        if len(array) != rows:
            raise OptionError(f"{where}: expected {rows} rows, found {len(array)}")
        stored = np.ascontiguousarray(array, element.base)
        if not np.array_equal(stored, array):
            raise OptionError(f"{where} has values that {element.base} cannot represent")
        length = min(field.chunk, rows)
        for start in range(0, rows, length):
            data = pool.submit(encode_chunk, stored[start : start + length], length, element.itemsize)
            parts.append((field, start, data))
    return lambda: [EncodedChunk(field, start, data.result()) for field, start, data in parts]
