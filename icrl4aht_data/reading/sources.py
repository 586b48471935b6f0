"""Cache modes for the histories of a selection: `ram`, `mmap` and `stream`, which return the same rows.

ram      records and scalar fields, decoded once into concatenated arrays in memory; reading a window is one copy
mmap     the arrays of `ram`, decoded once into the cache folder and memory-mapped, shared by processes
stream   chunks read, checked and inflated on threads when a window needs them

A record is the state record of a step or, in a release without state records, the observation; see
`schema.record_field`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from icrl4aht_data.format.cached_arrays import cacheable_bytes, cached_arrays, new_mapped_array
from icrl4aht_data.format.schema import FIELDS, Entry, Kind, memory_fields
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.reading.shard import Shard, Shards
from icrl4aht_data.utils.system import free_memory, gigabytes, run_in_slices

CacheMode = Literal["auto", "ram", "mmap", "stream"]
"""Cache modes; "auto" chooses the first of ram, mmap and stream for which the machine has enough space."""

_VERSION = 2  # version of the memory-mapped arrays' format
_COPIED = 2**20  # bytes copied at a time, so that NumPy's intermediate copy fits into the processor's cache
_STEPS = 8192  # minimum number of steps for which another thread saves time


class CacheChoice(NamedTuple):
    """The chosen cache mode of a selection.

    Attributes:
        cache: "ram", "mmap" or "stream".
        reason: the reason for this mode, as text.
    """

    cache: CacheMode
    reason: str


class ReadRequest(NamedTuple):
    """A request to read rows of one field of n histories into an array.

    Attributes:
        field: a name in `schema.memory_fields`.
        histories: int (n,), positions in the selection.
        rows: int (n,), the first row of a window in each history, -1 or more; or int (n, K), any rows of each history.
        out: (n, K, ...), C-contiguous, of any dtype that represents the values. In windows, rows outside the history
            are set to 0. The last axis of state records and observations may be longer than the history's
            layout needs; the rest is set to 0.
    """

    field: str
    histories: np.ndarray
    rows: np.ndarray
    out: np.ndarray


def choose_cache(cache: CacheMode, size: int) -> CacheChoice:
    """Return the cache mode for arrays of `size` bytes, and the reason for this mode."""
    if cache != "auto":
        return CacheChoice(cache, "set by the option `cache`")
    decoded, memory = f"{gigabytes(size)} decoded", free_memory()
    if size <= memory // 2:
        return CacheChoice("ram", f"{decoded}, {gigabytes(memory)} of memory free")
    room = cacheable_bytes()
    if size <= room:
        return CacheChoice("mmap", f"{decoded}, more than half of the {gigabytes(memory)} of memory free")
    return CacheChoice("stream", f"{decoded}, room for {gigabytes(room)} in the cache folder")


def decoded_size(layout: Layout, kind: Kind, steps: int, histories: int, episodes: int) -> int:
    """Return the size in bytes of decoded histories of one layout, given their number, steps and episodes."""
    rows = {"T": steps + histories + 1, "E": episodes}
    return sum(rows[field.axis] * field.memory_dtype(layout).itemsize for field in memory_fields(kind))


def open_history_source(cache: CacheMode, entries: Sequence[Entry], shards: Shards, threads: int) -> HistorySource:
    """Open a source for the rows of a selection's histories; `ram` and `mmap` decode all histories.

    Args:
        cache: "ram", "mmap" or "stream".
        entries: index entries, (H,), in the selection's order; a history may occur more than once.
        shards: the release's shards.
        threads: number of threads that decode and copy.
    """
    if cache == "stream":
        return StreamedSource(entries, shards, threads)
    shards.fetch(entry.shard for entry in entries)
    source = FlatSource(entries, threads)
    for name in dict.fromkeys(entry.layout for entry in entries):
        by_id = {entry.history_id: entry for entry in entries if entry.layout == name}
        members = [by_id[history_id] for history_id in sorted(by_id)]
        opened = [shards.open(entry.shard) for entry in members]
        source.add(members, (_decode if cache == "ram" else _mapped_arrays)(members, opened, threads))
    return source


def _mapped_arrays(entries: Sequence[Entry], shards: Sequence[Shard], threads: int) -> dict[str, np.ndarray]:
    """Return memory-mapped arrays of one layout's histories from the cache folder; decode missing arrays first."""
    layout = shards[0].layout
    digest = hashlib.blake2b(f"{_VERSION} {layout.name} {layout.rows}".encode(), digest_size=16)
    for entry, shard in zip(entries, shards, strict=True):
        digest.update(f" {entry.T} {entry.episodes} ".encode() + shard.fingerprint(entry.history_id))

    def write_arrays(folder: Path) -> None:
        for array in _decode(entries, shards, threads, folder).values():
            array.flush()  # type: ignore[attr-defined]

    steps, episodes = sum(entry.T for entry in entries), sum(entry.episodes for entry in entries)
    size = decoded_size(layout, shards[0].kind, steps, len(entries), episodes)
    return cached_arrays(f"histories-{digest.hexdigest()}", size, write_arrays)


