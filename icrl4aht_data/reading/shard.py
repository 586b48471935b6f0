"""Reader of HDF5 shards, which finds chunks by a chunk table and checks their hashes; see `writing.shard_writer`.

Chunks are ordinary HDF5 chunks (shuffle + deflate), so any HDF5 tool can read a shard. This reader does not use
libhdf5: it reads a chunk's bytes at the offset in the chunk table, checks their hash and inflates them, without a
global lock.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence

import numpy as np

from icrl4aht_data.errors import (
    ReleaseError,
    ShardCorruptError,
    ShardMismatchError,
    ShardMissingError,
    ShardTruncatedError,
    ShardUnreadableError,
)
from icrl4aht_data.fetch import ReleaseLocation
from icrl4aht_data.format.chunks import DEFLATE_RATIO, check_chunk, chunk_table_name, decode_chunk, read_table
from icrl4aht_data.format.index import Index
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.schema import FIELDS, Entry, Field, Kind
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.system import new_array

_CACHE_BYTES = 256 * 2**20  # maximum bytes of the decoded chunks in a cache


class ChunkCache:
    """Thread-safe cache of a release's decoded chunks, of limited size; drops the least recently used chunks."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Remove all chunks from the cache."""
        self._chunks: OrderedDict[tuple[str, int], np.ndarray] = OrderedDict()
        self._bytes, self._process, self._lock = 0, os.getpid(), threading.Lock()

    def __reduce__(self) -> tuple:
        return ChunkCache, ()  # a pickled cache is empty: the receiving process fills its own

    def get(self, key: tuple[str, int]) -> np.ndarray | None:
        """Return the chunk with the key (shard, row of its chunk table), or None if it is not cached."""
        if self._process != os.getpid():  # after a fork, a thread that no longer exists may hold the lock
            self.clear()
        with self._lock:
            rows = self._chunks.get(key)
            if rows is not None:
                self._chunks.move_to_end(key)
            return rows

    def put(self, key: tuple[str, int], rows: np.ndarray) -> None:
        """Add a chunk; if the cache is full, drop the least recently used chunks."""
        with self._lock:
            if key not in self._chunks:
                self._chunks[key] = rows
                self._bytes += rows.nbytes
            while self._bytes > _CACHE_BYTES and len(self._chunks) > 1:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes


