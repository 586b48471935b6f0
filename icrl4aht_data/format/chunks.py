"""Chunks of a shard: the chunk table that locates them, and the codec of their bytes.

A shard is an HDF5 file, but is read without libhdf5: the chunk table gives the position, size and hash of every chunk,
and the codec reverses HDF5's shuffle and deflate filters.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import ChunkTableError
from icrl4aht_data.format.schema import CHUNK_DTYPE, Entry, Kind

if TYPE_CHECKING:
    import h5py  # takes 50 ms to import, and reading does not need it

BETWEEN = 2048
"""Most bytes between chunks that one row of the chunk table covers, and so the cost of repairing a fault there."""

DEFLATE_RATIO = 1100
"""Upper bound of inflated bytes per deflated byte."""

DEFLATE_LEVEL = 8
"""Compression level of chunks."""

_POSITION = struct.Struct("<QIII")  # the start of a row; its hash follows
_TABLE_BYTES = 256 * 2**20  # a thousand times the chunk table of a shard of usual size
_ROW_BYTES = 16 * 2**20  # most stored bytes that one row may cover, thirty times our largest chunk


def chunk_table_name(shard: str) -> str:
    """Return the path in the release of a shard's chunk table.

    Args:
        shard: path in the release, `data/...h5`.
    """
    return f"meta/chunks/{shard.removeprefix('data/').removesuffix('.h5')}.npy"


def chunk_table_path(root: Path, shard: str) -> Path:
    """Return the path of a shard's chunk table below the release folder `root`."""
    return root / chunk_table_name(shard)


def read_table(path: Path) -> np.ndarray:
    """Return a chunk table (rows,) of `CHUNK_DTYPE`, mapped from its file because it may be too large for memory.

    Raises:
        ChunkTableError: if it is missing, or not a chunk table.
    """
    try:
        if path.stat().st_size > _TABLE_BYTES:
            raise ValueError(f"more than {_TABLE_BYTES:,} bytes")
        table = np.lib.format.open_memmap(path, mode="r")  # unlike `np.load` it rejects archives
    except FileNotFoundError as error:
        raise ChunkTableError(f"{path}: the chunk table is missing") from error
    except Exception as error:  # NumPy's parser raises errors of any type for a damaged header
        raise ChunkTableError(f"{path}: not a chunk table: {error!r}") from error
    if table.dtype != CHUNK_DTYPE or table.ndim != 1:
        raise ChunkTableError(f"{path}: expected rows of {CHUNK_DTYPE}, found {table.dtype} of shape {table.shape}")
    if (table["size"] > _ROW_BYTES).any():
        raise ChunkTableError(f"{path}: a row covers more than {_ROW_BYTES:,} bytes")
    return table


def chunk_locations(file: h5py.File, kind: Kind, entry: Entry) -> list[tuple[int, int, int]]:
    """Return (offset, size, rows) of a history's chunks according to HDF5, in the order of the chunk table."""
    locations = []
    for field in entry.stored_fields(kind):
        dataset: Any = file[f"{entry.h5_group}/{field.name}"]
        for start in range(0, entry.rows(field), field.chunk):
            position = (start,) if entry.h5_row is None else (entry.h5_row, start)
            info = dataset.id.get_chunk_info_by_coord(position)
            locations.append((info.byte_offset or 0, info.size, min(field.chunk, entry.rows(field) - start)))
    return locations


def chunk_hash(data: bytes) -> bytes:
    """Return the hash of stored bytes in a chunk table: BLAKE2b of 16 bytes."""
    return hashlib.blake2b(data, digest_size=16).digest()


def check_chunk(data: bytes, row: np.void) -> None:
    """Check stored bytes against their row of the chunk table: their size, CRC-32, and hash.

    Args:
        data: the bytes read from `row["offset"]` on.
        row: a row of `CHUNK_DTYPE`.

    Raises:
        ValueError: says what differs, what was expected, and what was found.
    """
    stored = row.tobytes()  # twice as fast as access by field names
    _, size, _, crc32 = _POSITION.unpack_from(stored)
    if len(data) != size:
        raise ValueError(f"expected {size} bytes, found {len(data)}")
    if (found := zlib.crc32(data)) != crc32:
        raise ValueError(f"expected crc32 {crc32:08x}, found {found:08x}")
    if (digest := chunk_hash(data)) != (expected := stored[_POSITION.size :]):
        raise ValueError(f"expected blake2b {expected.hex()}, found {digest.hex()}")


def encode_chunk(rows: np.ndarray, length: int, itemsize: int) -> bytes:
    """Return the bytes of a chunk after HDF5's shuffle and deflate filters.

    Args:
        rows: the chunk's rows, C-contiguous; may be fewer than `length`, then zeros follow.
        length: rows of the chunk.
        itemsize: bytes of one element.
    """
    raw = rows.tobytes().ljust(length * (rows.nbytes // max(len(rows), 1)), b"\0")
    if itemsize > 1:
        raw = np.frombuffer(raw, np.uint8).reshape(-1, itemsize).T.tobytes()
    # Short matches among actions, which are drawn at random, cost more than they save.
    strategy = zlib.Z_FILTERED if rows.ndim == 1 else zlib.Z_DEFAULT_STRATEGY
    deflater = zlib.compressobj(DEFLATE_LEVEL, strategy=strategy)
    return deflater.compress(raw) + deflater.flush()


def decode_chunk(data: bytes, size: int, itemsize: int) -> bytes:
    """Return the bytes of a chunk's elements from its stored bytes.

    Args:
        data: stored bytes.
        size: expected bytes after inflating.
        itemsize: bytes of one element; 1 where the shuffle filter was not used.

    Raises:
        ValueError: if the data does not inflate to exactly `size` bytes, or continues after the end of the stream.
    """
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(data, size)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(raw) != size or inflater.decompress(inflater.unconsumed_tail, 1) or not inflater.eof:
        raise ValueError(f"does not inflate to {size} bytes")
    if inflater.unused_data:  # what follows could give any content any checksum
        raise ValueError(f"{len(inflater.unused_data)} bytes behind the end of the deflate stream")
    if itemsize > 1:
        raw = np.frombuffer(raw, np.uint8).reshape(itemsize, -1).T.tobytes()
    return raw