def _decode(
    entries: Sequence[Entry], shards: Sequence[Shard], threads: int, folder: Path | None = None
) -> dict[str, np.ndarray]:
    """Decode one layout's histories to an array for each field, in memory or memory-mapped in files of a folder."""
    arrays = {}
    for field in memory_fields(shards[0].kind):
        if any(entry.has(field) for entry in entries):
            rows = sum(entry.rows(field) for entry in entries) + (len(entries) + 1 if field.axis == "T" else 0)
            element = field.memory_dtype(shards[0].layout)
            allocate = np.zeros if folder is None else partial(new_mapped_array, folder / f"{field.name}.npy")
            arrays[field.name] = allocate((rows, *element.shape), element.base)
    firsts = {axis: _first_rows(entries, axis) for axis in ("T", "E")}

    def decode_slice(start: int, stop: int) -> None:
        for number in range(start, stop):
            entry, shard = entries[number], shards[number]
            for name, array in arrays.items():
                if entry.has(FIELDS[name]):
                    first = firsts[FIELDS[name].axis][number]
                    out = array[first : first + entry.rows(FIELDS[name])]
                    shard.read_into(entry.history_id, FIELDS[name], 0, out, keep=False)

    run_in_slices(decode_slice, len(entries), threads)
    return arrays


def _first_rows(entries: Sequence[Entry], axis: str) -> np.ndarray:
    """Return int (H,): the row of each history's first step or episode in arrays of concatenated histories.

    A row of zeros precedes the steps of each history, in place of a previous step, and a further row of zeros follows
    the last history.
    """
    lengths = np.array([entry.T + 1 if axis == "T" else entry.episodes for entry in entries])
    return np.cumsum(lengths) - lengths + (1 if axis == "T" else 0)


class FlatSource:
    """Source that reads from arrays of concatenated histories, in memory or memory-mapped, with one set per layout."""

    def __init__(self, entries: Sequence[Entry], threads: int) -> None:
        self._ids, self._threads = np.array([entry.history_id for entry in entries]), threads
        self._arrays: list[dict[str, np.ndarray]] = []
        self._layout = np.zeros(len(entries), np.intp)  # position of each history's arrays in `_arrays`
        self._first = {axis: np.zeros(len(entries), np.intp) for axis in ("T", "E")}
        self._rows = {"T": np.array([e.T for e in entries]), "E": np.array([e.episodes for e in entries])}

    def add(self, members: Sequence[Entry], arrays: dict[str, np.ndarray]) -> None:
        """Add the arrays of one layout's histories, sorted by id."""
        ids = np.array([entry.history_id for entry in members])
        number = np.minimum(np.searchsorted(ids, self._ids), len(ids) - 1)
        here = ids[number] == self._ids
        self._layout[here] = len(self._arrays)
        for axis, first in self._first.items():
            first[here] = _first_rows(members, axis)[number[here]]
        self._arrays.append(arrays)

    def read(self, requests: Sequence[ReadRequest]) -> None:
        """Fill the arrays of read requests in parallel."""
        _read_in_threads(self._read, requests, self._threads)

    def _read(self, request: ReadRequest) -> None:
        name, histories, rows, out = request
        if len(self._arrays) == 1:
            self._read_layout(self._arrays[0][name], request)
            return
        layout = self._layout[histories]
        for number in np.unique(layout).tolist():
            chosen, array = np.flatnonzero(layout == number), self._arrays[number][name]
            part = np.empty((len(chosen), out.shape[1], *array.shape[1:]), out.dtype)
            self._read_layout(array, ReadRequest(name, histories[chosen], rows[chosen], part))
            if out.ndim == 2:
                out[chosen] = part
            else:  # layouts differ in the length of records and in the number of channels
                out[chosen, ..., : part.shape[-1]] = part
                out[chosen, ..., part.shape[-1] :] = 0

    def _read_layout(self, array: np.ndarray, request: ReadRequest) -> None:
        """Fill `request.out` from `array`, which contains all histories of the request."""
        name, histories, rows, out = request
        first, count, length = self._first[FIELDS[name].axis][histories], self._rows[FIELDS[name].axis], out.shape[1]
        if rows.ndim == 2:
            gather_rows(array, first[:, None] + rows, out)
            return
        # A row of zeros follows each history, so a window that ends at most one step after it is contiguous.
        # Copying 64 windows of 500 state records takes 60 microseconds as blocks, 120 row by row.
        if length <= len(array) and (rows + length - count[histories] <= 1).all():
            _copy_windows(array, first + rows, out)
            return
        steps = rows[:, None] + np.arange(length)
        gather_rows(array, first[:, None] + steps, out)
        out[steps >= count[histories][:, None]] = 0


