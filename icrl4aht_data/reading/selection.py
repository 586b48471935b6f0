"""Selections of a release's learning histories, and options for reading them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, overload

import numpy as np

from icrl4aht_data.errors import EmptySelectionError, NotStoredError, OptionError, UnknownNameError, check_choice
from icrl4aht_data.format.index import ALIASES
from icrl4aht_data.format.provenance import ProvenanceByTask, read_provenance
from icrl4aht_data.format.schema import ENCODED, ENTRY_HINTS, KINDS, PROVENANCE, TEXTS, Entry
from icrl4aht_data.overcooked.channels import Channels, observation_shape
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.history import LABELS, History, Labels, Obs
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.reading.sources import (
    CacheChoice,
    CacheMode,
    HistorySource,
    choose_cache,
    decoded_size,
    open_history_source,
)
from icrl4aht_data.utils.install_hints import import_optional
from icrl4aht_data.utils.options import check_int, check_number, check_options, check_position, take_slice
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_data.utils.text import counted_histories, counted_noun, listed_names

if TYPE_CHECKING:
    import pandas

COUNTED = ("split", "source", "layout", "teammate_family", "teammate_kind", "labels")
"""Fields whose values `Selection.describe` counts; see `Selection.counts`."""

FilterValues = str | Sequence[str] | None
"""Filter on an index field: one value, several values, or None for any."""


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading histories.

    Args:
        obs: form of observations; see `history.Obs`.
        cache: cache mode of samplers; see `sources.CacheMode`.
        threads: number of threads that decode and render; by default one for each usable core.
        channels: channels of observations; see `channels.CHANNELS`.

    Raises:
        UnknownNameError, OptionError: for an unknown name or an impossible number of threads.
    """

    obs: Obs = "float32"
    cache: CacheMode = "auto"
    threads: int = field(default_factory=usable_cores)
    channels: Channels = "own"

    def __post_init__(self) -> None:
        check_options(self)
        check_int("threads", self.threads, 1)


