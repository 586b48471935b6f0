"""AD and DPT samplers (paper, App. D.4): sequences of batches, each a pure function of (selection, options, seed, i).

`sampler[i]` is the same in any process, on any number of workers and threads, however the data are held, from a lite or
a full release; to resume, go on from the next i. `len(sampler)` batches hold as many steps as the selection; `i` may go
on beyond. `B` denotes the batch size, `L` the window's length, `K` the context's, `(5, 5, C)` an observation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np

from icrl4aht_data.benchmark import unknown
from icrl4aht_data.draws import (
    Curriculum,
    Episodes,
    Weights,
    below,
    check_weights,
    episode_range,
    part_of,
    pick,
    whole,
    words,
)
from icrl4aht_data.errors import LabelsMissingError, OptionError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.paint import paint
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.prefetch import Batches
from icrl4aht_data.store import Source
from icrl4aht_data.threads import in_slices

if TYPE_CHECKING:
    from icrl4aht_data.dataset import Dataset

ContextOrder = Literal["contiguous", "random"]
CONTEXT_ORDERS: tuple[ContextOrder, ...] = ("contiguous", "random")

_SLAB = 8192  # steps gathered and painted at a time: states in between stay few


class ADBatch(NamedTuple):
    """Windows of learning histories (paper, table of the AD batch). With obs="state", obs is (B, L, S) uint8."""

    obs: np.ndarray  # float32 (B, L, 5, 5, C)
    prev_actions: np.ndarray  # int32 (B, L); 0 at a history's first step
    prev_rewards: np.ndarray  # float32 (B, L); 0 at a history's first step
    target_actions: np.ndarray  # int32 (B, L)
    dones: np.ndarray  # bool (B, L)
    attention_mask: np.ndarray  # bool (B, L); False on padding behind the end of a range shorter than L
    prev_teammate_actions: np.ndarray | None = None  # int32 (B, L), on request
    layouts: np.ndarray | None = None  # int32 (B,), places in sampler.layouts; of states of several layouts

    def describe(self) -> str:
        """Fields, dtypes and shapes, one a line."""
        return _describe(self)


class DPTBatch(NamedTuple):
    """Queries with contexts (paper, table of the DPT batch). With obs="state", observations are state records."""

    query_obs: np.ndarray  # float32 (B, 5, 5, C)
    query_target: np.ndarray  # int32 (B,), the expert's action
    context_obs: np.ndarray  # float32 (B, K, 5, 5, C)
    context_actions: np.ndarray  # int32 (B, K)
    context_next_obs: np.ndarray  # float32 (B, K, 5, 5, C); what followed in that episode
    context_rewards: np.ndarray  # float32 (B, K)
    context_teammate_actions: np.ndarray | None = None  # int32 (B, K), on request
    layouts: np.ndarray | None = None  # int32 (B,), places in sampler.layouts; of states of several layouts

    def describe(self) -> str:
        """Fields, dtypes and shapes, one a line."""
        return _describe(self)


B = TypeVar("B", ADBatch, DPTBatch)


def _describe(batch: Any) -> str:
    present = {name: array for name, array in batch._asdict().items() if array is not None}
    width = max(map(len, present))
    return "\n".join(f"{name:<{width}}  {a.dtype!s:<8} {a.shape}" for name, a in present.items())


class _Group(NamedTuple):
    """The rows of a batch whose histories are of one layout."""

    layout: Layout
    source: Source
    rows: slice | np.ndarray
    select: Callable[[np.ndarray], np.ndarray]  # of an array (B, ...): the group's


class Sampler(Generic[B]):
    """What both samplers share. See `ADSampler` and `DPTSampler` for the options."""

    def __init__(
        self,
        dataset: Dataset,
        *,
        batch_size: int,
        length: int,
        seed: int,
        teammate_actions: bool,
        weights: Weights,
        episodes: Episodes | None,
        curriculum: Curriculum | None,
        process_index: int,
        process_count: int,
    ) -> None:
        self.batch_size, self.length = whole("batch_size", batch_size, 1), whole("length", length, 1)
        self.seed = whole("seed", seed, 0)
        self.process_index, self.process_count = whole("process_index", process_index, 0), process_count
        if process_index >= whole("process_count", process_count, 1) or batch_size % process_count:
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
        self._kept = self._lengths // dataset.column("episodes")
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
        import hashlib

        weights = self.weights if isinstance(self.weights, str) else self.weights.tolist()  # type: ignore[union-attr]
        curriculum = self.curriculum and [self.curriculum.batches, *self.curriculum.first, *self.curriculum.last]
        return {
            "sampler": type(self).__name__,
            "selection": hashlib.blake2b(self.dataset.ids.astype("<i8").tobytes(), digest_size=16).hexdigest(),
            "data_version": self.dataset.info["data_version"],
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
            first, stop = part_of(self.curriculum.part(whole("batch", i, 0)), first, stop)
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

    def _groups(self, which: np.ndarray) -> Iterator[_Group]:
        """The batch's rows by layout; `which` (B,) are positions in the selection."""
        holding = self.dataset.holding
        if len(self.layouts) == 1:
            yield _Group(self.layouts[0], holding.sources[0], slice(None), lambda array: array)
            return
        number = holding.layout[which]
        for k in np.unique(number).tolist():
            rows = np.flatnonzero(number == k)
            yield _Group(self.layouts[k], holding.sources[k], rows, lambda array, rows=rows: array[rows])

    @property
    def _paints(self) -> bool:
        return self.dataset.obs != "state"

    @property
    def _record_size(self) -> int:
        return max(record_size(layout) for layout in self.layouts)

    def _empty_obs(self, *shape: int) -> np.ndarray:
        if self._paints:
            return np.empty((*shape, *self.layouts[0].obs_shape), self.dataset.obs)
        return np.empty((*shape, self._record_size), np.uint8)

    def _empty_layouts(self) -> np.ndarray | None:
        return np.empty(self.local_size, np.int32) if len(self.layouts) > 1 and not self._paints else None

    def _slabs(self, rows: int) -> Iterator[tuple[int, int]]:
        """Parts of the rows, few enough steps each to stay in the processor's cache."""
        size = max(1, _SLAB // self.length)
        return ((start, min(start + size, rows)) for start in range(0, rows, size))

    def _in_slabs(self, rows: int, work: Callable[[int, int], None]) -> None:
        """Call `work(start, stop)` for all slabs, on the dataset's threads."""
        slabs = list(self._slabs(rows))

        def some(first: int, last: int) -> None:
            for start, stop in slabs[first:last]:
                work(start, stop)

        in_slices(some, len(slabs), self.dataset.threads)

    def _present(self, group: _Group, start: int, stop: int, states: np.ndarray, out: np.ndarray) -> None:
        """Show the state records of rows start..stop of a group in `out` (B, ...), as the dataset presents them."""
        if isinstance(group.rows, slice):
            if self._paints:
                paint(group.layout, states, out[start:stop])
            else:
                out[start:stop] = states
            return
        rows = group.rows[start:stop]
        if self._paints:
            out[rows] = paint(group.layout, states, np.empty((len(rows), *out.shape[1:]), out.dtype))
        else:
            out[rows, ..., : states.shape[-1]] = states
            out[rows, ..., states.shape[-1] :] = 0

    def _checked(self, out: B | None) -> B:
        """`out`, if batches fit in it, or a new one."""
        expected = self._shapes
        if out is None:
            return self.empty()
        found = {name: _shape_of(array) for name, array in out._asdict().items()}
        if found != expected:
            wrong = {name: (expected.get(name), shape) for name, shape in found.items() if expected.get(name) != shape}
            raise OptionError(f"out: expected and found (dtype, shape): {wrong}; take a batch from sampler.empty()")
        return out

    @cached_property
    def _shapes(self) -> dict[str, Any]:
        return {name: _shape_of(array) for name, array in self.empty()._asdict().items()}


def _shape_of(array: np.ndarray | None) -> tuple[str, tuple[int, ...]] | None:
    if array is None:
        return None
    if not (isinstance(array, np.ndarray) and array.flags.c_contiguous and array.flags.writeable):
        raise OptionError("out: expected writeable, C-contiguous arrays; take a batch from sampler.empty()")
    return str(array.dtype), array.shape


class ADSampler(Sampler[ADBatch]):
    """Windows for Algorithm Distillation.

    A history is drawn uniformly from the selection, a start uniformly from 0..T - L; windows cross episode boundaries;
    a history shorter than L is padded at the end. `prev_*` is what preceded each step in the history.

    Args:
        dataset: a selection whose layouts have observations of one shape.
        batch_size: B, over all processes.
        length: L, in steps.
        seed: any non-negative integer.
        teammate_actions: whether to give `prev_teammate_actions`.
        weights: how likely each history is drawn: "uniform", "length" (by its steps) or one number a history.
        episodes: windows stay inside these episodes of each history, such as (0, 10) or (-10, None).
        curriculum: windows stay inside a part of each history that moves with i.
        process_index, process_count: this process gets its share of every batch's rows.

    Raises:
        OptionError: for impossible options, or a selection of unequal observations.
    """

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
        super().__init__(
            dataset,
            batch_size=batch_size,
            length=length,
            seed=seed,
            teammate_actions=teammate_actions,
            weights=weights,
            episodes=episodes,
            curriculum=curriculum,
            process_index=process_index,
            process_count=process_count,
        )

    def windows(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Which windows batch i holds: history ids and starts, int64 (B,) each."""
        position, starts, _ = self._windows(i)
        return self.dataset.ids[position].astype(np.int64), starts

    def _windows(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions in the selection, starts, and how many steps of each window are in its range."""
        which, where = self._local(words(self.seed, i, 2, self.batch_size))
        low, high = self._steps(i)
        weights = self._history_weights(low, high)
        position = below(which, len(self.dataset)) if weights is None else pick(which, weights)
        low, high = low[position], high[position]
        starts = low + below(where, np.maximum(high - low - self.length, 0) + 1)
        return position, starts, np.minimum(high - starts, self.length)

    def empty(self) -> ADBatch:
        shape = (self.local_size, self.length)
        return ADBatch(
            obs=self._empty_obs(*shape),
            prev_actions=np.empty(shape, np.int32),
            prev_rewards=np.empty(shape, np.float32),
            target_actions=np.empty(shape, np.int32),
            dones=np.empty(shape, bool),
            attention_mask=np.empty(shape, bool),
            prev_teammate_actions=np.empty(shape, np.int32) if self.teammate_actions else None,
            layouts=self._empty_layouts(),
        )

    def batch(self, i: int, out: ADBatch | None = None) -> ADBatch:
        which, starts, valid = self._windows(i)
        batch = self._checked(out)
        np.less(np.arange(self.length), valid[:, None], out=batch.attention_mask)
        scalars = [
            ("actions", 0, batch.target_actions),
            ("dones", 0, batch.dones),
            ("actions", -1, batch.prev_actions),
            ("rewards", -1, batch.prev_rewards),
            ("teammate_actions", -1, batch.prev_teammate_actions),
        ]
        threads = self.dataset.threads
        for group in self._groups(which):
            place, start = self.dataset.holding.place[group.select(which)], group.select(starts)
            for field, shift, array in scalars:
                if array is not None:
                    target = array if isinstance(group.rows, slice) else np.empty_like(array[group.rows])
                    group.source.windows(field, place, start + shift, target, threads)
                    if target is not array:
                        array[group.rows] = target
            self._fill_obs(group, place, start, batch.obs)
            if batch.layouts is not None:
                batch.layouts[group.rows] = self.layouts.index(group.layout)
        if valid.min() < self.length:
            padding = ~batch.attention_mask
            for array in (batch.obs, *(array for _, _, array in scalars)):
                if array is not None:
                    array[padding] = 0
        return batch

    def _fill_obs(self, group: _Group, place: np.ndarray, start: np.ndarray, obs: np.ndarray) -> None:
        if not self._paints and isinstance(group.rows, slice):
            group.source.windows("state", place, start, obs, self.dataset.threads)
            return

        def slab(first: int, last: int) -> None:
            states = np.empty((last - first, self.length, record_size(group.layout)), np.uint8)
            group.source.windows("state", place[first:last], start[first:last], states)
            self._present(group, first, last, states, obs)

        self._in_slabs(len(place), slab)


class DPTSampler(Sampler[DPTBatch]):
    """Queries with contexts for Decision-Pretrained Transformers.

    The task is drawn uniformly, then the query's history and the context's independently within the task, the query
    step uniformly, and K transitions of the context's history: `contiguous` (as published) or `random` (i.i.d. and
    unordered, as in the original DPT).

    Args:
        dataset: a selection whose histories all have expert actions, of layouts with observations of one shape.
        batch_size: B, over all processes.
        context: K, in transitions.
        seed: any non-negative integer.
        order: see above.
        teammate_actions: whether to give `context_teammate_actions`.
        weights: how likely each history of a task is drawn: "uniform", "length" or one number a history.
        episodes: query and context stay inside these episodes of their histories.
        curriculum: query and context stay inside a part of their histories that moves with i.
        process_index, process_count: this process gets its share of every batch's rows.

    Raises:
        LabelsMissingError: if a history has no expert actions.
        OptionError: for impossible options, a selection of unequal observations, or K beyond the shortest range.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        batch_size: int,
        context: int,
        seed: int = 0,
        order: ContextOrder = "contiguous",
        teammate_actions: bool = False,
        weights: Weights = "uniform",
        episodes: Episodes | None = None,
        curriculum: Curriculum | None = None,
        process_index: int = 0,
        process_count: int = 1,
    ) -> None:
        super().__init__(
            dataset,
            batch_size=batch_size,
            length=context,
            seed=seed,
            teammate_actions=teammate_actions,
            weights=weights,
            episodes=episodes,
            curriculum=curriculum,
            process_index=process_index,
            process_count=process_count,
        )
        if order not in CONTEXT_ORDERS:
            raise unknown("order", order, CONTEXT_ORDERS)
        unlabelled = dataset.ids[~dataset.column("has_expert_actions")]
        if len(unlabelled):
            raise LabelsMissingError(
                f"DPT needs expert actions, but {len(unlabelled)} of {len(dataset)} histories have none "
                f"(first: {unlabelled[0]}); select labelled ones: entry.has_expert_actions"
            )
        if (self._kept * dataset.column("episodes") != self._lengths).any():
            raise OptionError("some history's episodes are of unequal length; run `icrl4aht-data verify`")
        shortest = min(int((high - low).min()) for low, high in (self._steps(0), self._steps(2**62)))
        if order == "contiguous" and self.length > shortest:
            raise OptionError(f"context = {context}: the shortest history has {shortest} transitions; take fewer")
        self.order: ContextOrder = order

    def options(self) -> dict[str, Any]:
        return super().options() | {"order": self.order}

    @cached_property
    def _tasks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions in the selection, task by task in order of appearance; where each task begins; where it ends."""
        _, first, task = np.unique(self.dataset.column("task_id"), return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        sizes = np.bincount(rank[task])
        return np.argsort(rank[task], kind="stable"), np.cumsum(sizes) - sizes, np.cumsum(sizes)

    def _draw(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Query histories and steps (B,), context histories (B,) and steps (B, K)."""
        drawn = self._local(words(self.seed, i, 4 + (self.length if self.order == "random" else 1), self.batch_size))
        low, high = self._steps(i)
        weights = self._history_weights(low, high)
        _, begins, ends = self._tasks
        task = below(drawn[0], len(begins))
        asking, showing = (self._member(word, begins[task], ends[task], weights) for word in drawn[1:3])
        step = low[asking] + below(drawn[3], (high - low)[asking])
        if self.order == "random":
            steps = low[showing][:, None] + below(drawn[4:].T, (high - low)[showing][:, None])
        else:
            first = low[showing] + below(drawn[4], (high - low)[showing] - self.length + 1)
            steps = first[:, None] + np.arange(self.length)
        return asking, step, showing, steps

    def _member(self, word: np.ndarray, begin: np.ndarray, end: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
        positions = self._tasks[0]
        if weights is None:
            return positions[begin + below(word, end - begin)]
        return positions[pick(word, weights[positions], begin, end)]

    def empty(self) -> DPTBatch:
        rows, shape = self.local_size, (self.local_size, self.length)
        return DPTBatch(
            query_obs=self._empty_obs(rows),
            query_target=np.empty(rows, np.int32),
            context_obs=self._empty_obs(*shape),
            context_actions=np.empty(shape, np.int32),
            context_next_obs=self._empty_obs(*shape),
            context_rewards=np.empty(shape, np.float32),
            context_teammate_actions=np.empty(shape, np.int32) if self.teammate_actions else None,
            layouts=self._empty_layouts(),
        )

    def batch(self, i: int, out: DPTBatch | None = None) -> DPTBatch:
        asking, step, showing, steps = self._draw(i)
        batch = self._checked(out)
        for group in self._groups(asking):  # a task, and so a row, has one layout
            place = self.dataset.holding.place
            query, when = place[group.select(asking)], group.select(step)[:, None]
            batch.query_target[group.rows] = group.source.steps("expert_actions", query, when)[:, 0]
            self._present(group, 0, len(query), group.source.steps("state", query, when)[:, 0], batch.query_obs)
            self._fill_context(group, group.select(showing), group.select(steps), batch)
            if batch.layouts is not None:
                batch.layouts[group.rows] = self.layouts.index(group.layout)
        return batch

    def _fill_context(self, group: _Group, showing: np.ndarray, steps: np.ndarray, batch: DPTBatch) -> None:
        rows = np.arange(self.local_size)[group.rows]
        scalars = [
            ("actions", batch.context_actions),
            ("rewards", batch.context_rewards),
            ("teammate_actions", batch.context_teammate_actions),
        ]

        def slab(first: int, last: int) -> None:
            which, when = showing[first:last], steps[first:last]
            place = self.dataset.holding.place[which]
            for field, array in scalars:
                if array is not None:
                    array[rows[first:last]] = self._read(group.source, field, place, when)
            states, following = self._transitions(group.source, which, place, when)
            self._present(group, first, last, states, batch.context_obs)
            self._present(group, first, last, following, batch.context_next_obs)

        self._in_slabs(len(rows), slab)

    def _read(self, source: Source, field: str, place: np.ndarray, steps: np.ndarray) -> np.ndarray:
        if self.order == "random":
            return source.steps(field, place, steps)
        out = np.empty(steps.shape, np.int8)
        source.windows(field, place, steps[:, 0], out)
        return out

    def _transitions(
        self, source: Source, which: np.ndarray, place: np.ndarray, steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """State records before and after steps (n, K), uint8 (n, K, S) each.

        The record after an episode's last kept step is the one that followed it in that episode, never the first of
        the next.
        """
        last = self._lengths[which][:, None] - 1
        if self.order == "random":
            states = source.steps("state", place, steps)
            following = source.steps("state", place, np.minimum(steps + 1, last))
        else:
            size = source.ends(place[:1], np.zeros(1, np.int64)).shape[-1]
            both = np.empty((len(which), self.length + 1, size), np.uint8)
            source.windows("state", place, steps[:, 0], both)
            states, following = both[:, :-1], both[:, 1:].copy()
        row, column = np.nonzero(self._read(source, "dones", place, steps))
        episode = steps[row, column] // self._kept[which[row]]
        following[row, column] = source.ends(place[row], episode)
        return states, following
