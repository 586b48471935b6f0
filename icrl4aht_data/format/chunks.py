"""Chunk tables, which locate a shard's chunks, and the encoding and decoding of chunks.

A shard is an HDF5 file but is read without libhdf5: the chunk table has the position, size and hash of every chunk,
and this module reverses HDF5's shuffle and deflate filters.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.errors import ChunkTableError
from icrl4aht_data.format.schema import CHUNK_DTYPE, Entry, Kind

METADATA_ROW_BYTES = 2048
"""Maximum bytes of HDF5 metadata per row of the chunk table; a damaged row is fetched again as one piece."""

DEFLATE_RATIO = 1100
"""Upper bound of the compression ratio of deflate."""

DEFLATE_LEVEL = 8
"""Compression level of chunks."""

_TABLE_BYTES = 256 * 2**20  # maximum size of a chunk table, a thousand times the usual size
_ROW_BYTES = 16 * 2**20  # maximum bytes of a stored chunk, thirty times the largest chunk of our releases


def chunk_table_name(shard: str) -> str:
    """Return the path of a shard's chunk table, relative to the release folder.

    Args:
        shard: path of the shard in the release, such as `data/teammate/coord_simple/train-00000-of-00001.h5`.
    """
    return f"meta/chunks/{shard.removeprefix('data/').removesuffix('.h5')}.npy"


def read_table(path: Path) -> np.ndarray:
    """Return a chunk table as a memory-mapped array of shape (rows,) and dtype `CHUNK_DTYPE`.

    Raises:
        ChunkTableError: if the file is missing or not a chunk table.
    """
    try:
        if path.stat().st_size > _TABLE_BYTES:
            raise ValueError(f"expected at most {_TABLE_BYTES:,} bytes")
        table = np.lib.format.open_memmap(path, mode="r")  # rejects archives, which `np.load` opens
    except FileNotFoundError as error:
        raise ChunkTableError(f"{path}: the chunk table is missing; fetch the release again") from error
    except Exception as error:  # NumPy's parser raises errors of any type for a damaged header
        raise ChunkTableError(f"{path}: not a chunk table: {error!r}") from error
    if table.dtype != CHUNK_DTYPE or table.ndim != 1:
        raise ChunkTableError(f"{path}: expected rows of {CHUNK_DTYPE}, found {table.dtype} of shape {table.shape}")
    if (table["size"] > _ROW_BYTES).any():
        raise ChunkTableError(f"{path}: expected chunks of at most {_ROW_BYTES:,} bytes, found a larger chunk")
    return table


def chunk_locations(
    open_dataset: Callable[[str], Any], kind: Kind, entries: Iterable[Entry]
) -> list[tuple[int, int, int]]:
    """Return (offset, size, rows) of each chunk of histories, as reported by HDF5, in the order of the chunk table.

    Offset and size of a chunk that is not stored are 0.

    Args:
        open_dataset: function from the path of a dataset in the shard to the HDF5 dataset.
        kind: kind of the release.
        entries: index entries of the histories.
    """
    chunks_of = cache(lambda path: _stored_chunks(open_dataset(path)))  # histories of a task share datasets
    locations = []
    for entry in entries:
        for field in entry.stored_fields(kind):
            stored, rows = chunks_of(f"{entry.h5_group}/{field.name}"), entry.rows(field)
            for start in range(0, rows, field.chunk):
                position = (start,) if entry.h5_row is None else (entry.h5_row, start)
                locations.append((*stored.get(position, (0, 0)), min(field.chunk, rows - start)))
    return locations


def _stored_chunks(dataset: Any) -> dict[tuple[int, ...], tuple[int, int]]:
    """Return (offset, size) of each stored chunk of an HDF5 dataset, by the position of the chunk's first element."""
    found: dict[tuple[int, ...], tuple[int, int]] = {}

    def add(chunk: Any) -> None:
        found[chunk.chunk_offset] = (chunk.byte_offset or 0, chunk.size)

    dataset.id.chunk_iter(add)
    return found


def chunk_hash(data: bytes) -> bytes:
    """Return the 16-byte BLAKE2b hash of a stored chunk."""
    return hashlib.blake2b(data, digest_size=16).digest()


def check_chunk(data: bytes, row: np.void) -> None:
    """Check the size, CRC-32 and hash of a stored chunk against its row in the chunk table.

    Args:
        data: the bytes stored at `row["offset"]` in the shard.
        row: row of the chunk table, of `CHUNK_DTYPE`.

    Raises:
        ValueError: if the size, CRC-32 or hash differs; the message has the expected and the found value.
    """
    _, size, _, crc32, expected = row.item()
    if len(data) != size:
        raise ValueError(f"expected {size} bytes, found {len(data)}")
    if (found := zlib.crc32(data)) != crc32:
        raise ValueError(f"expected crc32 {crc32:08x}, found {found:08x}")
    if (digest := chunk_hash(data)) != bytes(expected):
        raise ValueError(f"expected blake2b {bytes(expected).hex()}, found {digest.hex()}")


def encode_chunk(rows: np.ndarray, length: int, itemsize: int) -> bytes:
    """Encode a chunk with HDF5's shuffle and deflate filters.

    Args:
        rows: the chunk's rows, C-contiguous; fewer than `length` rows are padded with zeros.
        length: number of rows of a full chunk.
        itemsize: number of bytes of one element.
    """
    raw = rows.tobytes().ljust(length * (rows.nbytes // max(len(rows), 1)), b"\0")
    if itemsize > 1:
        raw = np.frombuffer(raw, np.uint8).reshape(-1, itemsize).T.tobytes()
    # Actions look random, so Z_FILTERED, which skips short matches, compresses them better.
    strategy = zlib.Z_FILTERED if rows.ndim == 1 else zlib.Z_DEFAULT_STRATEGY
    deflater = zlib.compressobj(DEFLATE_LEVEL, strategy=strategy)
    return deflater.compress(raw) + deflater.flush()


def decode_chunk(data: bytes, size: int, itemsize: int) -> bytes:
    """Decode a stored chunk: inflate the bytes and reverse the shuffle filter.

    Args:
        data: the stored bytes.
        size: expected number of bytes after inflating.
        itemsize: number of bytes of one element; 1 if the shuffle filter was not used.

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
    if inflater.unused_data:  # an attacker could choose extra bytes that give the expected checksum
        raise ValueError(f"expected no bytes after the deflate stream, found {len(inflater.unused_data)}")
    if itemsize > 1:
        raw = np.frombuffer(raw, np.uint8).reshape(itemsize, -1).T.tobytes()
    return raw
