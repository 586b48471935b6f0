"""AD and DPT samplers (paper, App. D.4): sequences of batches, each a pure function of (selection, options, seed, i).

`sampler[i]` is the same in any process, on any number of workers and threads, however the data are held, from a lite or
a full release; to resume, go on from the next i. `len(sampler)` batches hold as many steps as the selection; `i` may go
on beyond. `B` denotes the batch size, `L` the window's length, `K` the context's, `(5, 5, C)` an observation.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from icrl4aht_data.errors import LabelsMissingError, OptionError, unknown
from icrl4aht_data.reading.sources import HistorySource
from icrl4aht_data.sampling.base import ChunkRequest, Group, Sampler, _describe
from icrl4aht_data.sampling.draws import random_uint32, scale_to_range, weighted_choice

if TYPE_CHECKING:
    from typing import Unpack

    from icrl4aht_data.dataset import Dataset
    from icrl4aht_data.sampling.base import SamplerOptions

ContextOrder = Literal["contiguous", "random"]
CONTEXT_ORDERS: tuple[ContextOrder, ...] = ("contiguous", "random")


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


class DPTSampler(Sampler[DPTBatch]):
    """Queries with contexts for Decision-Pretrained Transformers.

    The task is drawn uniformly, then the query's history and the context's independently within the task, the query
    step uniformly, and K transitions of the context's history: `contiguous` (as published) or `random` (i.i.d. and
    unordered, as in the original DPT).

    A release of observations does not have what followed an episode's last step. There contexts are made of the other
    transitions, and contiguous ones go on from an episode's last but one step with the next episode's first.

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
        order: ContextOrder = "contiguous",
        **options: Unpack[SamplerOptions],
    ) -> None:
        super().__init__(dataset, batch_size=batch_size, length=context, **options)
        if order not in CONTEXT_ORDERS:
            raise unknown("order", order, CONTEXT_ORDERS)
        unlabelled = dataset.ids[~dataset.column("has_expert_actions")]
        if len(unlabelled):
            raise LabelsMissingError(
                f"DPT needs expert actions, but {len(unlabelled)} of {len(dataset)} histories have none "
                f"(first: {unlabelled[0]}); select labelled ones: entry.has_expert_actions"
            )
        parts = (map(self._transitions, self._steps(i)) for i in (0, 2**62))
        shortest = min(int((high - low).min()) for low, high in parts)
        if (self.length if order == "contiguous" else 1) > shortest:
            raise OptionError(f"context = {context}: the shortest history has {shortest} transitions; take fewer")
        self.order: ContextOrder = order

    def options(self) -> dict[str, Any]:
        excluded = {} if self.dataset.has_states else {"excluded": "last steps of episodes"}
        return super().options() | {"order": self.order} | excluded

    def _transitions(self, steps: np.ndarray) -> np.ndarray:
        """How many of a history's first steps are transitions whose next observation is stored."""
        return steps if self.dataset.has_states else steps - -(-steps // self._kept)

    def _step_of(self, transition: np.ndarray) -> np.ndarray:
        """The reverse: which step a transition is, counted from the history's first."""
        return transition if self.dataset.has_states else transition + transition // (self._kept - 1)

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
        drawn = self._local(
            random_uint32(self.seed, i, 4 + (self.length if self.order == "random" else 1), self.batch_size)
        )
        low, high = self._steps(i)
        weights = self._history_weights(low, high)
        _, begins, ends = self._tasks
        task = scale_to_range(drawn[0], len(begins))
        asking, showing = (self._member(word, begins[task], ends[task], weights) for word in drawn[1:3])
        step = low[asking] + scale_to_range(drawn[3], (high - low)[asking])
        low, high = self._transitions(low), self._transitions(high)
        if self.order == "random":
            shown = low[showing][:, None] + scale_to_range(drawn[4:].T, (high - low)[showing][:, None])
        else:
            first = low[showing] + scale_to_range(drawn[4], (high - low)[showing] - self.length + 1)
            shown = first[:, None] + np.arange(self.length)
        return asking, step, showing, self._step_of(shown)

    def _member(self, word: np.ndarray, begin: np.ndarray, end: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
        positions = self._tasks[0]
        if weights is None:
            return positions[begin + scale_to_range(word, end - begin)]
        return positions[weighted_choice(word, weights[positions], begin, end)]

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
        groups = list(self._groups(asking))  # a task, and so a row, has one layout
        place = self.dataset.holding.place
        self._bring(part for group in groups for part in self._needed(group, asking, step, showing, steps))
        for group in groups:
            query, when = place[group.select(asking)], group.select(step)[:, None]
            batch.query_target[group.rows] = group.source.steps("expert_actions", query, when)[:, 0]
            self._present(group, group.source.steps(self._record, query, when)[:, 0], batch.query_obs)
            self._fill_context(group, group.select(showing), group.select(steps), batch)
            if batch.layouts is not None:
                batch.layouts[group.rows] = self.layouts.index(group.layout)
        return batch

    def _needed(
        self, group: Group, asking: np.ndarray, step: np.ndarray, showing: np.ndarray, steps: np.ndarray
    ) -> Iterator[ChunkRequest]:
        place = self.dataset.holding.place
        query, when = place[group.select(asking)], group.select(step)
        yield ChunkRequest(group.source, [self._record, "expert_actions"], query, when, when + 1)
        shown, low, high = (group.select(array) for array in (place[showing], steps.min(axis=1), steps.max(axis=1) + 1))
        labels = ["teammate_actions"] if self.teammate_actions else []
        yield ChunkRequest(group.source, [self._record, "actions", "rewards", "dones", *labels], shown, low, high + 1)
        if self.dataset.has_states:
            yield ChunkRequest(group.source, ["episode_end_state"], shown, low // self._kept, high // self._kept + 1)

    def _fill_context(self, group: Group, showing: np.ndarray, steps: np.ndarray, batch: DPTBatch) -> None:
        scalars = [
            ("actions", batch.context_actions),
            ("rewards", batch.context_rewards),
            ("teammate_actions", batch.context_teammate_actions),
        ]

        def slab(first: int, last: int) -> None:
            part, which, when = group.part(first, last), showing[first:last], steps[first:last]
            place = self.dataset.holding.place[which]
            for field, array in scalars:
                if array is not None:
                    array[part.rows] = self._read(group.source, field, place, when)
            records, following = self._before_and_after(group, which, place, when)
            self._present(part, records, batch.context_obs)
            self._present(part, following, batch.context_next_obs)

        self._in_slabs(len(showing), slab)

    def _read(self, source: HistorySource, field: str, place: np.ndarray, steps: np.ndarray) -> np.ndarray:
        if self._scattered:
            return source.steps(field, place, steps)
        out = np.empty(steps.shape, np.int8)
        source.windows(field, place, steps[:, 0], out)
        return out

    @property
    def _scattered(self) -> bool:
        """Whether a context's steps are not simply one after the other."""
        return self.order == "random" or not self.dataset.has_states

    def _before_and_after(
        self, group: Group, which: np.ndarray, place: np.ndarray, steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Records before and after steps (n, K), uint8 (n, K, S) or (n, K, 5, 5, C) each.

        The record after an episode's last kept step is the one that followed it in that episode, never the first of
        the next.
        """
        source, last = group.source, self._lengths[which][:, None] - 1
        if self._scattered:
            records = source.steps(self._record, place, steps)
            following = source.steps(self._record, place, np.minimum(steps + 1, last))
        else:
            both = self._empty_records(group, len(which), self.length + 1)
            source.windows(self._record, place, steps[:, 0], both)
            records, following = both[:, :-1], both[:, 1:].copy()
        if self.dataset.has_states:
            row, column = np.nonzero(self._read(source, "dones", place, steps))
            following[row, column] = source.ends(place[row], steps[row, column] // self._kept)
        return records, following
