"""Columns of meta/histories.jsonl: decoded and checked block by block, and kept in the cache folder."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, overload

import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import check_family, check_membership
from icrl4aht_data.errors import CacheError, Icrl4ahtError, IndexFormatError, OptionError
from icrl4aht_data.format.cached_arrays import cached_arrays
from icrl4aht_data.format.schema import ENTRY_HINTS, Entry, check_name
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import LARGEST, LINE_BYTES, plain_size, wrap_read_errors
from icrl4aht_data.utils.hashes import file_hash

QUERY_FIELDS = ("layout", "split", "track", "teammate_family", "teammate_kind", "task_id", "source")
"""Entry fields that histories can be filtered by."""

_VERSION = 3  # of the cached columns
_UNCACHED = 2**20  # bytes; decoding a smaller index is as fast as opening cached columns
_BLOCK = 2**19  # bytes decoded at a time

_DERIVED = ("history_id", "obs_shape")  # checked but not stored, since the row number and the layout determine them
_DTYPES = {int: np.int64, bool: np.bool_, float: np.float64, int | None: np.int64, float | None: np.float64}
_NUMBERS = {name: _DTYPES[hint] for name, hint in ENTRY_HINTS.items() if hint in _DTYPES and name not in _DERIVED}
_OPTIONAL = {name: hint for name, hint in ENTRY_HINTS.items() if hint in (int | None, float | None)}
_STRINGS = tuple(name for name, hint in ENTRY_HINTS.items() if hint is str)
_RELATED = ("track", "split", "layout", "teammate_family", "obs_shape", "shard")

_DECODER = msgspec.json.Decoder(Entry)


class Columns(Sequence[Entry]):
    """Index of a release as columns with one row per history; a sequence of `Entry`, each made on access.

    A string column has int32 codes of its distinct values. None is stored as -1 in integer columns and as NaN in float
    columns. Histories with equal values of all `QUERY_FIELDS` form a combination.

    Args:
        arrays: every column by name; see `combinations`, `order` and `starts`.

    Attributes:
        combinations: int64 (N, 7), codes of `QUERY_FIELDS`.
        order: int64 (H,), row numbers sorted by combination, ascending within each.
        starts: int64 (N + 1,), position of each combination's first row in `order`.
    """

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self._arrays = arrays
        self.combinations, self.order, self.starts = (arrays[name] for name in ("combinations", "order", "starts"))

    def __len__(self) -> int:
        return len(self._arrays["T"])

    def __getstate__(self) -> dict[str, np.ndarray]:
        return self._arrays

    def __setstate__(self, arrays: dict[str, np.ndarray]) -> None:
        self.__init__(arrays)

    def column(self, name: str) -> np.ndarray:
        """Return a column (H,): the values of a number column, the codes of a string column."""
        return self._arrays[name]

    def values(self, name: str) -> list[str]:
        """Return the distinct values of a string column, in the order of their codes."""
        return [value.decode() for value in self._arrays[f"{name}.values"].tolist()]

    def code(self, name: str, value: str) -> int | None:
        """Return the code of a string column's value; None if no history has it."""
        values, ascending = self._arrays[f"{name}.values"], self._arrays[f"{name}.sorted"]
        wanted = value.encode()
        if len(wanted) > values.itemsize:
            return None
        position = int(np.searchsorted(values, np.array(wanted, values.dtype), sorter=ascending))
        if position == len(values) or values[ascending[position]] != wanted:
            return None
        return int(ascending[position])

    def rows(self, combination: int) -> np.ndarray:
        """Return the row numbers of a combination's histories, ascending."""
        return self.order[self.starts[combination] : self.starts[combination + 1]]

    def shard_rows(self, shard: str) -> np.ndarray:
        """Return the row numbers of a shard's histories, ascending."""
        code = self.code("shard", shard)
        if code is None:
            return self.order[:0]
        starts = self._arrays["shard_starts"]
        return self._arrays["shard_order"][starts[code] : starts[code + 1]]

    @overload
    def __getitem__(self, row: int) -> Entry: ...

    @overload
    def __getitem__(self, row: slice) -> list[Entry]: ...

    def __getitem__(self, row: int | slice) -> Entry | list[Entry]:
        if isinstance(row, slice):
            return [self[i] for i in range(len(self))[row]]
        row = range(len(self))[row]
        values: dict[str, Any] = {name: self._arrays[name][row].item() for name in _NUMBERS}
        for name in _STRINGS:
            values[name] = self._arrays[f"{name}.values"][self._arrays[name][row]].item().decode()
        for name, hint in _OPTIONAL.items():
            if values[name] == -1 if hint == int | None else math.isnan(values[name]):
                values[name] = None
        return Entry(history_id=row, obs_shape=get_layout(values["layout"]).obs_shape, **values)


