"""meta/info.json and meta/histories.jsonl of a release: read, checked, and queried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.facts import FAMILIES, SPLITS, TRACKS
from icrl4aht_data.errors import (
    EmptySelectionError,
    IndexFormatError,
    UnknownNameError,
    unknown,
)
from icrl4aht_data.format.columns import QUERY_FIELDS, Columns, read_columns
from icrl4aht_data.format.info import ReleaseInfo, read_info
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, Entry
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.paths import resolve_inside


@dataclass(frozen=True, eq=False)
class Index:
    """A release's index. A history's id is its place in `entries`, which makes an entry when it is asked for."""

    root: Path
    info: ReleaseInfo
    entries: Columns

    def entry(self, history_id: int) -> Entry:
        """The entry of one history.

        Raises:
            UnknownNameError: if there is none.
        """
        if not 0 <= history_id < len(self.entries):
            raise UnknownNameError(f"{self.root}: no history with id {history_id}; ids: 0..{len(self.entries) - 1}")
        return self.entries[history_id]

    def values(self, name: str) -> list[str]:
        """What a query field takes in this release, in order of first appearance."""
        return self.entries.values(name)

    def query(self, **wanted: str | Sequence[str] | None) -> np.ndarray:
        """Ids, ascending, of the histories whose fields have one of the wanted values; None means any.

        Looks at each combination of fields that exists once, then copies the ids found: never at each history.

        Raises:
            UnknownNameError: for a field or a value that the benchmark does not know; lists the valid ones.
            EmptySelectionError: for valid values that no history of this release has; says what exists.
        """
        asked = {name: value for name, value in wanted.items() if value is not None}
        combinations = self.entries.combinations
        matching = np.ones(len(combinations), bool)
        for name, value in asked.items():
            if name not in QUERY_FIELDS:
                raise unknown("filter", name, QUERY_FIELDS)
            names = [value] if isinstance(value, str) else value
            matching &= np.isin(combinations[:, QUERY_FIELDS.index(name)], self._codes(name, names))
        if not matching.any():
            what = ", ".join(f"{name}={value!r}" for name, value in asked.items()) or "any"
            raise EmptySelectionError(f"{self.root}: no history has {what}. This release has {self.summary()}")
        if matching.all():
            return np.arange(len(self.entries))
        ids = np.concatenate([self.entries.rows(c) for c in np.flatnonzero(matching).tolist()])
        return ids if (np.diff(ids) > 0).all() else np.sort(ids)

    def _codes(self, name: str, values: Sequence[str]) -> list[int]:
        """The codes of values, aliases of layouts included; -1 for a valid value that no history has."""
        fixed = {"split": SPLITS, "track": tuple(TRACKS), "teammate_family": FAMILIES}.get(name)
        codes = []
        for value in values:
            known = get_layout(value).name if name == "layout" else value
            code = self.entries.code(name, known) if isinstance(known, str) else None
            if code is None and name != "layout" and known not in (fixed or ()):
                raise unknown(name, value, fixed or self.values(name))
            codes.append(-1 if code is None else code)
        return codes

    def summary(self) -> str:
        """The combinations of split, layout and family that exist, in one line."""
        entries = self.entries
        counts: dict[tuple[str, str, str], int] = {}
        names = {name: self.values(name) for name in ("split", "layout", "teammate_family")}
        for codes, histories in zip(entries.combinations.tolist(), np.diff(entries.starts).tolist(), strict=True):
            split, layout, family = (names[name][codes[QUERY_FIELDS.index(name)]] for name in names)
            counts[split, layout, family] = counts.get((split, layout, family), 0) + histories
        parts = [f"{split}/{layout} with {family} ({n})" for (split, layout, family), n in counts.items()]
        return ", ".join(parts) or "no histories"


def read_index(root: Path) -> Index:
    """Read and check a release's index.

    A large one is parsed once; what was parsed is kept in the cache folder, by content (`utils.cache`).

    Raises:
        RootNotFoundError, FormatTooNewError, FormatTooOldError, IndexFormatError: each names the file, and the line.
    """
    info = read_info(root)
    path = resolve_inside(root, HISTORIES)
    entries = read_columns(path)
    if len(entries) != info.histories:
        raise IndexFormatError(f"{path}: {len(entries)} lines, but {root / INFO} counts {info.histories} histories")
    lacking = np.flatnonzero(~entries.column("has_teammate_actions"))
    if info.kind in KINDS and len(lacking):
        raise IndexFormatError(
            f"{path}, line {lacking[0] + 1}: expected has_teammate_actions true in a {info.kind} release"
        )
    return Index(root, info, entries)