class Shard:
    """One shard of a release; reads rows of the histories in the shard. Thread-safe; can be pickled.

    Args:
        location: the release. If it is remote, opening downloads the shard and its chunk table.
        name: path of the shard in the release.
        info: the release's info.
        entries: all histories of the shard, in index order.
        cache: decoded chunks, shared with other shards.

    Attributes:
        entries: history id -> index entry.
        datasets: pairs (entry, field), the stored arrays in the order of their chunks in the chunk table.
        table: (N,), the chunk table, see `schema.CHUNK_DTYPE`.
        kind: the release's kind.
        format_version: the release's format version.

    Raises:
        ShardMissingError, ChunkTableError, ShardMismatchError, ShardTruncatedError, ShardUnreadableError: if the
            shard or its chunk table contradicts the index or cannot be read.
    """

    def __init__(
        self, location: ReleaseLocation, name: str, info: ReleaseInfo, entries: Sequence[Entry], cache: ChunkCache
    ) -> None:
        self.path, self.name = location.path(name), name
        self.kind: Kind = info.kind
        self.format_version = info.format_version
        self.layout = get_layout(entries[0].layout)
        self.entries = {entry.history_id: entry for entry in entries}
        self.datasets = [(entry, field) for entry in entries for field in entry.stored_fields(self.kind)]
        self._cache = cache
        self._elements = {field.name: field.element(self.layout, self.kind) for field in FIELDS.values()}
        self._first: dict[tuple[int, str], int] = {}  # row of the first chunk in the table by (history id, field)
        location.fetch([chunk_table_name(name), name])
        self.table = read_table(location.file(chunk_table_name(name)))
        self._check_table()
        self.table = np.array(self.table)  # loaded after the check, since the file could be too large for memory
        self._check_size()

    def _check_table(self) -> None:
        """Check that the chunk table has the chunks and rows implied by the index, with possible sizes."""
        table = self.table
        chunks = [entry.chunks(field) for entry, field in self.datasets]
        *firsts, total = np.cumsum([0, *chunks]).tolist()
        found = int(np.count_nonzero(table["rows"]))
        if found != total or not table["rows"][:total].all():
            raise self._mismatch(f"the index implies {total} chunks, the chunk table has {found}")
        sums = np.add.reduceat(table["rows"][:total].astype(np.int64), firsts).tolist()
        sizes = []
        for (entry, field), first, rows in zip(self.datasets, firsts, sums, strict=True):
            self._first[entry.history_id, field.name] = first
            if rows != entry.rows(field):
                where = f"history {entry.history_id}: the index implies {entry.rows(field)} rows of {field.name}"
                raise self._mismatch(f"{where}, the chunk table has {rows}")
            sizes.append(self._chunk_rows(entry.history_id, field) * self._elements[field.name].itemsize)
        raw, stored = np.repeat(sizes, chunks), table["size"][:total].astype(np.int64)
        wrong = np.flatnonzero((stored > raw + raw // 1000 + 64) | (raw > DEFLATE_RATIO * stored))
        if len(wrong):
            raise self._mismatch(f"{self.describe(int(wrong[0]))} cannot be decompressed to {raw[wrong[0]]} bytes")

    def _check_size(self) -> None:
        """Check that the file contains every chunk of the table."""
        try:
            size = self.path.stat().st_size
        except OSError as error:
            raise self._read_error(error) from error
        offset, length = self.table["offset"], self.table["size"]
        if int(length.sum(dtype=np.int64)) > size >= int((offset + length).max(initial=0)):
            raise self._mismatch(f"some of its {size} bytes belong to two chunks of the chunk table")
        beyond = np.flatnonzero((offset > size) | (length > np.maximum(size, offset) - offset))
        if len(beyond):
            raise ShardTruncatedError(
                f"{self.path}: truncated: has {size} bytes, but {self.describe(int(beyond[0]))} ends beyond them; "
                f"fetch the shard again, then run `icrl4aht-data verify`"
            )

    def _mismatch(self, fault: str) -> ShardMismatchError:
        return ShardMismatchError(f"{self.path}: {fault}; fetch meta/ and the shard again")

    def _read_error(self, error: OSError) -> ReleaseError:
        if isinstance(error, FileNotFoundError):
            return ShardMissingError(f"{self.path}: the index names this shard, but there is no such file")
        return ShardUnreadableError(
            f"{self.path}: cannot be read: {error.strerror or error}; check its permissions and the disk"
        )

    def read(self, history_id: int, field: Field, start: int, stop: int) -> np.ndarray:
        """Return rows start..stop of a field, in the field's dtype. The range must be within the history.

        Raises:
            ShardCorruptError: if the hash or size of a chunk is wrong; the message names the chunk.
        """
        what = f"{self.path}: history {history_id}: {field.name}"
        rows = new_array((stop - start, *self._elements[field.name].shape), field.dtype, what)
        self.read_into(history_id, field, start, rows)
        return rows

    def read_into(self, history_id: int, field: Field, start: int, out: np.ndarray, *, keep: bool = True) -> None:
        """Fill `out` with the rows of a field from row `start` on, converted to the dtype of `out`; see `read`.

        Args:
            history_id, field, start: history, field and first row to read.
            out: (rows, ...) of any dtype.
            keep: add decoded chunks to the cache; False for rows that are read once.

        Raises:
            ShardCorruptError: if the hash or size of a chunk is wrong; the message names the chunk.
            ShardMismatchError: if the dtype of `out` cannot represent a value.
        """
        stored, length = self.entries[history_id].stored_field(field), self._chunk_rows(history_id, field)
        first, stop = self._first[history_id, stored.name], start + len(out)
        for number in range(start // length, -(-stop // length)):
            key = self.name, first + number
            rows = self._cache.get(key)
            if rows is None:
                rows = self.decode(first + number, history_id, field)
                if keep:
                    self._cache.put(key, rows)
            begin = number * length
            low, high = max(start, begin), min(stop, begin + length)
            part, wanted = out[low - start : high - start], rows[low - begin : high - begin]
            part[...] = wanted
            # A forged release may store the action 300, which fits into int32 but not into the int8 arrays of samplers.
            if not np.can_cast(rows.dtype, part.dtype) and not np.array_equal(part, wanted):
                raise ShardMismatchError(
                    f"{self.path}: {self.describe(first + number)} has values that {part.dtype} cannot hold; "
                    f"run `icrl4aht-data verify`"
                )

    def decode(self, row: int, history_id: int, field: Field) -> np.ndarray:
        """Return the rows of one chunk, read from the file and checked, including padding rows.

        Args:
            row: the chunk's row in the chunk table.
            history_id, field: history and field of the chunk.
        """
        element, length = self._elements[field.name], self._chunk_rows(history_id, field)
        data = self.checked_bytes(row)
        try:
            raw = decode_chunk(data, length * element.itemsize, element.itemsize)
        except ValueError as error:
            raise ShardCorruptError(f"{self.path}: {self.describe(row)}: {error}") from error
        rows = np.frombuffer(raw, element.base).reshape(length, *element.shape)
        rows.flags.writeable = False  # cached chunks are shared between readers
        return rows

    def checked_bytes(self, row: int) -> bytes:
        """Return the stored bytes of a chunk, given its row in the chunk table, after checking their hash.

        Raises:
            ShardCorruptError: if the bytes are damaged; the message names the chunk.
        """
        offset, size = self.table[row].item()[:2]
        try:
            with self.path.open("rb", buffering=0) as stream:
                stream.seek(offset)
                data = stream.read(size)
            check_chunk(data, self.table[row])
        except OSError as error:
            raise self._read_error(error) from error
        except ValueError as error:
            raise ShardCorruptError(
                f"{self.path}: {self.describe(row)}: {error}; the file is damaged: `icrl4aht-data download` replaces it"
            ) from error
        return data

    def _chunk_rows(self, history_id: int, field: Field) -> int:
        return min(field.chunk, self.entries[history_id].rows(field))

    def fingerprint(self, history_id: int) -> bytes:
        """Return bytes that identify a history's stored content: names of its fields and hashes of its chunks."""
        entry = self.entries[history_id]
        stored = entry.stored_fields(self.kind)
        first, chunks = self._first[history_id, stored[0].name], sum(map(entry.chunks, stored))
        names = " ".join(field.name for field in stored).encode()
        return names + self.table["hash"][first : first + chunks].tobytes()

    def describe(self, row: int) -> str:
        """Return text that identifies a chunk in messages: number, field, history and byte range."""
        offset, size = int(self.table["offset"][row]), int(self.table["size"][row])
        if not self.table["rows"][row]:
            return f"bytes {offset}..{offset + size}, between the chunks"
        (history_id, name), first = [item for item in self._first.items() if item[1] <= row][-1]
        return f"chunk {row - first} of {name} in history {history_id} (bytes {offset}..{offset + size})"


class Shards:
    """The shards of a release, each opened on first use.

    Args:
        location: the release.
        index: the release's index.
    """

    def __init__(self, location: ReleaseLocation, index: Index) -> None:
        self.location, self.index = location, index
        self._open: dict[str, Shard] = {}
        self.cache = ChunkCache()

    def open(self, name: str) -> Shard:
        """Return the shard with this path in the release; a shard of a remote release is downloaded first."""
        if name not in self._open:
            entries = self.index.entries
            members = [entries[row] for row in np.flatnonzero(entries.matches("shard", [name])).tolist()]
            self._open[name] = Shard(self.location, name, self.index.info, members, self.cache)
        return self._open[name]

    def fetch(self, names: Iterable[str]) -> None:
        """Download shards of a remote release and their chunk tables in parallel."""
        closed = [name for name in dict.fromkeys(names) if name not in self._open]
        self.location.fetch([*map(chunk_table_name, closed), *closed])
