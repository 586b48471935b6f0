"""One HDF5 shard, read by stored offsets with a checksum on every chunk; `shard_writer` writes it.

Chunks are plain HDF5 ones (shuffle + deflate), so any HDF5 tool reads a shard. Our own reads do not go through libhdf5:
they take a chunk's bytes at the offset in the chunk table, check its crc32 and inflate it, which needs no global lock.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import (
    ShardCorruptError,
    ShardMismatchError,
    ShardMissingError,
    ShardTruncatedError,
)
from icrl4aht_data.format.chunks import BETWEEN, DEFLATE_RATIO, chunk_places, chunk_table_name, decode_chunk, read_table
from icrl4aht_data.format.schema import FORMAT_VERSION, Entry, Field, Kind
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.chunk_cache import ChunkCache
from icrl4aht_data.utils.memory import new_array
from icrl4aht_data.utils.paths import resolve_inside

if TYPE_CHECKING:
    import h5py  # libhdf5 is needed to check, not to read

    from icrl4aht_data.format.index import Index
    from icrl4aht_data.remote.partial_file import PartialFile
    from icrl4aht_data.remote.remote_release import ReleaseLocation


class Shard:
    """Reads one shard's histories by offset. May be shared between threads and pickled.

    Args:
        root: the release; of a remote one the chunk table comes here, and of the shard what is read.
        name: path of the shard below it.
        kind: of the release.
        entries: all histories of this shard, in index order.
        cache: of decoded chunks.

    Raises:
        ShardMissingError, ChunkTableError, ShardMismatchError, ShardTruncatedError: at once, if shard and chunk table
            do not fit the index.
    """

    def __init__(
        self, root: ReleaseLocation, name: str, kind: Kind, entries: Sequence[Entry], cache: ChunkCache | None = None
    ) -> None:
        self.path, self.name = resolve_inside(root.folder, name), name
        self._remote = root.remote
        self.kind: Kind = kind
        self.layout = get_layout(entries[0].layout)
        self._entries = {entry.history_id: entry for entry in entries}
        self._cache = cache or ChunkCache()
        self._first: dict[tuple[int, str], int] = {}
        self._elements: dict[str, tuple[np.dtype, tuple[int, ...], int]] = {}
        self._table = self._read_table(
            root, sum(entry.chunks(f) for entry in entries for f in entry.stored_fields(kind))
        )
        self._check_rows(entries)
        self._check_size()

    def _read_table(self, root: ReleaseLocation, expected: int) -> np.ndarray:
        table = read_table(root.file(chunk_table_name(self.name)))
        found = int(np.count_nonzero(table["rows"]))
        if found != expected or not table["rows"][:expected].all():
            raise ShardMismatchError(
                f"{self.path}: the index implies {expected} chunks, the chunk table has {found}; "
                f"fetch meta/ and the shard again"
            )
        return np.array(table)

    def _check_rows(self, entries: Sequence[Entry]) -> None:
        """Whether the chunk table has the rows that the index says."""
        total = 0
        counts, sizes = [], []
        for entry in entries:
            for field in entry.stored_fields(self.kind):
                self._first[entry.history_id, field.name] = total
                expected, chunks = entry.rows(field), entry.chunks(field)
                found = int(self._table["rows"][total : total + chunks].sum())
                if found != expected:
                    raise ShardMismatchError(
                        f"{self.path}: history {entry.history_id}: the index says {expected} rows of {field.name}, the "
                        f"chunk table says {found}; fetch meta/ and the shard again"
                    )
                total += chunks
                counts.append(chunks)
                sizes.append(min(field.chunk, expected) * self._element(field)[2])
        raw, stored = np.repeat(sizes, counts), self._table["size"][:total].astype(np.int64)
        wrong = np.flatnonzero((stored > raw + raw // 1000 + 64) | (raw > DEFLATE_RATIO * stored))
        if len(wrong):
            raise ShardMismatchError(
                f"{self.path}: {self.describe(int(wrong[0]))} cannot be {raw[wrong[0]]} bytes deflated; "
                f"fetch meta/ and the shard again"
            )

    def _check_size(self) -> None:
        """Whether the file is long enough for every chunk."""
        try:
            size = self.path.stat().st_size
        except FileNotFoundError as error:
            if self._remote is None:
                raise self._missing() from error
            size = self._remote.size(self.name)
        offset, length = self._table["offset"], self._table["size"]
        if int(length.sum(dtype=np.int64)) > size >= int((offset + length).max(initial=0)):
            raise ShardMismatchError(f"{self.path}: has {size} bytes, of which the chunk table gives some twice")
        beyond = np.flatnonzero((offset > size) | (length > np.maximum(size, offset) - offset))
        if len(beyond):
            raise ShardTruncatedError(
                f"{self.path}: truncated: has {size} bytes, but {self.describe(int(beyond[0]))} ends beyond them; "
                f"fetch the shard again, then run `icrl4aht-data verify`"
            )

    def _missing(self) -> ShardMissingError:
        return ShardMissingError(f"{self.path}: the index names this shard, but there is no such file")

    @property
    def is_remote(self) -> bool:
        """Whether the shard may have to be fetched."""
        return self._remote is not None

    def needed(self, history_id: int, field: Field, start: int, stop: int) -> range:
        """The rows of the chunk table with rows start..stop of a field."""
        first, chunk = self._first[history_id, field.name], self._chunk_rows(history_id, field)
        return range(first + start // chunk, first + -(-stop // chunk))

    def lacking(self, rows: Iterable[int]) -> list[tuple[PartialFile, np.ndarray]]:
        """What `blocks.bring` takes, to make chunks ready to be read; nothing where they are on this machine's disk."""
        if self._remote is None or self.path.exists():
            return []
        wanted = [row for row in sorted(set(rows)) if self._cache.get((self.name, row)) is None]
        return [(self._remote.part(self.name), self._table[wanted])] if wanted else []

    def read(self, history_id: int, field: Field, start: int, stop: int) -> np.ndarray:
        """Rows start..stop of a field, in the field's dtype. The range must lie within the history.

        Raises:
            ShardCorruptError: names the chunk whose checksum or size is wrong.
        """
        what = f"{self.path}: history {history_id}: {field.name}"
        rows = new_array((stop - start, *self._element(field)[1]), field.dtype, what)
        self.read_into(history_id, field, start, rows)
        return rows

    def read_into(self, history_id: int, field: Field, start: int, out: np.ndarray) -> None:
        """The same for the rows from `start` that fill `out`, cast to its dtype."""
        first, chunk = self._first[history_id, field.name], self._chunk_rows(history_id, field)
        stop = start + len(out)
        for number in range(start // chunk, -(-stop // chunk)):
            rows = self._cache.get((self.name, first + number))
            if rows is None:
                rows = self.decode(first + number, history_id, field)
                self._cache.put((self.name, first + number), rows)
            begin = number * chunk
            low, high = max(start, begin), min(stop, begin + chunk)
            out[low - start : high - start] = rows[low - begin : high - begin]

    def decode_into(self, history_id: int, field: Field, out: np.ndarray) -> None:
        """All rows of a history's field into `out`, past the cache.

        Raises:
            ShardMismatchError: if a value does not survive the dtype of `out`.
        """
        first, chunk = self._first[history_id, field.name], self._chunk_rows(history_id, field)
        for number in range(-(-len(out) // chunk)):
            part = out[number * chunk : (number + 1) * chunk]
            rows = self.decode(first + number, history_id, field)[: len(part)]
            part[...] = rows
            if part.dtype != rows.dtype and not np.array_equal(part, rows):
                raise ShardMismatchError(
                    f"{self.path}: {self.describe(first + number)} has values that {part.dtype} cannot hold; "
                    f"run `icrl4aht-data verify`"
                )

    def fingerprint(self, history_id: int) -> bytes:
        """What distinguishes a history's stored content: sizes and checksums of its chunks."""
        entry = self._entries[history_id]
        stored = entry.stored_fields(self.kind)
        first, chunks = self._first[history_id, stored[0].name], sum(map(entry.chunks, stored))
        return self._table[first : first + chunks][["size", "rows", "crc32"]].tobytes()

    def _chunk_rows(self, history_id: int, field: Field) -> int:
        return min(field.chunk, self._entries[history_id].rows(field))

    def decode(self, row: int, history_id: int, field: Field) -> np.ndarray:
        """One chunk by its row in the chunk table, read from the file and checked; padding rows included."""
        element, shape, size_of_row = self._element(field)
        length = self._chunk_rows(history_id, field)
        offset, size, _, expected = self._table[row].item()
        data = self._bytes(offset, size, expected)
        found = zlib.crc32(data)
        if found != expected or len(data) != size:
            raise ShardCorruptError(
                f"{self.path}: {self.describe(row)}: expected crc32 {expected:08x}, found {found:08x}; "
                f"the file is damaged, fetch the shard again"
            )
        try:
            raw = decode_chunk(data, length * size_of_row, element.itemsize)
        except ValueError as error:
            raise ShardCorruptError(f"{self.path}: {self.describe(row)}: {error}") from error
        rows = np.frombuffer(raw, element.base).reshape(length, *shape)
        rows.flags.writeable = False
        return rows

    def _element(self, field: Field) -> tuple[np.dtype, tuple[int, ...], int]:
        """A field's stored element, the shape of a row, and its bytes."""
        known = self._elements.get(field.name)
        if known is None:
            element = field.element(self.layout, self.kind)
            known = self._elements[field.name] = element, element.shape, element.itemsize
        return known

    def _bytes(self, offset: int, size: int, crc32: int) -> bytes:
        try:
            with self.path.open("rb", buffering=0) as stream:
                stream.seek(offset)
                return stream.read(size)
        except FileNotFoundError as error:
            if self._remote is None:
                raise self._missing() from error
            return self._remote.part(self.name).chunk(offset, size, crc32)

    def describe(self, row: int) -> str:
        """A chunk in words: history, field, number, bytes."""
        (history_id, name), first = max(
            ((key, first) for key, first in self._first.items() if first <= row), key=lambda item: item[1]
        )
        offset, size = int(self._table["offset"][row]), int(self._table["size"][row])
        return f"chunk {row - first} of {name} in history {history_id} (bytes {offset}..{offset + size})"

    def chunk_rows(self) -> Iterator[tuple[int, int, Field]]:
        """Every chunk as (table row, history id, field)."""
        for history_id, entry in self._entries.items():
            for field in entry.stored_fields(self.kind):
                first = self._first[history_id, field.name]
                for number in range(entry.chunks(field)):
                    yield first + number, history_id, field

    def check_between(self) -> list[str]:
        """Whether every byte of the file stands in the table once, and what lies between the chunks is whole."""
        ordered = np.sort(self._table, order="offset")
        stops, starts = (ordered["offset"] + ordered["size"]).tolist(), ordered["offset"].tolist()
        size = self.path.stat().st_size
        most = 2 * np.count_nonzero(ordered["rows"]) + 1 + size // BETWEEN  # lines that the writer would write
        if len(ordered) > most or [0, *stops] != [*starts, size]:
            return [f"the chunk table does not cover the file's {size} bytes, each once"]
        faults = []
        for offset, size, _, expected in self._table[self._table["rows"] == 0].tolist():
            found = zlib.crc32(self._bytes(offset, size, expected))
            if found != expected:
                where = f"bytes {offset}..{offset + size}, between the chunks"
                faults.append(f"{where}: expected crc32 {expected:08x}, found {found:08x}")
        return faults

    def check_structure(self, values: bool = False) -> list[str]:
        """What another HDF5 reader would see otherwise than we do; empty if it sees the same.

        Args:
            values: also compare every value.
        """
        import h5py

        try:
            with h5py.File(self.path, "r") as file:
                faults = self._structure_faults(file)
                if values and not faults:
                    faults = self._value_faults(file)
                return faults
        except Exception as error:  # a damaged file makes h5py raise anything
            return [f"not an HDF5 file as the index describes it: {error}"]

    def _structure_faults(self, file: h5py.File) -> list[str]:
        from icrl4aht_data.format import safe_hdf5 as hdf5

        faults = []
        expected, found = {"format_version": FORMAT_VERSION, "layout": self.layout.name}, hdf5.attributes(file)
        if found != expected:
            faults.append(f"attributes: expected {expected}, found {found}")
        groups = Counter(entry.h5_group for entry in self._entries.values())
        if {f"/{name}" for name in file} != set(groups):
            faults.append(f"groups: expected {sorted(groups)}, found {sorted(f'/{name}' for name in file)}")
            return faults
        for group, entry in {entry.h5_group: entry for entry in self._entries.values()}.items():
            names = sorted(field.name for field in entry.stored_fields(self.kind))
            if sorted(hdf5.member(file, group)) != names:
                faults.append(f"{group}: expected {names}, found {sorted(hdf5.member(file, group))}")
                return faults
        places: list[tuple[int, int, int]] = []
        for entry in self._entries.values():
            for field in entry.stored_fields(self.kind):
                dataset = hdf5.member(file, f"{entry.h5_group}/{field.name}")
                used = hdf5.filters(dataset)
                rows = entry.rows(field)
                shape = (rows,) if entry.h5_row is None else (groups[entry.h5_group], rows)
                element = field.element(self.layout, self.kind)
                shuffled = [hdf5.SHUFFLE] if element.itemsize > 1 else []
                if used != [*shuffled, hdf5.DEFLATE]:
                    faults.append(f"{dataset.name}: filters {used}, expected {[*shuffled, hdf5.DEFLATE]}")
                elif dataset.chunks != (*(1 for _ in shape[1:]), min(field.chunk, rows)):
                    faults.append(f"{dataset.name}: chunks {dataset.chunks}, expected {min(field.chunk, rows)} rows")
                if dataset.shape != shape or dataset.dtype != element:
                    faults.append(
                        f"{dataset.name}: expected {shape} of {element}, found {dataset.shape} of {dataset.dtype}"
                    )
            if not faults:
                places += chunk_places(file, self.kind, entry)
        table = list(zip(*(self._table[name].tolist() for name in ("offset", "size", "rows")), strict=True))
        wrong = [row for row, (a, b) in enumerate(zip(places, table, strict=False)) if a != b]
        if wrong and not faults:
            faults.append(f"the chunk table places {self.describe(wrong[0])} where HDF5 has {places[wrong[0]]}")
        return faults

    def _value_faults(self, file: h5py.File) -> list[str]:
        faults = []
        for entry in self._entries.values():
            for field in entry.stored_fields(self.kind):
                dataset: Any = file[f"{entry.h5_group}/{field.name}"]
                try:
                    ours = self.read(entry.history_id, field, 0, entry.rows(field))
                except ShardCorruptError:
                    continue  # reported chunk by chunk, and nothing for libhdf5 to inflate
                theirs = dataset[()] if entry.h5_row is None else dataset[entry.h5_row]
                if not np.array_equal(theirs, ours):
                    faults.append(f"history {entry.history_id}: HDF5 reads other values of {field.name} than we do")
        return faults


class Shards:
    """The release's shards, opened when first read."""

    def __init__(self, origin: ReleaseLocation, index: Index) -> None:
        self.origin = origin
        self._index = index
        self._open: dict[str, Shard] = {}
        self._cache = ChunkCache()

    def forget(self) -> None:
        """Drop decoded chunks."""
        self._cache.clear()

    def open(self, name: str) -> Shard:
        if name not in self._open:
            entries = self._index.entries
            members = [entries[row] for row in entries.shard_rows(name).tolist()]
            self._open[name] = Shard(self.origin, name, self._index.info.kind, members, self._cache)
        return self._open[name]