class Selection:
    """An ordered selection of a release's histories. Opening reads only the index; arrays are read on access.

    `len(selection)` is the number of histories, `selection[i]` is the i-th history, `selection[a:b]` a smaller
    selection. Selections of one release share its index and opened shards.

    Args:
        shards: the release's shards, with its location and index.
        options: reading options.
        ids: int (H,), the histories' ids; all of the release by default.

    Attributes:
        ids: int (H,), ids of the histories in the release, in the order of the selection.
        index: the release's index.
        info: the release's versions, kind, environment and totals, as in meta/info.json.
        origin: location of the release, a `fetch.Remote` for a remote release.
        root: the release's folder on this machine; for a remote release the folder of downloaded files.
        options: form and channels of observations, cache mode, threads.
        obs: form of observations: "float32", "uint8" or "state"; see `history.Obs`.
        channels: channels of observations, "own" (of each layout) or "canonical"; see `channels.CHANNELS`.
        threads: number of threads that decode and render.

    Raises:
        OptionError: if obs="state" and the release has no state records.
    """

    def __init__(self, shards: Shards, options: ReadOptions, ids: np.ndarray | None = None) -> None:
        self._shards, self.origin, self.root = shards, shards.location, shards.location.folder
        self.index, self.info = shards.index, shards.index.info
        self.options, self.threads = options, options.threads
        self.obs: Obs = options.obs
        self.channels: Channels = options.channels
        self.ids = np.arange(len(self.index.entries)) if ids is None else ids
        self._source: HistorySource | None = None
        if self.obs == "state" and not self.has_states:
            raise OptionError(
                f'obs = "state": {self.origin} has observations only, no state records; use float32 or uint8'
            )

    # Data loaders send a pickled selection to each worker. The pickle has no decoded arrays; workers open their own.
    def __getstate__(self) -> tuple:
        return self._shards, self.options, self.ids

    def __setstate__(self, state: tuple) -> None:
        self.__init__(*state)

    @property
    def obs_shape(self) -> tuple[int, int, int]:
        """Shape of one observation, (5, 5, C); with obs="state", the shape after rendering a state record.

        Raises:
            OptionError: if the selection's layouts have different numbers of channels, unless channels are canonical.
        """
        # Several layouts may have the same shape; the message lists each shape once.
        shapes = {observation_shape(layout, self.channels == "canonical"): layout for layout in self.layouts}
        if len(shapes) > 1:
            raise OptionError(
                f"the selection has layouts {listed_names([layout.name for layout in self.layouts])}, and their "
                f"observations have different shapes ({', '.join(map(str, shapes))}): choose "
                f'channels="canonical", which all layouts share, or one layout: layout={self.layouts[0].name!r}'
            )
        return next(iter(shapes))

    @cached_property
    def provenance(self) -> ProvenanceByTask:
        """Records of how each task's histories were made, by task id, as in meta/provenance.json."""
        return read_provenance(self.origin.file(PROVENANCE))

    @property
    def has_states(self) -> bool:
        """Whether the release has state records; releases of kind `observations` have none."""
        return self.info.kind in KINDS

    def __len__(self) -> int:
        return len(self.ids)

    @overload
    def __getitem__(self, position: int) -> History: ...

    @overload
    def __getitem__(self, position: slice) -> Self: ...

    def __getitem__(self, position: int | slice) -> History | Self:
        if isinstance(position, slice):
            return self.select(take_slice(self.ids, position, "histories"))
        return self.history(int(self.ids[check_position("the selection's histories", position, len(self))]))

    def __iter__(self) -> Iterator[History]:
        return (self.history(int(i)) for i in self.ids)

    def __repr__(self) -> str:
        layouts = [layout.name for layout in self.layouts]
        tasks = len(np.unique(self.column_codes("task_id")))
        canonical = " with canonical channels" if self.channels == "canonical" else ""
        return (
            f"{type(self).__name__}({counted_histories(len(self))} of {counted_noun(tasks, 'task')} on "
            f"{listed_names(layouts)}; {self.named_counts('split')}; {self.named_counts('source')}; "
            f"{counted_noun(int(self.column('T').sum()), 'transition')}, obs {self.obs}{canonical}; "
            f"{self.info.kind} release {self.info.data_version} at {self.origin})"
        )

    def named_counts(self, name: str) -> str:
        """Return an index field's name and values, such as "source ppo" or "sources ppo (120), noise (64)"."""
        counts = self.counts(name)
        return f"{name} {next(iter(counts))}" if len(counts) == 1 else f"{name}s {self.counts_text(name)}"

    def counts_text(self, name: str) -> str:
        """Return the result of `counts` as text, such as "ppo (120), noise (64)"; "none" without values."""
        return ", ".join(f"{value} ({number})" for value, number in self.counts(name).items()) or "none"

    def counts(self, name: str) -> dict[str, int]:
        """Return the number of histories for each value of a text field of the index, such as "split" or "source".

        Args:
            name: the field; or "labels", which counts histories with expert and with oracle actions.

        Returns:
            Number of histories by value, for values with histories, in order of first appearance in the release.
            Histories without a value are not counted.

        Raises:
            UnknownNameError: if the index has no such text field.
        """
        if name == "labels":
            found = {kind: int(self.has_labels(kind).sum()) for kind in LABELS}
            return {kind: number for kind, number in found.items() if number}
        field = ALIASES.get(name, name)
        check_choice("field of names", field, ("labels", *(one for one, of in ENTRY_HINTS.items() if of in TEXTS)))
        # Codes are positions in the values of the release, so some values may be absent from this selection.
        numbers = np.bincount(self.column_codes(field), minlength=1).tolist()
        found = zip(self.index.values(field), numbers, strict=False)
        return {value: number for value, number in found if value and number}

    def has_labels(self, labels: Labels) -> np.ndarray:
        """Return bool (H,), True for histories that have labels of the given kind; see `history.LABELS`.

        In noise histories, oracle labels are equal to expert actions, and exist even if `has_oracle_actions` is False,
        since equal actions need not be stored twice; see `Entry.stored_field`.
        """
        # In noise histories oracle and expert labels are equal, so a release may store only the expert labels.
        has = self.column(f"has_{labels}_actions")
        return has if labels == "expert" else has | ((self.column("source") == "noise") & self.has_labels("expert"))

    def describe(self) -> str:
        """Describe the selection as text, with the numbers of histories by split, source, layout, teammate, labels."""
        return "\n".join([repr(self), *(f"{name}: {self.counts_text(name)}" for name in COUNTED)])

    def history(self, history_id: int) -> History:
        """Return the history of the release with the given id, even if this history is not selected.

        Raises:
            UnknownNameError: if the release has no history with that id.
        """
        entry = self.index.entry(history_id)
        return History(entry, self._shards.open, self.obs, self.channels)

    def column(self, name: str) -> np.ndarray:
        """Return one index field of the selected histories: a field of `Entry`, such as "layout" or "return_end".

        Args:
            name: the field.

        Returns:
            Array (H,) of strings, int64, float64 or bool, with "", -1 or NaN for None; (H, 3) for `obs_shape`, the
            shape with channels="own". `teammate_of_episode` is JSON text.

        Raises:
            UnknownNameError: if there is no such field; the message suggests the nearest name.
        """
        check_choice("column", name, (*ENTRY_HINTS, *ALIASES))
        name = ALIASES.get(name, name)
        # The index has no columns of ids and shapes, which follow from the position and the layout.
        if name == "history_id":
            return self.ids.astype(np.int64)
        if name == "obs_shape":
            return np.array([layout.obs_shape for layout in self.layouts])[self.layout_numbers]
        if ENTRY_HINTS[name] in TEXTS or name in ENCODED:
            # A release without histories has no values, and NumPy would turn an empty list into an array of floats.
            return np.array(self.index.values(name) or [""])[self.column_codes(name)]
        return self.index.entries.column(name)[self.ids]

    def column_codes(self, name: str) -> np.ndarray:
        """Return a text field of the index as codes, int32 (H,): code n stands for `index.values(name)[n]`."""
        return self.index.entries.column(name)[self.ids]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the index entries as a data frame with one row per history and the columns of `Entry`.

        Integer columns with unknown values are `Int64`; unknown floats are NaN.

        Raises:
            OptionError: if pandas is not installed.
        """
        pandas = import_optional("pandas", "a data frame")
        frame = pandas.DataFrame([entry.to_row() | {"obs_shape": entry.obs_shape} for entry in self.entries])
        return frame.astype({name: "Int64" for name, hint in ENTRY_HINTS.items() if hint == int | None})

    @cached_property
    def layouts(self) -> list[Layout]:
        """The layouts of the selection, in order of appearance."""
        # np.unique sorts by layout code, that is by first appearance in the release, not in the selection.
        codes, first = np.unique(self.column_codes("layout"), return_index=True)
        names = self.index.values("layout")
        return [get_layout(names[code]) for code in codes[np.argsort(first)].tolist()]

    @cached_property
    def layout_numbers(self) -> np.ndarray:
        """Index of each history's layout in `layouts`, int32 (H,)."""
        numbers = {layout.name: number for number, layout in enumerate(self.layouts)}
        # The table maps layout codes of the release to layout numbers of the selection.
        table = np.array([numbers.get(name, 0) for name in self.index.values("layout")], np.int32)
        return table[self.column_codes("layout")]

    @cached_property
    def entries(self) -> list[Entry]:
        """The index entries of the selection."""
        return [self.index.entry(int(i)) for i in self.ids]

    @cached_property
    def shards(self) -> list[str]:
        """Paths of the selection's shards in the release."""
        names = self.index.values("shard")
        return [names[code] for code in np.unique(self.column_codes("shard")).tolist()]

    @cached_property
    def cache(self) -> CacheChoice:
        """The cache mode that samplers use for this selection, and the reason; see `sources.CacheMode`."""
        # Sizes come from columns, since making 82,000 entries would take longer than opening the release.
        size = 0
        for number, layout in enumerate(self.layouts):
            members = self.layout_numbers == number
            steps, episodes = (int(self.column(name)[members].sum()) for name in ("T", "episodes"))
            size += decoded_size(layout, self.info.kind, steps, int(members.sum()), episodes)
        return choose_cache(self.options.cache, size)

    @property
    def storage(self) -> HistorySource:
        """Reader of the selection's rows in cache mode `cache`; `ram` and `mmap` decode all rows on first access."""
        if self._source is None:  # no lock, which a fork could leave locked; parallel accesses may decode twice
            self._source = open_history_source(self.cache.cache, self.entries, self._shards, self.threads)
        return self._source

    def clear_chunk_cache(self) -> None:
        """Clear the cache of decoded chunks, which all selections of this release share."""
        self._shards.cache.clear()

    def with_options(
        self,
        *,
        obs: Obs | None = None,
        cache: CacheMode | None = None,
        threads: int | None = None,
        channels: Channels | None = None,
    ) -> Self:
        """Return this selection with other reading options, without opening the release again; None keeps an option.

        Raises:
            UnknownNameError, OptionError: for impossible options, such as obs="state" for a release of observations.
        """
        changed: dict[str, Any] = {"obs": obs, "cache": cache, "threads": threads, "channels": channels}
        # `replace` makes new options, which `__post_init__` checks.
        options = replace(self.options, **{name: value for name, value in changed.items() if value is not None})
        return type(self)(self._shards, options, self.ids)

    def filter(
        self,
        predicate: Callable[[Entry], bool] | None = None,
        /,
        *,
        min_expert_return: float | None = None,
        learner: int | Sequence[int] | None = None,
        **wanted: FilterValues,
    ) -> Self:
        """Return the histories of this selection whose index fields have one of the wanted values.

        Args:
            predicate: function of an index entry that returns True for histories to keep, such as `lambda entry:
                entry.return_end > 30`. To filter by the content of arrays, pass one bool per history to `select`:
                `ds.select([history.returns().max() > 40 for history in ds])`.
            min_expert_return: minimum of `Entry.expert_return`, the return of the policy that gives the labels, acting
                greedily.
            learner: number or numbers of the learners to keep (`Entry.learner`), counted from 0 within each task.
            wanted: values of split, layout, track, teammate_family, teammate_kind (alias algorithm), source, label_view
                or task_id: one value, several values, or None for any, as in `load_icrl4aht`.

        Raises:
            UnknownNameError: for a field or value that does not exist.
            EmptySelectionError: if no history is left.
            OptionError: if `predicate` is not a function that returns a bool, or `min_expert_return` is not a number.
            NotStoredError: for `min_expert_return`, if the expert return of a remaining history is unknown.
        """
        # The query searches the whole release; `isin` keeps the order and the repeated histories of this selection.
        named = ", ".join(f"{name} = {value!r}" for name, value in wanted.items() if value is not None)
        found = self._select_if(np.isin(self.ids, self.index.query(**wanted)), f"has {named}")
        if learner is not None:
            learners = found.column("learner")
            known = ", ".join(map(str, np.unique(learners).tolist()))
            found = found._select_if(np.isin(learners, learner), f"has learner = {learner!r}, only {known}")
        if min_expert_return is not None:
            least, returns = check_number("min_expert_return", min_expert_return), found.column("expert_return")
            if np.isnan(returns).any():
                raise NotStoredError(
                    f"min_expert_return: {self.origin}: the expert return of {np.isnan(returns).sum()} of {len(found)} "
                    f"histories is unknown; leave these histories out by "
                    f'ds.select(~np.isnan(ds.column("expert_return")))'
                )
            found = found._select_if(
                returns >= least, f"has expert_return >= {least:g}, the highest is {returns.max():g}"
            )
        if predicate is not None:
            if not callable(predicate):
                raise OptionError(
                    f"filter: expected a function of an index entry, such as lambda entry: entry.return_end > 30, "
                    f"found {predicate!r}; give a value with its field: filter(layout={str(predicate)!r})"
                )
            kept = [predicate(entry) for entry in found.entries]
            if others := {type(one).__name__ for one in kept if not isinstance(one, bool | np.bool_)}:
                raise OptionError(f"filter: expected the function to return True or False, found {', '.join(others)}")
            found = found._select_if(np.array(kept), "passes the function")
        return found

    def _select_if(self, kept: np.ndarray, condition: str) -> Self:
        """Return the histories of this selection for which `kept`, bool (H,), is True.

        Raises:
            EmptySelectionError: if no history is left; the message has the condition.
        """
        if not kept.any():
            raise EmptySelectionError(f"{self.root}: no history of this selection {condition}: {self!r}")
        return self.select(kept)

    def select(self, ids: Sequence[int] | np.ndarray) -> Self:
        """Return the histories of this selection with the given ids, in the given order.

        Args:
            ids: history ids; or bool (H,), such as `ds.column("layout") == "demo_wide"`, True for histories to keep.

        Raises:
            EmptySelectionError: if no id is given.
            UnknownNameError: for an id that this selection does not have.
            OptionError: for anything but integers, and for a bool array of another length.
        """
        try:
            given = np.asarray(ids)  # a list of bools is accepted, too
        except (TypeError, ValueError) as error:  # raised for nested lists of unequal length
            raise OptionError(f"select: expected a list of history ids, found {ids!r:.200}") from error
        if given.dtype == bool and given.shape == self.ids.shape:  # a mask is replaced by the ids that it keeps
            given = self.ids[given]
        if not given.size:
            raise EmptySelectionError(f"{self.root}: select: expected at least one history id, found none")
        if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer):
            raise OptionError(
                f"select: expected a list of history ids, or a bool for each of {counted_histories(len(self))}, found "
                f"{given.dtype} of shape {given.shape}"
            )
        chosen = given.astype(np.int64)
        absent = chosen[~np.isin(chosen, self.ids)]
        if len(absent):
            within = f"{self.ids.min()}..{self.ids.max()}"
            raise UnknownNameError(
                f"{self.root}: this selection has no history {absent.tolist()}, its ids are within {within}: {self!r}"
            )
        return type(self)(self._shards, self.options, chosen)