def gather_rows(array: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """Copy array[rows[i, j]] to out[i, j], converted to the dtype of `out`; indices out of range are clipped."""
    if out.dtype == array.dtype:
        np.take(array, rows, axis=0, out=out, mode="clip")  # with other modes, NumPy makes an additional copy
    else:
        out[...] = np.take(array, rows, axis=0, mode="clip")


def _copy_windows(array: np.ndarray, first: np.ndarray, out: np.ndarray) -> None:
    """Copy array[first[i] : first[i] + K] to out[i] as one block; `out`, of shape (n, K, ...), is C-contiguous."""
    size = array[0].size
    flat, width = array.reshape(-1), out.shape[1] * size
    # Creating this view of all windows takes 20 microseconds less with `np.ndarray` than with `sliding_window_view`.
    blocks = np.ndarray((flat.size - width + 1, width), flat.dtype, flat, strides=flat.strides * 2)
    offset, target = first * size, out.reshape(len(out), -1)
    windows = max(1, _COPIED // (width * flat.itemsize))
    for low in range(0, len(out), windows):
        part = slice(low, low + windows)
        target[part] = blocks[offset[part]]


class StreamedSource:
    """Source that reads chunks of histories on demand; shards are opened on first use."""

    def __init__(self, entries: Sequence[Entry], shards: Shards, threads: int) -> None:
        self._entries, self._shards, self._threads = entries, shards, threads

    def read(self, requests: Sequence[ReadRequest]) -> None:
        """Fill the arrays of read requests in parallel, after downloading the needed shards of a remote release.

        Raises:
            ShardCorruptError: if the checksum of a chunk is wrong; the message names the chunk.
            RemoteError: if a shard cannot be downloaded.
        """
        positions = {position for request in requests for position in request.histories.tolist()}
        names = sorted({self._entries[position].shard for position in positions})
        self._shards.fetch(names)
        for name in names:  # opened here, because two threads could open the same shard
            self._shards.open(name)
        _read_in_threads(self._read, requests, self._threads)

    def _read(self, request: ReadRequest) -> None:
        field = FIELDS[request.field]
        for position, rows, out in zip(request.histories.tolist(), request.rows, request.out, strict=True):
            entry = self._entries[position]
            history_id, shard = entry.history_id, self._shards.open(entry.shard)
            if field.row != "scalar":
                size = field.memory_dtype(shard.layout).shape[-1]
                out[..., size:] = 0
                out = out[..., :size]
            if rows.ndim:
                low = int(rows.min())
                out[...] = shard.read(history_id, field, low, int(rows.max()) + 1)[rows - low]
                continue
            begin = int(rows)
            low, high = max(begin, 0), min(begin + len(out), entry.rows(field))
            if high - low < len(out):
                out[...] = 0
            if low < high:
                shard.read_into(history_id, field, low, out[low - begin : high - begin])


HistorySource = FlatSource | StreamedSource
"""Source that reads rows of histories, which are given by their positions in a selection."""


def _read_in_threads(read: Callable[[ReadRequest], None], requests: Sequence[ReadRequest], threads: int) -> None:
    """Call `read` with parts of the requests, in several threads if there are enough steps.

    All requests are split at the same fractions of their rows, so windows that share chunks are usually read by one
    thread.
    """
    rows, steps = max((request.out.shape[:2] for request in requests), key=lambda shape: shape[1])

    def read_slice(first: int, last: int) -> None:
        for field, histories, wanted, out in requests:
            part = slice(len(out) * first // rows, len(out) * last // rows)
            if part.stop > part.start:
                read(ReadRequest(field, histories[part], wanted[part], out[part]))

    run_in_slices(read_slice, rows, threads, least=max(1, _STEPS // steps))
