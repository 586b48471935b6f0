"""`load_icrl4aht`, and what it gives: a `Dataset`, a selection of learning histories."""

from __future__ import annotations

import operator
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.errors import EmptySelectionError, NotStoredError, OptionError, UnknownNameError, unknown
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import KINDS, PROVENANCE, TASKS, Entry
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.history import OBS, History, Obs
from icrl4aht_data.reading.selection import Names, ReadOptions, Storage
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.reading.sources import CACHE_MODES, CacheChoice, CacheMode, choose, decoded_size, open_source
from icrl4aht_data.remote.remote_release import ReleaseLocation, open_root
from icrl4aht_data.remote.store import Traffic
from icrl4aht_data.sampling.base import SamplerOptions
from icrl4aht_data.utils.threads import usable_cores
from icrl4aht_data.utils.validation import check_int

if TYPE_CHECKING:
    from typing import Unpack

    from icrl4aht_data.sampling.ad import ADSampler
    from icrl4aht_data.sampling.dpt import ContextOrder, DPTSampler

MINI = Path(__file__).parent / "mini"
"""The bundled mini release."""


def load_icrl4aht(
    root: str | Path | None = None,
    *,
    split: Names = None,
    layout: Names = None,
    track: Names = None,
    teammate_family: Names = None,
    teammate_kind: Names = None,
    task_id: Names = None,
    obs: Obs = "float32",
    cache: CacheMode = "auto",
    threads: int | None = None,
) -> Dataset:
    """Open a release and select histories.

    Args:
        root: a release folder, or an address: hf://datasets/<org>/<repo>[@<revision>], s3://..., https://..., any other
            that fsspec opens; the bundled mini release by default. Of a remote release the index comes here at once,
            all else when it is read.
        split: "train", "test" or "heldout".
        layout: a short name (coord_simple) or an environment name (grounded_coord_simple); or several.
        track: "teammate" or "layout".
        teammate_family: "rl" or "H1".."H4".
        teammate_kind: an algorithm or a heuristic, such as "utility_greedy".
        task_id: one task's histories, or several tasks'.
        obs: how observations are presented, see `history.OBS`.
        cache: how samplers hold the selection, see `store.CACHES`. `ram` and `mmap` decode it once, `stream` reads what
            a batch needs; "auto" chooses by size and room. The batches are the same.
        threads: for decoding and rendering; by default one a core.

    Raises:
        UnknownNameError: for a name that does not exist; lists the valid ones and the nearest.
        EmptySelectionError: if nothing matches; says what exists.
        OptionError: for obs="state" of a release of observations.
        ReleaseError: if the release cannot be read.
    """
    if obs not in OBS:
        raise unknown("obs", obs, OBS)
    if cache not in CACHE_MODES:
        raise unknown("cache", cache, CACHE_MODES)
    options = ReadOptions(obs, cache, usable_cores() if threads is None else check_int("threads", threads, 1))
    origin = open_root(MINI if root is None else root)
    index = read_index(origin.folder)
    if obs == "state" and index.info.kind not in KINDS:
        raise OptionError(f'obs = "state": {origin} has observations only, no state records; take float32 or uint8')
    everything = np.arange(len(index.entries))
    dataset = Dataset(index, everything, options, Shards(origin, index))
    return dataset.filter(
        split=split,
        layout=layout,
        track=track,
        teammate_family=teammate_family,
        teammate_kind=teammate_kind,
        task_id=task_id,
    )


