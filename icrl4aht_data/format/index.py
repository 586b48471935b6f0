"""A release's index: meta/info.json and meta/histories.jsonl, read, checked, and queried."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.facts import SOURCES, SPLITS, TRACKS, all_families
from icrl4aht_data.errors import EmptySelectionError, IndexFormatError, OptionError, UnknownNameError, unknown
from icrl4aht_data.format.columns import QUERY_FIELDS, Columns, read_columns
from icrl4aht_data.format.info import ReleaseInfo, read_info
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, Entry
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import resolve_inside
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.text import counted_histories

ALIASES = {"algorithm": "teammate_kind"}
"""Other names of filters: the kind of a learned teammate is the algorithm that trained it."""

_KNOWN_VALUES: dict[str, Callable[[], Sequence[str]]] = {
    "split": lambda: SPLITS,
    "track": lambda: tuple(TRACKS),
    "teammate_family": all_families,
    "source": lambda: SOURCES,
}


@dataclass(frozen=True, eq=False, repr=False)
class Index:
    """A release's index.

    Args:
        root: the release folder.
        info: content of meta/info.json.
        entries: the histories; a history's id is its position in this sequence.
    """

    root: Path
    info: ReleaseInfo
    entries: Columns

    def __repr__(self) -> str:
        return f"Index({counted_histories(len(self.entries))} at {self.root})"

    def entry(self, history_id: int) -> Entry:
        """Return the entry of one history.

        Raises:
            UnknownNameError: if there is none.
            OptionError: if the id is not an integer.
        """
        number = check_int("history_id", history_id, -(2**63))
        if not 0 <= number < len(self.entries):
            raise UnknownNameError(f"{self.root}: no history with id {number}; ids: 0..{len(self.entries) - 1}")
        return self.entries[number]

    def values(self, name: str) -> list[str]:
        """Return the values of a string field in this release, in order of first appearance."""
        return self.entries.values(name)

    def query(self, **wanted: str | Sequence[str] | None) -> np.ndarray:
        """Return the ids int64 (N,), ascending, of the histories with the wanted values of fields; None means any.

        The time grows with the number of combinations of fields and of ids found, not with the number of histories.

        Args:
            wanted: field of `QUERY_FIELDS` or `ALIASES` -> a value or several.

        Raises:
            UnknownNameError: for a field or a value that the benchmark does not know; lists the valid ones.
            EmptySelectionError: for valid values that no history of this release has; says what exists.
            OptionError: for a mapping.
        """
        filters = {name: value for name, value in wanted.items() if value is not None}
        combinations = self.entries.combinations
        matching = np.ones(len(combinations), bool)
        for given, value in filters.items():
            name = ALIASES.get(given, given)
            if name not in QUERY_FIELDS:
                raise unknown("filter", given, (*QUERY_FIELDS, *ALIASES))
            if isinstance(value, Mapping):
                raise OptionError(f"{given} = {value!r}: expected a name or a sequence of names")
            names = [value] if isinstance(value, str) or not isinstance(value, Iterable) else value
            codes = [self._code(name, one, given) for one in names]
            matching &= np.isin(combinations[:, QUERY_FIELDS.index(name)], codes)
        if not matching.any():
            what = ", ".join(f"{name}={value!r}" for name, value in filters.items()) or "any"
            sources = ", ".join(self.values("source")) or "none"
            raise EmptySelectionError(
                f"{self.root}: no history has {what}. This release has {self.summary()}; sources: {sources}"
            )
        if matching.all():
            return np.arange(len(self.entries))
        ids = np.concatenate([self.entries.rows(c) for c in np.flatnonzero(matching).tolist()])
        return ids if (np.diff(ids) > 0).all() else np.sort(ids)

    def _code(self, name: str, value: str, given: str) -> int:
        """Return the code of a value, also of a layout's alias; -1 for a valid value that no history has.

        Args:
            name, value: of `QUERY_FIELDS`, and the wanted value.
            given: the field's name in messages.
        """
        canonical = get_layout(str(value)).name if name == "layout" else value
        code = self.entries.code(name, canonical) if isinstance(canonical, str) else None
        if code is not None:
            return code
        known = _KNOWN_VALUES[name]() if name in _KNOWN_VALUES else ()
        if name != "layout" and canonical not in known:
            raise unknown(given, value, (*known, *self.values(name)))
        return -1

    def summary(self) -> str:
        """Return the splits with their layouts and families of teammates, in one line."""
        found: dict[str, dict[str, list[str]]] = {}
        names = {name: self.values(name) for name in ("split", "layout", "teammate_family")}
        for codes in self.entries.combinations.tolist():
            split, layout, family = (names[name][codes[QUERY_FIELDS.index(name)]] for name in names)
            parts = found.setdefault(split, {"layout": [], "family": []})
            parts["layout"].append(layout)
            parts["family"].append(family)
        texts = [
            f"{split} on {', '.join(dict.fromkeys(parts['layout']))} with {', '.join(dict.fromkeys(parts['family']))}"
            for split, parts in found.items()
        ]
        return "; ".join(texts) or "no histories"


def read_index(root: Path) -> Index:
    """Read and check the index of a release folder.

    A large one is parsed once; the parsed columns are kept in the cache folder, by content (`utils.cache`).

    Raises:
        RootNotFoundError, FormatTooNewError, FormatTooOldError, IndexFormatError: each names the file, and the line.
    """
    info = read_info(root)
    path = resolve_inside(root, HISTORIES)
    entries = read_columns(path)
    if len(entries) != info.histories:
        raise IndexFormatError(f"{path}: {len(entries)} lines, but {root / INFO} counts {info.histories} histories")
    without = np.flatnonzero(~entries.column("has_teammate_actions"))
    if info.kind in KINDS and len(without):
        raise IndexFormatError(
            f"{path}, line {without[0] + 1}: expected has_teammate_actions true in a {info.kind} release"
        )
    return Index(root, info, entries)
