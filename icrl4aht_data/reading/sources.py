"""Where a sampler's rows come from: `ram`, `mmap` and `stream` behind one interface, the same rows from each.

ram      records and scalars decoded once into flat arrays; a window is one copy
mmap     the same arrays decoded once into the cache folder and memory-mapped, shared by processes
stream   chunks read by their stored offsets, checked and inflated on threads when a window needs them

A record is what is held of a step to show what the ego saw: its state record, or where a release has none the
observation itself; see `schema.record_field`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np

from icrl4aht_data.format.schema import FIELDS, Entry, Kind, held_fields
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.cache import cache_room, cached_arrays
from icrl4aht_data.utils.memory import free_memory
from icrl4aht_data.utils.threads import in_slices

CacheMode = Literal["auto", "ram", "mmap", "stream"]
CACHE_MODES: tuple[CacheMode, ...] = ("auto", "ram", "mmap", "stream")
"""Ways of holding data; "auto" takes the first of ram, mmap and stream that the machine has room for."""

_VERSION = 1  # of the memory-mapped arrays
_COPIED = 2**20  # bytes at a time: the copies in between stay small, and the calls few


class CacheChoice(NamedTuple):
    """How a selection is held, and why."""

    cache: CacheMode
    reason: str


class HistorySource(Protocol):
    """Rows of the histories of one layout, named by their position in the source. Values are in `Field.compact`."""

    def windows(self, field: str, which: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
        """Rows starts..starts + L of each history into out (n, L, ...), C-contiguous; rows outside a history are zero.

        Args:
            field: one of `held_fields` with one row a step.
            which: int (n,), positions.
            starts: int (n,), -1 or more.
            out: any dtype for scalars, uint8 (n, L, S) for states, uint8 (n, L, 5, 5, C) for observations.
        """
        ...

    def steps(self, field: str, which: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """(n, K, ...): any steps int (n, K) within each history."""
        ...

    def ends(self, which: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        """uint8 (m, S): the state after the last kept step of an episode (m,) of a history (m,). Of states only."""
        ...

    def lacking(self, fields: Sequence[str], which: np.ndarray, low: np.ndarray, high: np.ndarray) -> list:
        """What `blocks.bring` takes so that rows low..high of some fields of histories (n,) are at hand."""
        ...


def choose(cache: CacheMode, size: int) -> CacheChoice:
    """How to hold arrays of that many bytes."""
    if cache != "auto":
        return CacheChoice(cache, "as asked")
    memory = free_memory()
    if size <= memory // 2:
        return CacheChoice("ram", f"{_gigabytes(size)} decoded, {_gigabytes(memory)} of memory free")
    room = cache_room()
    if size <= room:
        return CacheChoice(
            "mmap", f"{_gigabytes(size)} decoded, more than half of the {_gigabytes(memory)} of memory free"
        )
    return CacheChoice("stream", f"{_gigabytes(size)} decoded, room for {_gigabytes(room)} in the cache folder")


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.3g} GB"


def decoded_size(layout: Layout, kind: Kind, steps: int, histories: int, episodes: int) -> int:
    """Bytes of the flat arrays of histories of one layout."""
    rows = {"T": steps + histories + 1, "E": episodes}
    return sum(rows[field.axis] * field.held(layout).itemsize for field in held_fields(kind))


def open_source(
    cache: CacheMode, entries: Sequence[Entry], open_shard: Callable[[str], Shard], threads: int
) -> HistorySource:
    """The source of histories of one layout.

    Args:
        cache: not "auto".
        entries: the histories; their positions are the source's.
        open_shard: shard name -> shard.
        threads: for decoding.
    """
    layout = get_layout(entries[0].layout)
    shards = [open_shard(entry.shard) for entry in entries]
    if cache == "stream":
        return Streamed(layout, entries, shards)
    if cache == "ram":
        return Flat(
            entries, _decoded(layout, entries, shards, threads, lambda shape, dtype, name: np.zeros(shape, dtype))
        )
    digest = hashlib.blake2b(f"{_VERSION} {layout.name} {layout.rows}".encode(), digest_size=16)
    for entry, shard in zip(entries, shards, strict=True):
        digest.update(f" {entry.T} {entry.episodes} ".encode() + shard.fingerprint(entry.history_id))

    def build(folder: Path) -> None:
        def make(shape: tuple[int, ...], dtype: np.dtype, name: str) -> np.ndarray:
            return np.lib.format.open_memmap(folder / f"{name}.npy", "w+", dtype, shape)

        for array in _decoded(layout, entries, shards, threads, make).values():
            array.flush()  # type: ignore[attr-defined]

    steps, episodes = sum(entry.T for entry in entries), sum(entry.episodes for entry in entries)
    size = decoded_size(layout, shards[0].kind, steps, len(entries), episodes)
    return Flat(entries, cached_arrays(f"histories-{digest.hexdigest()}", size, build))


def _decoded(
    layout: Layout, entries: Sequence[Entry], shards: Sequence[Shard], threads: int, make: Callable
) -> dict[str, np.ndarray]:
    """Flat arrays by field; `make(shape, dtype, name)` allocates one, zeroed."""
    arrays = {}
    for field in held_fields(shards[0].kind):
        if not any(entry.has(field) for entry in entries):
            continue
        rows = sum(entry.rows(field) for entry in entries) + (len(entries) + 1 if field.axis == "T" else 0)
        element = field.held(layout)
        arrays[field.name] = make((rows, *element.shape), element.base, field.name)
    firsts = {axis: _first_rows(entries, axis) for axis in ("T", "E")}

    def decode(start: int, stop: int) -> None:
        for number in range(start, stop):
            entry, shard = entries[number], shards[number]
            for name, array in arrays.items():
                if entry.has(FIELDS[name]):
                    first = firsts[FIELDS[name].axis][number]
                    shard.decode_into(entry.history_id, FIELDS[name], array[first : first + entry.rows(FIELDS[name])])

    in_slices(decode, len(entries), threads)
    return arrays


def _first_rows(entries: Sequence[Entry], axis: str) -> np.ndarray:
    """Where each history begins; before each history's steps stands one row of zeros: what precedes the first step."""
    lengths = np.array([entry.T + 1 if axis == "T" else entry.episodes for entry in entries])
    return np.cumsum(lengths) - lengths + (1 if axis == "T" else 0)