def read_columns(path: Path) -> Columns:
    """Return the columns of an index file; those of a large file are cached on disk.

    Raises:
        IndexFormatError: if a line is malformed; with the file and the line number.
    """
    with wrap_read_errors(path):
        size = plain_size(path, LARGEST)
        if size < _UNCACHED:
            return Columns(_parse(path))
        key = f"index-{_VERSION}-{file_hash(path)}"  # as in the manifest
    parsed: dict[str, np.ndarray] = {}

    def build(folder: Path) -> None:
        parsed.update(_parse(path))
        for name, array in parsed.items():
            np.save(folder / f"{name}.npy", array, allow_pickle=False)

    try:
        return Columns(cached_arrays(key, size, build))
    except (CacheError, OptionError):  # the cache folder is missing or too small
        return Columns(parsed or _parse(path))


def _parse(path: Path) -> dict[str, np.ndarray]:
    """Read an index file and return the arrays of `Columns` by name."""
    codes = {name: _Codes() for name in (*_STRINGS, "obs_shape")}
    parts: dict[str, list[np.ndarray]] = {name: [] for name in (*_NUMBERS, *_STRINGS)}
    first = 0
    for text in _blocks(path):
        entries = _decode(text, first, path)
        try:
            block = _encode(entries, codes, first)
        except _LineError as error:
            raise IndexFormatError(f"{path}, line {first + error.row + 1}: {error}") from error
        for name, arrays in parts.items():
            arrays.append(block[name])
        first += len(entries)
    arrays = {
        name: np.concatenate([np.zeros(0, _NUMBERS.get(name, np.int32)), *blocks]) for name, blocks in parts.items()
    }
    for name in _STRINGS:
        values = np.array([value.encode() for value in codes[name]] or [b""], np.bytes_)[: len(codes[name])]
        arrays |= {f"{name}.values": values, f"{name}.sorted": np.argsort(values, kind="stable").astype(np.int32)}
    return arrays | _group_rows(arrays)


def _blocks(path: Path) -> Iterator[bytes]:
    """Yield blocks of complete lines of a file, each without its last newline."""
    with wrap_read_errors(path), path.open("rb") as stream:
        while text := stream.read(_BLOCK):
            text += stream.readline(LINE_BYTES)
            if len(text) - text.rfind(b"\n", 0, -1) > LINE_BYTES:
                raise IndexFormatError(f"{path}: a line has more than {LINE_BYTES:,} bytes")
            yield text.removesuffix(b"\n")


def _decode(text: bytes, first: int, path: Path) -> list[Entry]:
    """Return the entries of a block of lines; `first` is the number of its first line, counted from 0."""
    newlines = text.count(b"\n")
    # Without this check, the decoder would accept an object that spans two lines.
    if text.count(b"\n{") == newlines:
        try:
            entries = _DECODER.decode_lines(text)
            if len(entries) == newlines + 1:
                return entries
        except (msgspec.MsgspecError, UnicodeDecodeError):
            pass
    entries = []
    for number, line in enumerate(text.split(b"\n"), start=first + 1):  # decode line by line to find the malformed one
        try:
            entries.append(_DECODER.decode(line.decode()))
        except UnicodeDecodeError as error:
            raise IndexFormatError(f"{path}, line {number}: not UTF-8 text: {error}") from error
        except msgspec.MsgspecError as error:
            raise IndexFormatError(f"{path}, line {number}: {error}") from error
    return entries


class _LineError(Icrl4ahtError):
    """Error about one line of a block, at `row`."""

    def __init__(self, row: int, problem: object) -> None:
        super().__init__(str(problem))
        self.row = row


