"""meta/info.json and meta/histories.jsonl of a release: read, checked, and queried."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark import ACTIONS, FAMILIES, SPLITS, TRACKS, check_place, unknown
from icrl4aht_data.errors import (
    EmptySelectionError,
    FormatTooNewError,
    FormatTooOldError,
    Icrl4ahtError,
    IndexFormatError,
    RootNotFoundError,
    UnknownNameError,
)
from icrl4aht_data.files import parse_json, read_text
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout
from icrl4aht_data.schema import FORMAT_VERSION, HISTORIES, INFO, KINDS, Entry

QUERY_FIELDS = ("layout", "split", "track", "teammate_family", "teammate_kind", "task_id")
"""The entry fields that can be filtered by."""


@dataclass(frozen=True, eq=False)
class Index:
    """A release's index. A history's id is its place in `entries`."""

    root: Path
    info: dict[str, Any]
    entries: tuple[Entry, ...]

    @cached_property
    def _by_value(self) -> dict[str, dict[str, np.ndarray]]:
        """field -> value -> rows, ascending."""
        tables: dict[str, dict[str, list[int]]] = {name: {} for name in QUERY_FIELDS}
        for row, entry in enumerate(self.entries):
            for name, table in tables.items():
                table.setdefault(getattr(entry, name), []).append(row)
        return {name: {v: np.array(rows) for v, rows in table.items()} for name, table in tables.items()}

    def entry(self, history_id: int) -> Entry:
        """The entry of one history.

        Raises:
            UnknownNameError: if there is none.
        """
        if not 0 <= history_id < len(self.entries):
            raise UnknownNameError(f"{self.root}: no history with id {history_id}; ids: 0..{len(self.entries) - 1}")
        return self.entries[history_id]

    def values(self, name: str) -> list[str]:
        """What a query field takes in this release."""
        return list(self._by_value[name])

    def query(self, **wanted: str | Sequence[str] | None) -> np.ndarray:
        """Ids, ascending, of the histories whose fields have one of the wanted values; None means any.

        Raises:
            UnknownNameError: for a field or a value that the benchmark does not know; lists the valid ones.
            EmptySelectionError: for valid values that no history of this release has; says what exists.
        """
        rows = np.arange(len(self.entries))
        for name, value in wanted.items():
            if value is None:
                continue
            if name not in QUERY_FIELDS:
                raise unknown("filter", name, QUERY_FIELDS)
            values = [self._canonical(name, v) for v in ([value] if isinstance(value, str) else value)]
            table = self._by_value[name]
            matching = [table[v] for v in values if v in table]
            rows = np.intersect1d(rows, np.concatenate(matching)) if matching else rows[:0]
        if not len(rows):
            asked = ", ".join(f"{name}={value!r}" for name, value in wanted.items() if value is not None) or "any"
            raise EmptySelectionError(f"{self.root}: no history has {asked}. This release has {self.summary()}")
        return rows

    def _canonical(self, name: str, value: str) -> str:
        if name == "layout":
            return get_layout(value).name
        fixed = {"split": SPLITS, "track": tuple(TRACKS), "teammate_family": FAMILIES}.get(name)
        valid = fixed or self.values(name)
        if value not in valid:
            raise unknown(name, value, valid)
        return value

    def summary(self) -> str:
        """The combinations that exist, in one line."""
        counts: dict[tuple[str, str, str], int] = {}
        for entry in self.entries:
            key = (entry.split, entry.layout, entry.teammate_family)
            counts[key] = counts.get(key, 0) + 1
        parts = [f"{split}/{layout} with {family} ({n})" for (split, layout, family), n in counts.items()]
        return ", ".join(parts) or "no histories"


def read_index(root: Path) -> Index:
    """Read and check a release's index.

    Raises:
        RootNotFoundError, FormatTooNewError, FormatTooOldError, IndexFormatError: each names the file, and the line.
    """
    info = read_info(root)
    path = root / HISTORIES
    entries: list[Entry] = []
    for number, line in enumerate(read_text(path).splitlines()):
        try:
            entry = Entry.from_json(parse_json(line))
            _check_entry(entry, number)
        except Icrl4ahtError as error:
            raise IndexFormatError(f"{path}, line {number + 1}: {error}") from error
        entries.append(entry)
    if len(entries) != info["histories"]:
        raise IndexFormatError(f"{path}: {len(entries)} lines, but {root / INFO} counts {info['histories']} histories")
    return Index(root, info, tuple(entries))


def _check_entry(entry: Entry, number: int) -> None:
    """Everything in an entry that other parts rely on."""
    if entry.history_id != number:
        raise IndexFormatError(f"history_id {entry.history_id}: ids count up from 0, expected {number}")
    check_place(entry.track, entry.split, entry.layout)
    if entry.teammate_family not in FAMILIES:
        raise unknown("teammate_family", entry.teammate_family, FAMILIES)
    expected = LAYOUTS[entry.layout].obs_shape
    if entry.obs_shape != expected:
        raise IndexFormatError(f"obs_shape {list(entry.obs_shape)}, expected {list(expected)} for {entry.layout}")
    if entry.action_dim != len(ACTIONS) or not entry.has_teammate_actions:
        raise IndexFormatError(f"expected action_dim {len(ACTIONS)} and has_teammate_actions true")
    folder = f"data/{entry.track}/{entry.layout}/{entry.split}"
    if not re.fullmatch(rf"{folder}-\d{{5}}-of-\d{{5}}\.h5", entry.shard):
        raise IndexFormatError(f"shard {entry.shard!r}: expected {folder}-NNNNN-of-NNNNN.h5")
    if entry.episodes > entry.T:
        raise IndexFormatError(f"{entry.episodes} episodes in {entry.T} steps")


_INFO_TYPES: dict[str, type | tuple[type, ...]] = {
    "kind": str,
    "data_version": str,
    "histories": int,
    "environment": dict,
    "layouts": dict,
}


def read_info(root: Path) -> dict[str, Any]:
    """meta/info.json of a release whose format this package reads."""
    path = root / INFO
    if not path.is_file():
        raise RootNotFoundError(
            f"{root}: no release here, expected {INFO} in it; give a release folder, or make one with `make generate`"
        )
    try:
        info = parse_json(read_text(path))
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: malformed: {error}") from error
    version = info.get("format_version") if isinstance(info, dict) else None
    if not isinstance(version, int):
        raise IndexFormatError(f"{path}: malformed: expected an object with an integer format_version")
    if version > FORMAT_VERSION:
        raise FormatTooNewError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: `pip install -U icrl4aht-data`"
        )
    if version < FORMAT_VERSION:
        raise FormatTooOldError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: rebuild or fetch the release again"
        )
    wrong = [name for name, kind in _INFO_TYPES.items() if not isinstance(info.get(name), kind)]
    if wrong or info["kind"] not in KINDS or not _is_environment(info["environment"]):
        raise IndexFormatError(f"{path}: malformed: {', '.join(wrong) or 'kind or environment'} not as expected")
    return info


def _is_environment(value: dict[str, Any]) -> bool:
    steps = [value.get(name) for name in ("max_steps", "kept_steps")]
    return len(value) == 2 and all(isinstance(n, int) and n > 0 for n in steps)
