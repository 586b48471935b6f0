"""TODO."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import (
    ChunkTableError,
)
from icrl4aht_data.format.schema import CHUNK_DTYPE, Entry, Kind

if TYPE_CHECKING:
    import h5py

BETWEEN = 2048
"""Bytes between the chunks that one line of the chunk table covers: what a fault there costs to repair."""


DEFLATE_RATIO = 1100
"""No deflated bytes become as many times as much."""


_TABLE_BYTES = 256 * 2**20  # a thousand times that of a shard of the usual size


_LINE_BYTES = 16 * 2**20  # what a line of it may cover, thirty times our largest chunk


def chunk_table_name(shard: str) -> str:
    """The chunk table of a shard (`data/...h5`), path in the release."""
    return f"meta/chunks/{shard.removeprefix('data/').removesuffix('.h5')}.npy"


def chunk_table_path(root: Path, shard: str) -> Path:
    """Where it lies."""
    return root / chunk_table_name(shard)


def decode_chunk(data: bytes, size: int, itemsize: int) -> bytes:
    """The reverse of `encode_chunk`.

    Raises:
        ValueError: if the data does not inflate to exactly `size` bytes.
    """
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(data, size)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(raw) != size or inflater.decompress(inflater.unconsumed_tail, 1) or not inflater.eof:
        raise ValueError(f"does not inflate to {size} bytes")
    if itemsize > 1:
        raw = np.frombuffer(raw, np.uint8).reshape(itemsize, -1).T.tobytes()
    return raw


def chunk_places(file: h5py.File, kind: Kind, entry: Entry) -> list[tuple[int, int, int]]:
    """(offset, size, rows) of a history's chunks as HDF5 has them, in table order."""
    places = []
    for field in entry.stored_fields(kind):
        dataset: Any = file[f"{entry.h5_group}/{field.name}"]
        for start in range(0, entry.rows(field), field.chunk):
            at = (start,) if entry.h5_row is None else (entry.h5_row, start)
            info = dataset.id.get_chunk_info_by_coord(at)
            places.append((info.byte_offset or 0, info.size, min(field.chunk, entry.rows(field) - start)))
    return places


def read_table(path: Path) -> np.ndarray:
    """A chunk table (CHUNK_DTYPE), mapped from its file: it may be larger than it should be.

    Raises:
        ChunkTableError: if it is missing, or no chunk table.
    """
    try:
        if path.stat().st_size > _TABLE_BYTES:
            raise ValueError(f"more than {_TABLE_BYTES:,} bytes")
        table = np.lib.format.open_memmap(path, mode="r")  # other than `np.load` it takes no archives, either
    except FileNotFoundError as error:
        raise ChunkTableError(f"{path}: the chunk table is missing") from error
    except Exception as error:  # a damaged header makes NumPy's parser raise anything
        raise ChunkTableError(f"{path}: not a chunk table: {error!r}") from error
    if table.dtype != CHUNK_DTYPE or table.ndim != 1:
        raise ChunkTableError(f"{path}: expected rows of {CHUNK_DTYPE}, found {table.dtype} of shape {table.shape}")
    if (table["size"] > _LINE_BYTES).any():
        raise ChunkTableError(f"{path}: a line covers more than {_LINE_BYTES:,} bytes")
    return table