class _Codes(dict[Any, int]):
    """Mapping of values to codes, in which a new value gets the next code when it is looked up."""

    def __missing__(self, value: Any) -> int:
        if isinstance(value, str):
            check_name(value)
        code = self[value] = len(self)
        return code


def _encode(entries: list[Entry], codes: dict[str, _Codes], first: int) -> dict[str, np.ndarray]:
    """Return the columns of a block of entries, after checking them.

    Args:
        entries: entries with valid types and bounds.
        codes: codes of each string field; new values are added.
        first: the number of the first line, counted from 0.

    Raises:
        _LineError: if a name is not printable, an id is wrong, or fields contradict one another.
    """
    values: dict[str, Sequence[Any]] = dict(
        zip(ENTRY_HINTS, zip(*map(msgspec.structs.astuple, entries), strict=True), strict=True)
    )
    block: dict[str, np.ndarray] = {}
    for name, known in codes.items():
        try:
            block[name] = np.fromiter(map(known.__getitem__, values[name]), np.int32, len(entries))
        except IndexFormatError as error:
            row = next(row for row, value in enumerate(values[name]) if value not in known)
            raise _LineError(row, f"field {name!r}: {error}") from error
    for name, hint in _OPTIONAL.items():
        absent = -1 if hint == int | None else np.nan
        values[name] = [absent if value is None else value for value in values[name]]
    for name, dtype in (*_NUMBERS.items(), ("history_id", np.int64)):
        block[name] = np.array(values[name], dtype)

    for row in np.flatnonzero(block["history_id"] != np.arange(first, first + len(entries))).tolist():
        raise _LineError(row, f"history_id {values['history_id'][row]}: ids count up from 0, expected {first + row}")
    for row in np.flatnonzero(block["action_dim"] != len(ACTIONS)).tolist():
        raise _LineError(row, f"expected action_dim {len(ACTIONS)}, found {values['action_dim'][row]}")
    for row in np.flatnonzero(block["episodes"] > block["T"]).tolist():
        raise _LineError(row, f"{values['episodes'][row]} episodes in {values['T'][row]} steps")
    # The histories of a task agree in these fields, so few combinations have to be checked.
    combinations = np.zeros(len(entries), np.int64)
    for name in _RELATED:
        combinations = np.unique(combinations * len(codes[name]) + block[name], return_inverse=True)[1]
    for row in sorted(np.unique(combinations, return_index=True)[1].tolist()):
        try:
            _check_related(*(values[name][row] for name in _RELATED))
        except Icrl4ahtError as error:
            raise _LineError(row, error) from error
    return block


def _check_related(
    track: str, split: str, layout: str, family: str, obs_shape: tuple[int, int, int], shard: str
) -> None:
    """Check that the track, family, shape and shard path of an entry fit its layout and split.

    Raises:
        IndexFormatError, UnknownNameError: without file and line, which the caller adds.
    """
    check_membership(track, split, layout)
    check_family(family)
    expected = get_layout(layout).obs_shape
    if obs_shape != expected:
        raise IndexFormatError(f"obs_shape {list(obs_shape)}, expected {list(expected)} for {layout}")
    folder = f"data/{track}/{layout}/{split}"
    if not re.fullmatch(rf"{folder}-[0-9]{{5}}-of-[0-9]{{5}}\.h5", shard):
        raise IndexFormatError(f"shard {shard!r}: expected {folder}-NNNNN-of-NNNNN.h5")


def _group_rows(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return arrays that list the rows of each combination of query fields, and of each shard."""
    sizes = [max(1, len(arrays[f"{name}.values"])) for name in QUERY_FIELDS]
    keys = np.zeros(len(arrays["T"]), np.int64)
    for name, size in zip(QUERY_FIELDS, sizes, strict=True):
        keys = keys * size + arrays[name]
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    by_shard = np.argsort(arrays["shard"], kind="stable")
    shards = np.arange(len(arrays["shard.values"]) + 1)
    return {
        "combinations": np.stack([arrays[name][order[first]] for name in QUERY_FIELDS], axis=-1),
        "order": order,
        "starts": np.append(first, len(order)),
        "shard_order": by_shard,
        "shard_starts": np.searchsorted(arrays["shard"][by_shard], shards),
    }
