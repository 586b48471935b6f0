"""Reading and querying the index of a release: meta/info.json and meta/histories.jsonl.

The lines of histories.jsonl are decoded and checked in blocks and stored as columns: 82,000 lines take under a second.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, islice
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import (
    ALL_TRACKS,
    KIND_FAMILIES,
    LABEL_VIEWS,
    SOURCES,
    SPLITS,
    check_family,
    check_layout_in_split,
)
from icrl4aht_data.errors import (
    EmptySelectionError,
    Icrl4ahtError,
    IndexFormatError,
    OptionError,
    UnknownNameError,
    check_choice,
)
from icrl4aht_data.format.info import ReleaseInfo, read_info
from icrl4aht_data.format.layouts_file import check_layouts_stored, is_generated, layout_family, read_layouts
from icrl4aht_data.format.schema import ENCODED, ENTRY_HINTS, HISTORIES, INFO, KINDS, TEXTS, Entry, as_json, check_name
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import Layout, add_layouts, get_layout
from icrl4aht_data.utils.files import read_lines, resolve_inside
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.text import counted_histories, listed_names

QUERY_FIELDS = ("layout", "split", "track", "teammate_family", "teammate_kind", "task_id", "source", "label_view")
"""Entry fields that histories can be filtered by."""

_KNOWN: dict[str, Iterable[str]] = {
    "split": SPLITS,
    "track": ALL_TRACKS,
    "source": SOURCES,
    "label_view": LABEL_VIEWS,
    "teammate_kind": KIND_FAMILIES,
}
"""Field -> values that exist in the benchmark, even if no history of a release has them."""

_BLOCK = 2**12  # number of entries in memory at a time

_DTYPES = {int: np.int64, bool: np.bool_, float: np.float64, int | None: np.int64, float | None: np.float64}
# The fields `history_id` and `obs_shape` have no columns, since the row and the layout determine their values.
_NUMBERS = {name: _DTYPES[hint] for name, hint in ENTRY_HINTS.items() if hint in _DTYPES and name != "history_id"}
_NONE_AS = {int | None: -1, float | None: np.nan}  # numbers stored in place of None; string columns store ""
_STRINGS = tuple(name for name, hint in ENTRY_HINTS.items() if hint in TEXTS or name in ENCODED)
_ABSENT = {name: _NONE_AS.get(hint, "") for name, hint in ENTRY_HINTS.items() if type(None) in get_args(hint)}
_names = attrgetter(*_STRINGS)


class Columns:
    """Index of a release as columns with one row per history; indexing and iteration create an `Entry` per row.

    A string column has int32 codes of its distinct values. None is stored as -1 in integer columns, as NaN in float
    columns and as "" in string columns. Fields in `schema.ENCODED` are string columns of JSON text.

    Args:
        arrays: all columns by name.
        values: distinct values of each string column, in the order of their codes.
    """

    def __init__(self, arrays: dict[str, np.ndarray], values: dict[str, list[str]]) -> None:
        self._arrays, self._values = arrays, values

    def __len__(self) -> int:
        return len(self._arrays["T"])

    def column(self, name: str) -> np.ndarray:
        """Return a column of shape (H,): the values of a number column, or the codes of a string column."""
        return self._arrays[name]

    def values(self, name: str) -> list[str]:
        """Return the distinct values of a string column, in the order of their codes."""
        return self._values[name]

    def matches(self, name: str, wanted: Collection[str]) -> np.ndarray:
        """Return a mask of shape (H,), True for histories with any of the wanted values in a string column."""
        return np.isin(self._arrays[name], [code for code, value in enumerate(self.values(name)) if value in wanted])

    def __iter__(self) -> Iterator[Entry]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, row: int) -> Entry:
        row = range(len(self))[row]
        values: dict[str, Any] = {name: self._arrays[name][row].item() for name in _NUMBERS}
        values |= {name: self._values[name][self._arrays[name][row]] for name in _STRINGS}
        for name, absent in _ABSENT.items():
            if values[name] == absent or values[name] != values[name]:  # only NaN differs from itself
                values[name] = None
            elif name in ENCODED:
                values[name] = msgspec.json.decode(values[name], type=ENTRY_HINTS[name])
        return Entry(history_id=row, obs_shape=get_layout(values["layout"]).obs_shape, **values)


def read_columns(path: Path) -> Columns:
    """Return the columns of an index file.

    Raises:
        IndexFormatError: if a line is malformed; the message has the file and the line number.
    """
    # A `defaultdict` gives each new value of a column the next code.
    codes = {name: defaultdict[str, int](count().__next__) for name in _STRINGS}
    parts: dict[str, list[np.ndarray]] = {name: [] for name in (*_NUMBERS, *_STRINGS)}
    entries = _entries(path)
    while block := list(islice(entries, _BLOCK)):
        columns = zip(*map(msgspec.structs.astuple, block), strict=True)
        values: dict[str, Sequence[Any]] = dict(zip(ENTRY_HINTS, columns, strict=True))
        for name in ENCODED:
            values[name] = [as_json(value) for value in values[name]]
        for name, absent in _ABSENT.items():
            values[name] = [absent if value is None else value for value in values[name]]
        for name, dtype in _NUMBERS.items():
            parts[name].append(np.array(values[name], dtype))
        for name, known in codes.items():
            parts[name].append(np.fromiter(map(known.__getitem__, values[name]), np.int32, len(block)))
    arrays = {
        name: np.concatenate([np.zeros(0, _NUMBERS.get(name, np.int32)), *blocks]) for name, blocks in parts.items()
    }
    return Columns(arrays, {name: list(known) for name, known in codes.items()})


def _entries(path: Path) -> Iterator[Entry]:
    """Yield the entries of an index file after checking each."""
    decoder, checked = msgspec.json.Decoder(Entry), set[tuple[Any, ...]]()
    for number, line in enumerate(read_lines(path)):
        try:
            entry = decoder.decode(line)
            _check_entry(entry, number, checked)
        except (msgspec.MsgspecError, Icrl4ahtError) as error:
            raise IndexFormatError(f"{path}, line {number + 1}: {error}") from error
        yield entry


def _check_entry(entry: Entry, number: int, checked: set[tuple[Any, ...]]) -> None:
    """Check that the fields of an entry are consistent and that its names are printable.

    Args:
        entry: an entry with valid types and bounds.
        number: number of the entry's line, counted from 0.
        checked: valid combinations of names and shapes found so far; the entry's combination is added. The histories
            of a task share one combination, which is checked once.

    Raises:
        IndexFormatError, UnknownNameError: if a value is wrong; the caller adds the file and the line to the message.
    """
    if entry.history_id != number:
        raise IndexFormatError(f"expected history_id {number}, since ids count up from 0, found {entry.history_id}")
    if entry.action_dim != len(ACTIONS):
        raise IndexFormatError(f"expected action_dim {len(ACTIONS)}, found {entry.action_dim}")
    key = *_names(entry), entry.obs_shape
    if key in checked:
        return
    checked.add(key)
    for value in _names(entry):
        for name in [value] if isinstance(value, str) else [name for _, name in value or ()]:
            check_name(name)
    check_layout_in_split(entry.track, entry.split, entry.layout)
    check_family(entry.teammate_family)
    expected = get_layout(entry.layout).obs_shape
    if entry.obs_shape != expected:
        raise IndexFormatError(f"expected obs_shape {list(expected)} for {entry.layout}, found {list(entry.obs_shape)}")
    folder = f"data/{entry.track}/{entry.layout}/{entry.split}"
    if not re.fullmatch(rf"{folder}-[0-9]{{5}}-of-[0-9]{{5}}\.h5", entry.shard):
        raise IndexFormatError(f"shard {entry.shard!r}: expected {folder}-NNNNN-of-NNNNN.h5")


ALIASES = {"algorithm": "teammate_kind"}
"""Alternative names of filters: the kind of a learned teammate is the algorithm that trained the teammate."""

LAYOUT_FAMILY = "layout_family"
"""Name of the filter by layout family: "published", or a family of layouts that the release stores."""


@dataclass(frozen=True, eq=False, repr=False)
class Index:
    """Index of a release.

    Args:
        root: the release folder.
        info: content of meta/info.json.
        entries: entries of the histories; a history's id is its position in this sequence.
        layouts: the layouts that the release stores because the benchmark does not have them, by name.
    """

    root: Path
    info: ReleaseInfo
    entries: Columns
    layouts: dict[str, Layout]

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A process that unpickles a dataset has not read the release, so `get_layout` does not know the layouts yet.
        self.__dict__.update(state)
        add_layouts(self.layouts.values())

    def __repr__(self) -> str:
        return f"Index({counted_histories(len(self.entries))} at {self.root})"

    def entry(self, history_id: int) -> Entry:
        """Return the index entry of one history.

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
        """Return the ids of the histories with the wanted field values, ascending, as int64 of shape (N,).

        Args:
            wanted: a value or a sequence of values for fields in `QUERY_FIELDS` or `ALIASES`; None accepts any value.

        Raises:
            UnknownNameError: if a field or value does not exist in the benchmark; the message lists the valid names.
            EmptySelectionError: if no history of this release has these values; the message lists existing values.
            OptionError: if a value is a mapping.
        """
        filters = {name: value for name, value in wanted.items() if value is not None}
        matching = np.ones(len(self.entries), bool)
        for given, value in filters.items():
            name = ALIASES.get(given, given)
            check_choice("filter", given, (*QUERY_FIELDS, LAYOUT_FAMILY, *ALIASES))
            if isinstance(value, Mapping):
                raise OptionError(f"{given} = {value!r}: expected a name or a sequence of names")
            names = [value] if isinstance(value, str) or not isinstance(value, Iterable) else value
            if name == LAYOUT_FAMILY:
                name, names = "layout", self._family_layouts(names)
            matching &= self.entries.matches(name, {self._known_value(name, one, given) for one in names})
        if not matching.any():
            what = ", ".join(f"{name}={value!r}" for name, value in filters.items()) or "any"
            names = ("split", "layout", "teammate_family", "source", *("label_view",) * ("label_view" in filters))
            known = {name: listed_names([one or "not recorded" for one in self.values(name)]) for name in names}
            found = "; ".join(f"{name} {values or 'none'}" for name, values in known.items())
            raise self._no_history(what, found)
        return np.flatnonzero(matching)

    def _no_history(self, what: str, found: str) -> EmptySelectionError:
        return EmptySelectionError(f"{self.root}: no history has {what}. This release has {found}")

    def _family_layouts(self, families: Iterable[str]) -> list[str]:
        """Return the layouts of the release that belong to any of the families."""
        by_family, families = grouped(self.values("layout"), layout_family), list(families)
        for family in families:
            if family not in by_family:
                raise self._no_history(
                    f"{LAYOUT_FAMILY}={family!r}", f"{LAYOUT_FAMILY} {listed_names(list(by_family))}"
                )
        return [layout for family in families for layout in by_family[family]]

    def _known_value(self, name: str, value: str, given: str) -> str:
        """Check that a value of a field exists in the benchmark, and return it; for a layout, return its short name.

        Args:
            name: name of the field, one of `QUERY_FIELDS`.
            value: the wanted value, which need not occur in the release.
            given: name of the field in messages.
        """
        if name == "layout":
            # A generated layout is known only once a release with it was opened, which must not change the result.
            if is_generated(str(value)) and value not in (found := self.values("layout")):
                raise self._no_history(f"layout={value!r}", f"layout {listed_names(found)}")
            return get_layout(str(value)).name
        if name == "teammate_family":
            check_family(value)
        else:
            check_choice(given, value, dict.fromkeys((*_KNOWN.get(name, ()), *filter(None, self.values(name)))))
        return value


def read_index(root: Path) -> Index:
    """Read and check the index of a release folder.

    Raises:
        RootNotFoundError: if the folder is not a release.
        FormatTooNewError, FormatTooOldError: if the release has another format version.
        IndexFormatError: if a file is malformed; the message has the file and the line number.
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
    steps, episodes, kept = entries.column("T"), entries.column("episodes"), info.environment.kept_steps
    # Only histories of releases without states may end within an episode.
    wrong = np.flatnonzero((steps // kept != episodes) | ((steps % kept > 0) & (info.kind in KINDS)))
    if len(wrong):
        found = f"found {episodes[wrong[0]]} episodes in {steps[wrong[0]]} steps"
        raise IndexFormatError(f"{path}, line {wrong[0] + 1}: expected episodes of {kept} steps as in {INFO}, {found}")
    check_layouts_stored(entries.values("layout"), layouts, path)
    check_layouts_stored((task.layout for task in info.left_out), layouts, root / INFO)
    return Index(root, info, entries, layouts)
