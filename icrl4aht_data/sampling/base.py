"""What the AD and the DPT sampler share: options, shares of processes, layouts, buffers, and the painting of states."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypedDict, TypeVar

import numpy as np

from icrl4aht_data.errors import (
    LabelsMissingError,
    OptionError,
)
from icrl4aht_data.format.schema import FIELDS, record_field
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.reading.sources import HistorySource
from icrl4aht_data.remote.partial_file import fetch_chunks
from icrl4aht_data.sampling.batches import Batches
from icrl4aht_data.sampling.draws import (
    Curriculum,
    Episodes,
    Weights,
    check_weights,
    episode_range,
    part_of,
)
from icrl4aht_data.utils.threads import in_slices
from icrl4aht_data.utils.validation import check_int

if TYPE_CHECKING:
    from icrl4aht_data.dataset import Dataset

B = TypeVar("B", bound=tuple)
"""A batch: a named tuple of arrays, some of which may be None."""

_SLAB = 8192  # steps gathered and painted at a time: the records in between stay few


class ChunkRequest(NamedTuple):
    """Rows that a batch needs."""

    source: HistorySource
    fields: Sequence[str]
    which: np.ndarray  # int (n,): histories, positions in the source
    low: np.ndarray  # int (n,): the first row of each
    high: np.ndarray  # int (n,): the one behind the last


class Group(NamedTuple):
    """The rows of a batch whose histories are of one layout."""

    layout: Layout
    source: HistorySource
    rows: slice | np.ndarray
    select: Callable[[np.ndarray], np.ndarray]  # of an array (B, ...): the group's

    def part(self, first: int, last: int) -> Group:
        """Its rows first..last."""
        if isinstance(self.rows, slice):
            start = self.rows.start or 0
            return self._replace(rows=slice(start + first, start + last))
        return self._replace(rows=self.rows[first:last])


class Sampler(Generic[B]):
    """What both samplers share. See `ADSampler` and `DPTSampler` for the options."""

    def __init__(
        self,
        dataset: Dataset,
        *,
        batch_size: int,
        length: int,
        seed: int = 0,
        teammate_actions: bool = False,
        weights: Weights = "uniform",
        episodes: Episodes | None = None,
        curriculum: Curriculum | None = None,
        process_index: int = 0,
        process_count: int = 1,
    ) -> None:
        self.batch_size, self.length = check_int("batch_size", batch_size, 1), check_int("length", length, 1)
        self.seed = check_int("seed", seed, 0)
        self.process_index, self.process_count = check_int("process_index", process_index, 0), process_count
        if process_index >= check_int("process_count", process_count, 1) or batch_size % process_count:
            raise OptionError(
                f"process_index = {process_index}, process_count = {process_count}, batch_size = {batch_size}: "
                f"expected an index below the count, and a batch that divides evenly among the processes"
            )
        self.dataset = dataset
        self.layouts = dataset.layouts
        if len({layout.obs_shape for layout in self.layouts}) > 1:
            raise OptionError(
                f"the selection spans layouts {', '.join(layout.name for layout in self.layouts)} with observations of "
                f"unequal shape, a sampler takes one shape: add layout={self.layouts[0].name!r}"
            )
        if teammate_actions and not dataset.column("has_teammate_actions").all():
            raise LabelsMissingError("teammate actions were asked for, but some histories have none")
        self.teammate_actions = teammate_actions
        self.weights, self.episodes, self.curriculum = check_weights(weights, len(dataset)), episodes, curriculum
        self._lengths = dataset.column("T")
        self._kept: int = dataset.info.environment.kept_steps
        ended, cut = np.divmod(self._lengths, self._kept)  # only histories of observations may end within an episode
        if (ended != dataset.column("episodes")).any() or (dataset.has_states and cut.any()):
            raise OptionError(f"some history's episodes have not {self._kept} steps; run `icrl4aht-data verify`")
        self._range = episode_range(episodes, dataset.column("episodes"))

    def __len__(self) -> int:
        return max(1, int(self._lengths.sum()) // (self.batch_size * self.length))

    def __getitem__(self, i: int) -> B:
        return self.batch(i)

    def __iter__(self) -> Iterator[B]:
        return (self[i] for i in range(len(self)))

    @property
    def local_size(self) -> int:
        """Rows of a batch that this process gets: B / process_count."""
        return self.batch_size // self.process_count

    def batch(self, i: int, out: B | None = None) -> B:
        """Batch i; written into `out`, a batch from `empty()`, if one is given.

        Raises:
            OptionError: if `out` is of another kind, shape or dtype.
        """
        raise NotImplementedError

    def empty(self) -> B:
        """A batch of unset arrays, to be filled again and again: new memory costs more than filling it."""
        raise NotImplementedError

    def batches(
        self, start: int = 0, stop: int | None = None, *, prefetch: int = 2, device: Any = None, reuse: bool = False
    ) -> Batches[B]:
        """Batches start, start + 1, .. made ahead by a thread; see `prefetch.Batches`."""
        return Batches(self, start, stop, prefetch=prefetch, device=device, reuse=reuse)

    def options(self) -> dict[str, Any]:
        """What the batches are a function of, as JSON: to be stored with a position and compared on resuming."""
        weights = self.weights if isinstance(self.weights, str) else self.weights.tolist()  # type: ignore[union-attr]
        curriculum = self.curriculum and [self.curriculum.batches, *self.curriculum.first, *self.curriculum.last]
        return {
            "sampler": type(self).__name__,
            "selection": hashlib.blake2b(self.dataset.ids.astype("<i8").tobytes(), digest_size=16).hexdigest(),
            "data_version": self.dataset.info.data_version,
            "obs": self.dataset.obs,
            "batch_size": self.batch_size,
            "length": self.length,
            "seed": self.seed,
            "teammate_actions": self.teammate_actions,
            "weights": weights,
            "episodes": self.episodes and list(self.episodes),
            "curriculum": curriculum,
        }

    def _steps(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """First step and the one behind the last of each history's range at batch i, int64 (H,) each."""
        first, stop = self._range
        if self.curriculum is not None:
            first, stop = part_of(self.curriculum.part(check_int("batch", i, 0)), first, stop)
        whole_history = stop == self.dataset.column("episodes")
        return first * self._kept, np.where(whole_history, self._lengths, stop * self._kept)

    def _local(self, drawn: np.ndarray) -> np.ndarray:
        """This process's share of draws (..., B)."""
        return drawn[..., self.process_index * self.local_size : (self.process_index + 1) * self.local_size]

    def _history_weights(self, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
        """float64 (H,), or None for equal ones."""
        if isinstance(self.weights, str):
            return None if self.weights == "uniform" else (high - low).astype(np.float64)
        return np.asarray(self.weights)

    def _groups(self, which: np.ndarray) -> Iterator[Group]:
        """The batch's rows by layout; `which` (B,) are positions in the selection."""
        holding = self.dataset.holding
        if len(self.layouts) == 1:
            yield Group(self.layouts[0], holding.sources[0], slice(None), lambda array: array)
            return
        number = holding.layout[which]
        for k in np.unique(number).tolist():
            rows = np.flatnonzero(number == k)
            yield Group(self.layouts[k], holding.sources[k], rows, lambda array, rows=rows: array[rows])

    def _bring(self, needed: Iterable[ChunkRequest]) -> None:
        """Fetch what a batch needs of a remote release, all at once."""
        fetch_chunks(part for n in needed for part in n.source.lacking(n.fields, n.which, n.low, n.high))

    @property
    def _paints(self) -> bool:
        """Whether observations are made of states."""
        return self.dataset.obs != "state" and self.dataset.has_states

    @property
    def _record(self) -> str:
        """The field that is held of each step to show what the ego saw."""
        return record_field(self.dataset.info.kind).name

    def _empty_records(self, group: Group, *shape: int) -> np.ndarray:
        return np.empty((*shape, *FIELDS[self._record].held(group.layout).shape), np.uint8)

    def _empty_obs(self, *shape: int) -> np.ndarray:
        if self.dataset.obs != "state":
            return np.empty((*shape, *self.layouts[0].obs_shape), self.dataset.obs)
        return np.empty((*shape, max(record_size(layout) for layout in self.layouts)), np.uint8)

    def _empty_layouts(self) -> np.ndarray | None:
        return np.empty(self.local_size, np.int32) if len(self.layouts) > 1 and self.dataset.obs == "state" else None

    @property
    def _slab(self) -> int:
        """How many rows have few enough steps to stay in the processor's cache."""
        return max(1, _SLAB // self.length)

    def _slabs(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Parts of the rows first..last of that size."""
        return ((start, min(start + self._slab, last)) for start in range(first, last, self._slab))

    def _on_threads(self, rows: int, work: Callable[[int, int], None]) -> None:
        """Call `work(start, stop)` for parts of the rows, one on each of the dataset's threads."""
        in_slices(work, rows, self.dataset.threads, least=self._slab)

    def _in_slabs(self, rows: int, work: Callable[[int, int], None]) -> None:
        """The same for parts that are slabs."""

        def some(first: int, last: int) -> None:
            for start, stop in self._slabs(first, last):
                work(start, stop)

        self._on_threads(rows, some)

    def _present(self, group: Group, records: np.ndarray, out: np.ndarray) -> None:
        """Show the records of a group's rows in `out` (B, ...), as the dataset presents them."""
        rows = group.rows
        if not self._paints:
            out[rows, ..., : records.shape[-1]] = records
            out[rows, ..., records.shape[-1] :] = 0
        elif isinstance(rows, slice):
            fast_observe(group.layout, records, out[rows])
        else:
            out[rows] = fast_observe(group.layout, records, np.empty((len(rows), *out.shape[1:]), out.dtype))

    def _checked(self, out: B | None) -> B:
        """`out`, if batches fit in it, or a new one."""
        expected = self._shapes
        if out is None:
            return self.empty()
        found = {name: _shape_of(array) for name, array in _fields(out).items()}
        if found != expected:
            wrong = {name: (expected.get(name), shape) for name, shape in found.items() if expected.get(name) != shape}
            raise OptionError(f"out: expected and found (dtype, shape): {wrong}; take a batch from sampler.empty()")
        return out

    @cached_property
    def _shapes(self) -> dict[str, Any]:
        return {name: _shape_of(array) for name, array in _fields(self.empty()).items()}


def _shape_of(array: np.ndarray | None) -> tuple[str, tuple[int, ...]] | None:
    if array is None:
        return None
    if not (isinstance(array, np.ndarray) and array.flags.c_contiguous and array.flags.writeable):
        raise OptionError("out: expected writeable, C-contiguous arrays; take a batch from sampler.empty()")
    return str(array.dtype), array.shape


def _fields(batch: Any) -> dict[str, np.ndarray | None]:
    return batch._asdict()


class SamplerOptions(TypedDict, total=False):
    """What both samplers take; see `sampling.ADSampler`."""

    seed: int
    teammate_actions: bool
    weights: Weights
    episodes: Episodes | None
    curriculum: Curriculum | None
    process_index: int
    process_count: int


def _describe(batch: Any) -> str:
    present = {name: array for name, array in batch._asdict().items() if array is not None}
    width = max(map(len, present))
    return "\n".join(f"{name:<{width}}  {a.dtype!s:<8} {a.shape}" for name, a in present.items())