class Flat:
    """Histories one after the other in flat arrays, in memory or memory-mapped."""

    def __init__(self, entries: Sequence[Entry], arrays: dict[str, np.ndarray]) -> None:
        self._arrays = arrays
        self._first, self._first_end = _first_rows(entries, "T"), _first_rows(entries, "E")
        self._lengths = np.array([entry.T for entry in entries])

    def windows(self, field: str, which: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
        length = out.shape[1]
        array, first = self._arrays[field], self._first[which] + starts
        beyond = starts + length - self._lengths[which]
        if length > len(array) or (beyond > 0).any():
            for row, (begin, missing) in enumerate(zip(first.tolist(), np.maximum(beyond, 0).tolist(), strict=True)):
                kept = max(length - missing, 0)
                out[row, :kept], out[row, kept:] = array[begin : begin + kept], 0
        else:
            _copy_windows(array, first, out)

    def steps(self, field: str, which: np.ndarray, steps: np.ndarray) -> np.ndarray:
        return self._arrays[field][self._first[which][:, None] + steps]

    def ends(self, which: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        return self._arrays["episode_end_state"][self._first_end[which] + episodes]

    def lacking(self, fields: Sequence[str], which: np.ndarray, low: np.ndarray, high: np.ndarray) -> list:
        return []


def _copy_windows(array: np.ndarray, first: np.ndarray, out: np.ndarray) -> None:
    """Rows first..first + L of array (N,) or (N, S) into out (n, L) or (n, L, S), C-contiguous: a block a window."""
    size = array[0].size
    flat, width = array.reshape(-1), out.shape[1] * size
    # What sliding_window_view gives, without its twenty microseconds.
    blocks = np.ndarray((flat.size - width + 1, width), flat.dtype, flat, strides=flat.strides * 2)
    place, target = first * size, out.reshape(len(out), -1)
    windows = max(1, _COPIED // (width * flat.itemsize))
    for low in range(0, len(out), windows):
        rows = slice(low, low + windows)
        target[rows] = blocks[place[rows]]


class Streamed:
    """Histories in their shards, read a few chunks at a time."""

    def __init__(self, layout: Layout, entries: Sequence[Entry], shards: Sequence[Shard]) -> None:
        self._entries, self._shards, self._layout = entries, shards, layout
        self._remote = {id(shard): shard for shard in shards if shard.is_remote}

    @cached_property
    def _lengths(self) -> list[int]:
        return [entry.T for entry in self._entries]

    def windows(self, field: str, which: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
        length, lengths = out.shape[1], self._lengths
        for row, (position, begin) in enumerate(zip(which.tolist(), starts.tolist(), strict=True)):
            window = out[row]
            low, high = max(begin, 0), min(begin + length, lengths[position])
            if high - low < length:
                window[...] = 0
            if low < high:
                history_id = self._entries[position].history_id
                self._shards[position].read_into(history_id, FIELDS[field], low, window[low - begin : high - begin])

    def steps(self, field: str, which: np.ndarray, steps: np.ndarray) -> np.ndarray:
        rows = []
        for position, wanted in zip(which.tolist(), steps, strict=True):
            low = int(wanted.min())
            history_id = self._entries[position].history_id
            rows.append(
                self._shards[position].read(history_id, FIELDS[field], low, int(wanted.max()) + 1)[wanted - low]
            )
        return np.stack(rows) if rows else np.zeros((*steps.shape, *FIELDS[field].held(self._layout).shape), np.uint8)

    def ends(self, which: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        out = np.empty((len(which), *FIELDS["episode_end_state"].held(self._layout).shape), np.uint8)
        for row, (position, episode) in enumerate(zip(which.tolist(), episodes.tolist(), strict=True)):
            history_id = self._entries[position].history_id
            out[row] = self._shards[position].read(history_id, FIELDS["episode_end_state"], episode, episode + 1)[0]
        return out

    def lacking(self, fields: Sequence[str], which: np.ndarray, low: np.ndarray, high: np.ndarray) -> list:
        if not self._remote:
            return []
        rows: dict[int, list[int]] = {key: [] for key in self._remote}
        for position, first, last in zip(which.tolist(), low.tolist(), high.tolist(), strict=True):
            entry, shard = self._entries[position], self._shards[position]
            for field in map(FIELDS.__getitem__, fields):
                stop = min(last, entry.rows(field))
                rows[id(shard)].extend(shard.needed(entry.history_id, field, max(first, 0), stop))
        return [part for key, some in rows.items() for part in self._remote[key].lacking(some)]
