"""meta/histories.jsonl as columns: parsed block by block, kept in the cache folder, entries made when asked for."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, overload

import numpy as np

from icrl4aht_data.benchmark.facts import FAMILIES, check_place
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, unknown
from icrl4aht_data.format.schema import FINITE, JSON_TYPES, LONGEST, Entry, is_name
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.utils.cache import cached_arrays, content_hash
from icrl4aht_data.utils.files import LINE_BYTES, parse_json, plain_size, wrap_read_errors
from icrl4aht_data.utils.paths import LARGEST

QUERY_FIELDS = ("layout", "split", "track", "teammate_family", "teammate_kind", "task_id")
"""The entry fields that can be filtered by."""

_VERSION = 1  # of the cached columns
_UNCACHED = 2**20  # bytes: a smaller index is parsed as quickly as its columns are opened
_BLOCK = 2**19  # bytes parsed at a time

_NAMES = tuple(field.name for field in fields(Entry))
_DTYPES = {"int": np.int64, "bool": np.bool_, "float": np.float64, "int | None": np.int64}
_NUMBERS = {field.name: _DTYPES[str(field.type)] for field in fields(Entry) if str(field.type) in _DTYPES}
_STRINGS = tuple(field.name for field in fields(Entry) if str(field.type) == "str")
_DERIVED = ("history_id", "obs_shape")  # the row, and the layout's: checked, not stored
_RULED = ("track", "split", "layout", "teammate_family", "obs_shape", "action_dim", "shard")

Block = dict[str, tuple[list[Any] | np.ndarray, np.ndarray]]
"""column -> values, and which of them each line has"""


class Columns(Sequence[Entry]):
    """The index as arrays, one row a history; also the sequence of its entries, made when asked for.

    A string column is int32 codes into its values; `h5_row` is -1 for null. Histories that agree in all of
    `QUERY_FIELDS` form a combination; `order` lists the rows combination by combination, ascending within each.
    """

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self._arrays = arrays
        self.combinations = arrays["combinations"]  # int64 (N, 6): codes of QUERY_FIELDS
        self.order, self.starts = arrays["order"], arrays["starts"]

    def __len__(self) -> int:
        return len(self._arrays["T"])

    def __getstate__(self) -> dict[str, np.ndarray]:
        return self._arrays

    def __setstate__(self, arrays: dict[str, np.ndarray]) -> None:
        self.__init__(arrays)

    def column(self, name: str) -> np.ndarray:
        """A number column's values, or a string column's codes."""
        return self._arrays[name]

    def values(self, name: str) -> list[str]:
        """A string column's distinct values, by code, in order of first appearance."""
        return [value.decode() for value in self._arrays[f"{name}.values"].tolist()]

    def code(self, name: str, value: str) -> int | None:
        """The code of a string column's value, found by bisection; None if no line has it."""
        values, ascending = self._arrays[f"{name}.values"], self._arrays[f"{name}.sorted"]
        wanted = value.encode()
        if len(wanted) > values.itemsize:
            return None
        place = int(np.searchsorted(values, np.array(wanted, values.dtype), sorter=ascending))
        if place == len(values) or values[ascending[place]] != wanted:
            return None
        return int(ascending[place])

    def rows(self, combination: int) -> np.ndarray:
        """The rows of one combination, ascending."""
        return self.order[self.starts[combination] : self.starts[combination + 1]]

    def shard_rows(self, shard: str) -> np.ndarray:
        """The rows of one shard, ascending."""
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
        values: dict[str, Any] = {name: self._arrays[name][row].item() for name in _NUMBERS if name not in _DERIVED}
        for name in _STRINGS:
            values[name] = self._arrays[f"{name}.values"][self._arrays[name][row]].item().decode()
        if values["h5_row"] < 0:
            values["h5_row"] = None
        return Entry(history_id=row, obs_shape=LAYOUTS[values["layout"]].obs_shape, **values)


