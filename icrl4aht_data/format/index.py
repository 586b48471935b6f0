"""Reading and querying the index of a release: meta/info.json and meta/histories.jsonl."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.facts import ALL_TRACKS, LABEL_VIEWS, SOURCES, SPLITS, all_families
from icrl4aht_data.errors import (
    EmptySelectionError,
    IndexFormatError,
    OptionError,
    UnknownNameError,
    check_choice,
    unknown,
)
from icrl4aht_data.format.columns import QUERY_FIELDS, Columns, read_columns
from icrl4aht_data.format.info import ReleaseInfo, read_info
from icrl4aht_data.format.layouts_file import PUBLISHED, ReleaseLayouts, check_layouts_known, read_layouts
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, Entry
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import resolve_inside
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.text import counted_histories, listed_names

ALIASES = {"algorithm": "teammate_kind"}
"""Other names of filters: the kind of a learned teammate is its training algorithm."""

LAYOUT_FAMILY = "layout_family"
"""Filter by the family of the layout: "published", or one of those that the release carries."""

_KNOWN_VALUES: dict[str, Callable[[], Sequence[str]]] = {
    "split": lambda: SPLITS,
    "track": lambda: ALL_TRACKS,
    "teammate_family": all_families,
    "source": lambda: SOURCES,
    "label_view": lambda: LABEL_VIEWS,
}


@dataclass(frozen=True, eq=False, repr=False)
class Index:
    """Index of a release.

    Args:
        root: the release folder.
        info: content of meta/info.json.
        entries: the histories; a history's id is its position in this sequence.
        layouts: the layouts that the release carries.
    """

    root: Path
    info: ReleaseInfo
    entries: Columns
    layouts: ReleaseLayouts = field(default_factory=lambda: ReleaseLayouts({}))

    def __repr__(self) -> str:
        return f"Index({counted_histories(len(self.entries))} at {self.root})"

    def entry(self, history_id: int) -> Entry:
        """Return the entry of one history.

        Raises:
            UnknownNameError: if no history has this id.
            OptionError: if the id is not an integer.
        """
        number = check_int("history_id", history_id, -(2**63))
        if not 0 <= number < len(self.entries):
            raise UnknownNameError(f"{self.root}: no history with id {number}; ids: 0..{len(self.entries) - 1}")
        return self.entries[number]

    def values(self, name: str) -> list[str]:
        """Return the values of a string field in this release, in order of first appearance; "" stands for None."""
        return self.entries.values(name)

    def query(self, **wanted: str | Sequence[str] | None) -> np.ndarray:
        """Return the ids of the histories with the wanted field values, int64 (N,), ascending.

        Args:
            wanted: field of `QUERY_FIELDS` or `ALIASES` -> one value or several; None accepts any.

        Raises:
            UnknownNameError: if a field or value does not exist in the benchmark; lists the valid ones.
            EmptySelectionError: if no history of this release has these values; lists what exists.
            OptionError: if a value is a mapping.
        """
        filters = {name: value for name, value in wanted.items() if value is not None}
        matching = np.ones(len(self.entries), bool)
        for given, value in filters.items():
            name = ALIASES.get(given, given)
            if name not in (*QUERY_FIELDS, LAYOUT_FAMILY):
                raise unknown("filter", given, (*QUERY_FIELDS, LAYOUT_FAMILY, *ALIASES))
            if isinstance(value, Mapping):
                raise OptionError(f"{given} = {value!r}: expected a name or a sequence of names")
            names = [value] if isinstance(value, str) or not isinstance(value, Iterable) else value
            if name == LAYOUT_FAMILY:
                name, names = "layout", self._of_families(names)
            matching &= self.entries.matches(name, {self._known_value(name, one, given) for one in names})
        if not matching.any():
            what = ", ".join(f"{name}={value!r}" for name, value in filters.items()) or "any"
            names = ("split", "layout", "teammate_family", "source", *("label_view",) * ("label_view" in filters))
            known = {name: listed_names([one or "not recorded" for one in self.values(name)]) for name in names}
            found = "; ".join(f"{name} {values or 'none'}" for name, values in known.items())
            raise EmptySelectionError(f"{self.root}: no history has {what}. This release has {found}")
        return np.flatnonzero(matching)

    def _of_families(self, families: Iterable[str]) -> list[str]:
        """Return the layouts of the release that belong to families."""
        by_family: dict[str, list[str]] = {PUBLISHED: []}
        for layout in self.values("layout"):
            by_family.setdefault(self.layouts.family(layout), []).append(layout)
        for family in families:
            check_choice(LAYOUT_FAMILY, family, by_family)
        return [layout for family in families for layout in by_family[family]]

    def _known_value(self, name: str, value: str, given: str) -> str:
        """Return a valid value of a field, for a layout its name; the release may not have the value.

        Args:
            name: the field, one of `QUERY_FIELDS`.
            value: the wanted value.
            given: name of the field in messages.
        """
        if name == "layout":
            return get_layout(str(value)).name
        if value in (own := [one for one in self.values(name) if one]):
            return value  # without reading which other packages are installed
        known = (*_KNOWN_VALUES.get(name, tuple)(), *own)
        check_choice(given, value, known)
        return value


def read_index(root: Path) -> Index:
    """Read and check the index of a release folder.

    The parsed columns of a large index are kept in the cache folder, see `format.cached_arrays`.

    Raises:
        RootNotFoundError: if the folder is not a release.
        FormatTooNewError, FormatTooOldError: if the release has another format version.
        IndexFormatError: if a file is malformed; with the file and the line number.
    """
    info, layouts = read_info(root), read_layouts(root)
    path = resolve_inside(root, HISTORIES)
    entries = read_columns(path)
    if len(entries) != info.histories:
        raise IndexFormatError(f"{path}: {len(entries)} lines, but {root / INFO} counts {info.histories} histories")
    without = np.flatnonzero(~entries.column("has_teammate_actions"))
    if info.kind in KINDS and len(without):
        raise IndexFormatError(
            f"{path}, line {without[0] + 1}: expected has_teammate_actions true in a {info.kind} release"
        )
    check_layouts_known(entries.values("layout"), path)
    return Index(root, info, entries, layouts)
