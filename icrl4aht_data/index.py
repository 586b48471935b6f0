"""meta/info.json and meta/histories.jsonl of a release: read, checked, and queried."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from icrl4aht_data.benchmark import FAMILIES, SPLITS, TRACKS, unknown
from icrl4aht_data.errors import (
    EmptySelectionError,
    FormatTooNewError,
    FormatTooOldError,
    IndexFormatError,
    RootNotFoundError,
    UnknownNameError,
)
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout
from icrl4aht_data.schema import FORMAT_VERSION, HISTORIES, INFO, KINDS, Entry

QUERY_FIELDS = ("layout", "split", "track", "teammate_family", "teammate_kind", "task_id")
"""The entry fields that can be filtered by."""


@dataclass(frozen=True, eq=False)
class Index:
    """A release's index. Entries stand in the order of their ids."""

    root: Path
    info: dict[str, Any]
    entries: tuple[Entry, ...]

    @cached_property
    def _rows(self) -> dict[int, int]:
        return {entry.history_id: row for row, entry in enumerate(self.entries)}

    @cached_property
    def _by_value(self) -> dict[str, dict[str, np.ndarray]]:
        """field -> value -> rows, ascending: every query is a look-up, none is a scan."""
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
        row = self._rows.get(history_id)
        if row is None:
            ids = f"{self.entries[0].history_id}..{self.entries[-1].history_id}" if self.entries else "none"
            raise UnknownNameError(f"{self.root}: no history with id {history_id}; ids: {ids}")
        return self.entries[row]

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
            asked = ", ".join(f"{name}={value!r}" for name, value in wanted.items() if value is not None)
            raise EmptySelectionError(f"{self.root}: no history has {asked}. This release has {self.summary()}")
        return np.array([self.entries[row].history_id for row in rows])

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
    seen: set[int] = set()
    for number, line in enumerate(_text(path).splitlines(), start=1):
        try:
            entry = Entry.from_json(json.loads(line))
            _check_entry(entry, seen)
        except (json.JSONDecodeError, IndexFormatError, UnknownNameError) as error:
            raise IndexFormatError(f"{path}, line {number}: {error}") from error
        entries.append(entry)
    if len(entries) != info["histories"]:
        raise IndexFormatError(f"{path}: {len(entries)} lines, but {root / INFO} counts {info['histories']} histories")
    return Index(root, info, tuple(entries))


def _check_entry(entry: Entry, seen: set[int]) -> None:
    if entry.history_id in seen:
        raise IndexFormatError(f"history_id {entry.history_id} stands twice")
    seen.add(entry.history_id)
    if entry.layout not in LAYOUTS:
        raise unknown("layout", entry.layout, LAYOUTS)
    expected = LAYOUTS[entry.layout].obs_shape
    if entry.obs_shape != expected:
        raise IndexFormatError(f"obs_shape {list(entry.obs_shape)}, expected {list(expected)} for {entry.layout}")
    shard = PurePosixPath(entry.shard)
    if shard.is_absolute() or ".." in shard.parts or shard.parts[:1] != ("data",) or shard.suffix != ".h5":
        raise IndexFormatError(f"shard {entry.shard!r}: expected a path like data/<track>/<layout>/<split>-....h5")
    if entry.episodes > entry.T:
        raise IndexFormatError(f"{entry.episodes} episodes in {entry.T} steps")


def read_info(root: Path) -> dict[str, Any]:
    """meta/info.json of a release whose format this package reads."""
    path = root / INFO
    if not path.is_file():
        raise RootNotFoundError(
            f"{root}: no release here, expected {INFO} in it; give a release folder, or make one with `make generate`"
        )
    try:
        info = json.loads(_text(path))
        version = info["format_version"]
        known = isinstance(version, int) and info["kind"] in KINDS and isinstance(info["histories"], int)
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise IndexFormatError(f"{path}: malformed: {error!r}") from error
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise FormatTooNewError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: `pip install -U icrl4aht-data`"
        )
    if isinstance(version, int) and version < FORMAT_VERSION:
        raise FormatTooOldError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: rebuild or fetch the release again"
        )
    if not known:
        raise IndexFormatError(f"{path}: malformed: kind {info['kind']!r}, format_version {version!r}")
    return info


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise IndexFormatError(f"{path}: missing; fetch the release again") from error
    except UnicodeDecodeError as error:
        raise IndexFormatError(f"{path}: not UTF-8 text: {error}") from error