def read_columns(path: Path) -> Columns:
    """The columns of an index file: from the cache folder if the file is large and its content was seen before.

    Raises:
        IndexFormatError: names the file and the line.
    """
    with wrap_read_errors(path):
        size = plain_size(path, LARGEST)
        if size < _UNCACHED:
            return Columns(_parse(path))
        key = f"index-{_VERSION}-{content_hash(path)}"
    parsed: dict[str, np.ndarray] = {}

    def build(folder: Path) -> None:
        parsed.update(_parse(path))
        for name, array in parsed.items():
            np.save(folder / f"{name}.npy", array, allow_pickle=False)

    try:
        return Columns(cached_arrays(key, size, build))
    except (OSError, Icrl4ahtError) as error:
        if isinstance(error, IndexFormatError):
            raise
        return Columns(parsed or _parse(path))  # no cache folder, or one too small: do without


def _parse(path: Path) -> dict[str, np.ndarray]:
    """Every array of `Columns`."""
    merged = {name: _Merged(name) for name in _NAMES if name not in _DERIVED}
    first = 0
    for text in _blocks(path):
        block = _split(text)
        if block is None or not _is_valid(block, first):
            block = _parse_lines(text.split(b"\n"), first, path)
        for name, column in merged.items():
            column.add(*block[name])
        first += len(block["T"][1])
    arrays: dict[str, np.ndarray] = {}
    for column in merged.values():
        arrays |= column.arrays()
    return arrays | _combined(arrays)


def _blocks(path: Path) -> Iterator[bytes]:
    """The file in blocks of whole lines, without the last line's end."""
    with wrap_read_errors(path), path.open("rb") as stream:
        while text := stream.read(_BLOCK):
            text += stream.readline(LINE_BYTES)
            if len(text) - text.rfind(b"\n", 0, -1) > LINE_BYTES:
                raise IndexFormatError(f"{path}: a line has more than {LINE_BYTES:,} bytes")
            yield text.removesuffix(b"\n")


class _Merged:
    """One column over all blocks."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._codes: dict[Any, int] = {}
        self._parts: list[np.ndarray] = []

    def add(self, values: list[Any] | np.ndarray, which: np.ndarray) -> None:
        if self.name in _STRINGS:
            values = np.array([self._codes.setdefault(value, len(self._codes)) for value in values], np.int32)
        elif not isinstance(values, np.ndarray):
            values = np.array([-1 if value is None else value for value in values], _NUMBERS[self.name])
        self._parts.append(values[which])

    def arrays(self) -> dict[str, np.ndarray]:
        if self.name not in _STRINGS:
            return {self.name: np.concatenate(self._parts or [np.zeros(0, _NUMBERS[self.name])])}
        values = np.array([value.encode() for value in self._codes] or [b""], np.bytes_)[: len(self._codes)]
        return {
            self.name: np.concatenate(self._parts or [np.zeros(0, np.int32)]),
            f"{self.name}.values": values,
            f"{self.name}.sorted": np.argsort(values, kind="stable").astype(np.int32),
        }


def _combined(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows of every combination of the query fields, and of every shard."""
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


def _split(text: bytes) -> Block | None:
    """The columns of lines written as our writer writes them, cut at the field names: quicker than a JSON parser.

    None if any line is written otherwise. Strings are parsed as JSON, each distinct one once.
    """
    lines = text.count(b"\n") + 1
    pieces = text.replace(b"\n", b', "').split(b', "')
    if len(pieces) != lines * len(_NAMES):
        return None
    block: Block = {}
    for number, name in enumerate(_NAMES):
        head, tail = f'{name}": '.encode(), b""
        if number == 0:
            head = b'{"' + head
        elif number == len(_NAMES) - 1:
            tail = b"}"
        column = pieces[number :: len(_NAMES)]
        if column.count(column[0]) == lines:
            column, which = column[:1], np.zeros(lines, np.intp)
        elif name in _STRINGS or name in _RULED:
            places = {piece: place for place, piece in enumerate(dict.fromkeys(column))}
            column, which = list(places), np.fromiter(map(places.__getitem__, column), np.intp, lines)
        else:
            which = np.arange(lines)
        joined = b",".join(column)
        if joined.count(head) != len(column) or (tail and joined.count(tail) != len(column)):
            return None
        joined = joined.replace(head, b"").replace(tail, b"") if tail else joined.replace(head, b"")
        values = _decimals(joined, _NUMBERS.get(name)) if len(column) == lines else None
        values = _json_values(joined) if values is None else values
        if values is None or len(values) != len(column):
            return None
        block[name] = values, which
    return block


def _json_values(joined: bytes) -> list[Any] | None:
    try:
        return json.loads(b"[" + joined + b"]")
    except (ValueError, RecursionError):
        return None