class Dataset:
    """A selection of learning histories. Opening one reads the index alone; arrays are read when asked for.

    `len(dataset)` counts histories, `dataset[i]` is the i-th, `dataset[a:b]` a part, iteration yields them in order.
    """

    def __init__(self, index: Index, ids: np.ndarray, options: ReadOptions, shards: Shards) -> None:
        self.index = index
        self.ids = ids
        self.options = options
        self._shards = shards
        self._lock = threading.Lock()

    def __getstate__(self) -> tuple:
        return self.index, self.ids, self.options, self._shards

    def __setstate__(self, state: tuple) -> None:
        self.__init__(*state)

    def _with(self, ids: np.ndarray) -> Dataset:
        return Dataset(self.index, ids, self.options, self._shards)

    @property
    def obs(self) -> Obs:
        """How observations are presented."""
        return self.options.obs

    @property
    def threads(self) -> int:
        """How many threads decode and render."""
        return self.options.threads

    @property
    def root(self) -> Path:
        """The release's folder on this machine; of a remote release the one that its files come to."""
        return self.index.root

    @property
    def origin(self) -> ReleaseLocation:
        """Where the release is: its name, and the way to its files."""
        return self._shards.origin

    @property
    def traffic(self) -> Traffic:
        """What this release's remote was asked for so far; nothing of a local one."""
        remote = self.origin.remote
        return Traffic() if remote is None else remote.store.traffic

    @property
    def info(self) -> ReleaseInfo:
        """The release's versions, kind, environment and totals, as meta/info.json has them."""
        return self.index.info

    @property
    def has_states(self) -> bool:
        """Whether the release has state records: a release of observations has none."""
        return self.info.kind in KINDS

    @property
    def knows_tasks(self) -> bool:
        """Whether the release has its tasks: a release of observations may have been made without."""
        return self.has_states or bool(self._tasks)

    def __len__(self) -> int:
        return len(self.ids)

    @overload
    def __getitem__(self, position: int) -> History: ...

    @overload
    def __getitem__(self, position: slice) -> Dataset: ...

    def __getitem__(self, position: int | slice) -> History | Dataset:
        if isinstance(position, slice):
            return self.select(self.ids[position])
        return self.history(int(self.ids[position]))

    def __iter__(self) -> Iterator[History]:
        return (self.history(int(i)) for i in self.ids)

    def __repr__(self) -> str:
        layouts = [layout.name for layout in self.layouts]
        tasks = len(np.unique(self.column("task_id")))
        return (
            f"Dataset({len(self)} histories of {tasks} tasks on {', '.join(layouts)}; "
            f"{int(self.column('T').sum()):,} transitions, obs {self.obs}; "
            f"{self.info.kind} release {self.info.data_version} at {self.origin})"
        )

    def column(self, name: str) -> np.ndarray:
        """A field of every history of the selection: its values, or for names their codes in the index."""
        return self.index.entries.column(name)[self.ids]

    @cached_property
    def layouts(self) -> list[Layout]:
        """The layouts of the selection, in order of appearance."""
        codes, first = np.unique(self.column("layout"), return_index=True)
        names = self.index.values("layout")
        return [get_layout(names[code]) for code in codes[np.argsort(first)].tolist()]

    @cached_property
    def entries(self) -> list[Entry]:
        """The index entries of the selection."""
        return [self.index.entry(int(i)) for i in self.ids]

    @cached_property
    def cache(self) -> CacheChoice:
        """How samplers hold this selection, and why; see `store.CACHES`."""
        away = [name for name in self.shards if not self.origin.is_here(name)]
        if self.options.cache == "auto" and away:
            return CacheChoice("stream", f"{len(away)} of {len(self.shards)} shards are not downloaded")
        size = 0
        for layout, rows in self._by_layout():
            steps, episodes = (int(self.column(name)[rows].sum()) for name in ("T", "episodes"))
            size += decoded_size(layout, self.info.kind, steps, len(rows), episodes)
        return choose(self.options.cache, size)

    @cached_property
    def shards(self) -> list[str]:
        """The shards of the selection, paths in the release."""
        names = self.index.values("shard")
        return [names[code] for code in np.unique(self.column("shard")).tolist()]

    def _by_layout(self) -> Iterator[tuple[Layout, np.ndarray]]:
        codes, names = self.column("layout"), self.index.values("layout")
        for layout in self.layouts:
            yield layout, np.flatnonzero(codes == names.index(layout.name))

    @property
    def holding(self) -> Storage:
        """The selection's rows, as `cache` holds them; `ram` and `mmap` decode them on the first call."""
        with self._lock:
            return self._holding

    def forget_chunks(self) -> None:
        """Drop the decoded chunks that reading has kept, of all selections of this release."""
        self._shards.forget()

    @cached_property
    def _holding(self) -> Storage:
        sources, layout_of, place = [], np.zeros(len(self), np.intp), np.zeros(len(self), np.intp)
        if self.origin.remote is not None and self.cache.cache != "stream":
            self.origin.remote.fetch(self.shards)
        for number, (_, rows) in enumerate(self._by_layout()):
            ids, place[rows] = np.unique(self.ids[rows], return_inverse=True)
            layout_of[rows] = number
            entries = [self.index.entry(i) for i in ids.tolist()]
            sources.append(open_source(self.cache.cache, entries, self._shards.open, self.threads))
        return Storage(sources, layout_of, place)

    def filter(self, **wanted: Names) -> Dataset:
        """The histories of this selection whose fields have one of the wanted values; see `index.QUERY_FIELDS`."""
        matching = self.index.query(**wanted)
        ids = self.ids[np.isin(self.ids, matching)]
        if not len(ids):
            raise EmptySelectionError(f"{self.root}: no history of this selection has {wanted}; it is {self!r}")
        return self._with(ids)

    def select(self, ids: Sequence[int] | np.ndarray) -> Dataset:
        """The histories of this selection with these ids, in this order.

        Raises:
            UnknownNameError: for an id that this selection does not have.
        """
        if not len(ids):
            raise EmptySelectionError(f"{self.root}: select was given no history id")
        chosen = np.array([operator.index(i) for i in ids])
        absent = chosen[~np.isin(chosen, self.ids)]
        if len(absent):
            within = f"{self.ids.min()}..{self.ids.max()}"
            raise UnknownNameError(
                f"{self.root}: this selection has no history {absent.tolist()}, ids are within {within}; it is {self!r}"
            )
        return self._with(chosen)

    def history(self, history_id: int) -> History:
        """One history of the release, by id."""
        entry = self.index.entry(history_id)
        return History(entry, self._shards.open(entry.shard), self.obs)

    @cached_property
    def _tasks(self) -> dict[str, Task]:
        return {task.task_id: task for task in read_tasks(self.origin.file(TASKS))}

    @cached_property
    def _provenance(self) -> dict[str, Provenance]:
        return read_provenance(self.origin.file(PROVENANCE))

    def recover_environment(self, history_id: int) -> dict[str, Any]:
        """What rebuilds the environment a history was made in: layout names, map, recipes, episode lengths."""
        entry = self.index.entry(history_id)
        layout = get_layout(entry.layout)
        return {
            "layout": layout.name,
            "environment_name": layout.alias,
            "map": list(layout.rows),
            "recipes": [list(recipe) for recipe in layout.recipes],
            **asdict(self.info.environment),
        }

    def recover_teammate(self, history_id: int) -> dict[str, Any]:
        """What rebuilds the teammate of a history.

        Returns:
            The task's teammate entry (`kind`, `family`, `theta`, ...), and how it played: `slot` and `noise`.

        Raises:
            NotStoredError: if the release was made without its tasks.
        """
        entry = self.index.entry(history_id)
        if not self.knows_tasks:
            raise NotStoredError(
                f"{self.root / TASKS}: empty: this release was converted without its tasks and knows of this teammate "
                f"only family {entry.teammate_family} and kind {entry.teammate_kind}; convert again with --tasks FILE"
            )
        if entry.task_id not in self._tasks:
            raise unknown(f"task of history {history_id} in {self.root / TASKS}", entry.task_id, self._tasks)
        provenance = self._provenance.get(entry.task_id, Provenance())
        return self._tasks[entry.task_id].teammate | (provenance.teammate or {})

    def ad(self, *, batch_size: int, length: int, **options: Unpack[SamplerOptions]) -> ADSampler:
        """Algorithm Distillation windows; see `sampling.ADSampler` for the options."""
        from icrl4aht_data.sampling.ad import ADSampler

        return ADSampler(self, batch_size=batch_size, length=length, **options)

    def dpt(
        self, *, batch_size: int, context: int, order: ContextOrder = "contiguous", **options: Unpack[SamplerOptions]
    ) -> DPTSampler:
        """Decision-Pretrained Transformer queries with contexts; see `sampling.DPTSampler` for the options."""
        from icrl4aht_data.sampling.dpt import DPTSampler

        return DPTSampler(self, batch_size=batch_size, context=context, order=order, **options)