def _decimals(joined: bytes, dtype: type | None) -> np.ndarray | None:
    """Finite numbers with commas between them, three times as quick as by a JSON parser; None if they are not."""
    allowed = {np.float64: b"0123456789.-+e,", np.int64: b"0123456789-,"}.get(dtype)
    if allowed is None or joined.translate(None, allowed):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what NumPy makes of malformed text
        try:
            values = np.fromstring(joined, dtype, sep=",")
        except (DeprecationWarning, ValueError):
            return None
    too_large = dtype is np.int64 and ((values >= 2**62) | (values <= -(2**62))).any()  # NumPy clips them
    return None if too_large else values


def _parse_lines(lines: list[bytes], first: int, path: Path) -> Block:
    """The same of any lines, with every check on each of them."""
    entries = []
    for number, line in enumerate(lines, start=first):
        try:
            entry = Entry.from_json(parse_json(line.decode()))
            check_entry(entry, number)
        except UnicodeDecodeError as error:
            raise IndexFormatError(f"{path}, line {number + 1}: not UTF-8 text: {error}") from error
        except Icrl4ahtError as error:
            raise IndexFormatError(f"{path}, line {number + 1}: {error}") from error
        entries.append(entry)
    every = np.arange(len(entries))
    return {name: ([getattr(entry, name) for entry in entries], every) for name in _NAMES}


def _is_valid(block: Block, first: int) -> bool:
    """Whether `check_entry` and `Entry.from_json` would take every line."""
    lists = {name: values for name, (values, _) in block.items() if not isinstance(values, np.ndarray)}
    if not all(set(map(type, values)) <= JSON_TYPES[name] for name, values in lists.items()):
        return False
    if not all(is_name(value) for name in _STRINGS for value in lists[name]):
        return False
    for name in (name for name, dtype in _NUMBERS.items() if dtype is np.float64):
        if not (np.abs(np.asarray(block[name][0], np.float64)) < FINITE).all():
            return False
    try:
        ids, steps, episodes, _, _ = (
            np.asarray(block[name][0], np.int64)[block[name][1]]
            for name in ("history_id", "T", "episodes", "env_idx", "seed")
        )
        ruled = np.zeros(len(ids), np.int64)
        for name in _RULED:
            values, which = block[name]
            ruled = ruled * len(values) + which
        for row in np.unique(ruled, return_index=True)[1].tolist():
            line = {name: values[which[row]] for name, (values, which) in block.items()}
            line |= {name: value.item() for name, value in line.items() if isinstance(value, np.generic)}
            check_entry(Entry.from_json(line), first + row)
    except (Icrl4ahtError, OverflowError):
        return False
    counted = np.array_equal(ids, np.arange(first, first + len(ids)))
    return bool(counted and (episodes > 0).all() and (episodes <= steps).all() and (steps < LONGEST).all())


def check_entry(entry: Entry, number: int) -> None:
    """Everything in the entry of line `number` (from 0) that other parts rely on.

    Raises:
        IndexFormatError, UnknownNameError: without file and line, which the caller adds.
    """
    if entry.history_id != number:
        raise IndexFormatError(f"history_id {entry.history_id}: ids count up from 0, expected {number}")
    check_place(entry.track, entry.split, entry.layout)
    if entry.teammate_family not in FAMILIES:
        raise unknown("teammate_family", entry.teammate_family, FAMILIES)
    expected = LAYOUTS[entry.layout].obs_shape
    if entry.obs_shape != expected:
        raise IndexFormatError(f"obs_shape {list(entry.obs_shape)}, expected {list(expected)} for {entry.layout}")
    if entry.action_dim != len(ACTIONS):
        raise IndexFormatError(f"expected action_dim {len(ACTIONS)}, found {entry.action_dim}")
    folder = f"data/{entry.track}/{entry.layout}/{entry.split}"
    if not re.fullmatch(rf"{folder}-[0-9]{{5}}-of-[0-9]{{5}}\.h5", entry.shard):
        raise IndexFormatError(f"shard {entry.shard!r}: expected {folder}-NNNNN-of-NNNNN.h5")
    if entry.episodes > entry.T:
        raise IndexFormatError(f"{entry.episodes} episodes in {entry.T} steps")
