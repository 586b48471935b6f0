"""Batches for Decision-Pretrained Transformers (paper, App. D.4). `B` is the batch size, `K` the context length."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, Unpack

import numpy as np

from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.reading.sources import ReadRequest
from icrl4aht_data.sampling.base import A, Sampler, SamplerOptions, batch_repr, check_labels, describe_batch
from icrl4aht_data.sampling.draws import scale_to_range, weighted_choice
from icrl4aht_data.sampling.observer import ArraySpec
from icrl4aht_data.utils.options import check_int

if TYPE_CHECKING:
    import jax  # noqa: F401 - used by a type argument of the base class
    import torch  # noqa: F401

ContextOrder = Literal["contiguous", "random"]
CONTEXT_ORDERS: tuple[ContextOrder, ...] = ("contiguous", "random")
"""Valid orders of a context's transitions: consecutive steps (as in the published code), or independent draws."""


class DPTBatch(NamedTuple, Generic[A]):
    """Batch of queries with contexts (paper, App. D.4).

    With obs="state", observations are state records: uint8 (B, S) and (B, K, S) instead of (B, 5, 5, C) and
    (B, K, 5, 5, C). With several queries per context, the query arrays have an axis Q after B.

    Attributes:
        query_obs: float32 or uint8 (B, 5, 5, C): the ego's observation at the query step.
        query_target: int64 (B,): the label to predict at the query step: the action 0..5 of the expert or the oracle.
        context_obs: float32 or uint8 (B, K, 5, 5, C): observations at the context's transitions.
        context_actions: int32 (B, K): the ego's actions in the context's transitions, 0..5.
        context_next_obs: float32 or uint8 (B, K, 5, 5, C): observations after the context's transitions, in the same
            episode.
        context_rewards: float32 (B, K): the team's rewards in the context's transitions.
        context_teammate_actions: int32 (B, K): the teammate's actions in the context's transitions, 0..5; None unless
            the sampler was made with teammate_actions=True.
        layouts: int32 (B,): index of each row's layout in `sampler.layouts`; None unless obs="state" and there are
            several layouts.
    """

    query_obs: A
    query_target: A
    context_obs: A
    context_actions: A
    context_next_obs: A
    context_rewards: A
    context_teammate_actions: A | None = None
    layouts: A | None = None

    describe = describe_batch
    __repr__ = batch_repr


class DPTSampler(Sampler[DPTBatch[np.ndarray], "DPTBatch[jax.Array]", "DPTBatch[torch.Tensor]"]):
    """A sequence of batches of queries with contexts; batch i is a pure function of (selection, options, seed, i).

    For each row a task is drawn uniformly, then two histories of the task independently (uniformly or by `weights`):
    one for the query, whose step is drawn uniformly, and one for the context of K transitions. Transitions are
    `contiguous` (as in the published code) or `random` (independent and unordered, as in the original DPT). With
    `queries` = Q > 1, Q steps are drawn independently from the query's history, so one context is used for Q
    predictions.

    In releases of kind `observations`, contexts skip the last kept step of each episode, whose next observation is not
    stored. In contiguous contexts, the first step of the next episode therefore follows the second to last step.

    Args:
        dataset: a selection whose histories all have the labels, with observations of one shape: layouts with equally
            many channels, or channels="canonical".
        batch_size: B, the number of rows of a batch over all processes.
        context: K, the number of transitions of a context.
        order: "contiguous" or "random".
        labels: "expert" or "oracle"; see `history.LABELS`.
        queries: Q, the number of queries for each context.
        options: options shared with `ADSampler`: `seed`; `teammate_actions`, whether batches have
            `context_teammate_actions`; `weights`, probabilities of the histories of a task, which is never drawn if all
            are 0; `episodes` and `curriculum`, the part of each history that queries and contexts are drawn from;
            `process_index` and `process_count`.

    Warns:
        WeakLabelsWarning: for tasks whose labels come from a policy or an oracle that earns less than half of what
            the histories earn at the end. Tasks without measured returns are not checked.

    Raises:
        LabelsMissingError: if a history does not have the labels; the message names existing labels.
        OptionError: for impossible options, a selection with observations of several shapes, or contiguous contexts
            longer than some history or than its part selected by `episodes` or `curriculum`.
    """

    batch_type, length_option = DPTBatch, "context"

    def __init__(
        self,
        dataset: Selection,
        *,
        batch_size: int,
        context: int,
        order: ContextOrder = "contiguous",
        labels: Labels = "expert",
        queries: int = 1,
        **options: Unpack[SamplerOptions],
    ) -> None:
        self.queries = check_int("queries", queries, 1)
        super().__init__(dataset, batch_size=batch_size, length=context, **options)
        check_choice("order", order, CONTEXT_ORDERS)
        shortest = int(self._count_transitions(self._draws.fewest_steps()).min())
        if (self.length if order == "contiguous" else 1) > shortest:
            raise OptionError(
                f"context = {context}: the shortest history has {shortest} transitions to draw from; choose a smaller "
                f"context"
            )
        check_labels(dataset, labels)
        self.order, self.labels = order, labels

    def options(self) -> dict[str, Any]:
        excluded = {} if self.dataset.has_states else {"excluded": "last steps of episodes"}
        several = {"queries": self.queries} if self.queries > 1 else {}
        return super().options() | {"order": self.order, "labels": self.labels} | several | excluded

    @cached_property
    def specs(self) -> dict[str, ArraySpec]:
        shape = self.local_size, self.length
        asked = (self.local_size, self.queries) if self.queries > 1 else (self.local_size,)
        return {
            "query_obs": self._observer.spec(*asked),
            "query_target": ArraySpec("int64", asked),
            "context_obs": self._observer.spec(*shape),
            "context_actions": ArraySpec("int32", shape),
            "context_next_obs": self._observer.spec(*shape),
            "context_rewards": ArraySpec("float32", shape),
            **({"context_teammate_actions": ArraySpec("int32", shape)} if self.teammate_actions else {}),
            **self._layout_specs(),
        }

    def batch(self, i: int, out: DPTBatch[np.ndarray] | None = None) -> DPTBatch[np.ndarray]:
        batch = self._buffer(out)  # first, so that a batch that is too large raises an error at once
        query, query_steps, context, steps = self._draw(i)

        observer, kept_steps = self._observer, self._draws.kept_steps
        query_records = observer.records(batch.query_obs)
        records, next_records = observer.records(batch.context_obs), observer.records(batch.context_next_obs)
        if self.order == "contiguous" and self.dataset.has_states:
            # A window requested by its first row is copied as a block. The row after the end of a history is zero.
            rows, next_rows = steps[:, 0], steps[:, 0] + 1
        else:
            # Single rows after a history's end cannot be read: the history's last row is read, and replaced below.
            rows, next_rows = steps, np.minimum(steps + 1, self._draws.lengths[context][:, None] - 1)
        # A `ReadRequest` needs an axis of queries, which the batch's arrays have only for several queries per context.
        queries, record = query_steps.shape, records.shape[2:]
        reads = [
            ReadRequest(f"{self.labels}_actions", query, query_steps, batch.query_target.reshape(queries)),
            ReadRequest(observer.field, query, query_steps, query_records.reshape(*queries, *record)),
            ReadRequest("actions", context, rows, batch.context_actions),
            ReadRequest("rewards", context, rows, batch.context_rewards),
            ReadRequest(observer.field, context, rows, records),
            ReadRequest(observer.field, context, next_rows, next_records),
        ]
        if batch.context_teammate_actions is not None:
            reads.append(ReadRequest("teammate_actions", context, rows, batch.context_teammate_actions))
        # The next observation of an episode's last step shows the end state, not the first state of the next episode.
        episodes = steps // kept_steps
        ends = np.nonzero((steps == episodes * kept_steps + kept_steps - 1) & self.dataset.has_states)
        end_records = np.empty((len(ends[0]), 1, *record), next_records.dtype)
        reads.append(ReadRequest("episode_end_state", context[ends[0]], episodes[ends], end_records))
        self.dataset.storage.read(reads)
        next_records[ends] = end_records[:, 0]

        observer.observe(query, query_records, batch.query_obs)
        observer.observe(context, records, batch.context_obs)
        observer.observe(context, next_records, batch.context_next_obs)
        if batch.layouts is not None:
            # Query and context of a row have the same task, so the same layout.
            batch.layouts[...] = self.dataset.layout_numbers[query]
        return batch

    def _draw(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Draw the queries and contexts of batch i.

        Returns:
            int64 (B,), position of each query's history in the selection.
            int64 (B, Q), steps of the queries.
            int64 (B,), position of each context's history in the selection.
            int64 (B, K), the steps of the contexts' transitions.
        """
        drawn = self.length if self.order == "random" else 1
        random = self._random(i, 3 + self.queries + drawn)
        for_task, for_query, for_context = random[:3]
        # The random numbers of further queries come last, so context and first query do not depend on `queries`.
        for_query_steps = np.concatenate([random[3:4], random[4 + drawn :]]).T
        for_steps = random[4 : 4 + drawn].T

        low, high = self._draws.steps(i)
        members, begins, ends = self._histories_by_task
        weights = self._draws.history_weights(low, high)
        if weights is not None:
            weights = weights[members]
            drawn_tasks = np.logical_or.reduceat(weights > 0, begins)
            begins, ends = begins[drawn_tasks], ends[drawn_tasks]
        task = scale_to_range(for_task, len(begins))
        query, context = (
            members[weighted_choice(number, weights, begins[task], ends[task])] for number in (for_query, for_context)
        )
        query_steps = low[query][:, None] + scale_to_range(for_query_steps, (high - low)[query][:, None])
        # Each number drawn is the start of a window of K transitions, or with random order a single transition.
        window = self.length // drawn
        low, high = self._count_transitions(low)[context][:, None], self._count_transitions(high)[context][:, None]
        transitions = low + scale_to_range(for_steps, high - low - window + 1) + np.arange(window)
        return query, query_steps, context, self._transition_steps(transitions)

    @cached_property
    def _histories_by_task(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions of histories sorted by task, int64 (H,), and the start and end of each task in this order."""
        _, first, task = np.unique(self.dataset.column_codes("task_id"), return_index=True, return_inverse=True)
        task = np.argsort(np.argsort(first))[task]  # tasks are renumbered in order of first appearance
        sizes = np.bincount(task)
        return np.argsort(task, kind="stable"), np.cumsum(sizes) - sizes, np.cumsum(sizes)

    # Transitions are the steps whose next observation is stored: all steps in a release with states, otherwise all but
    # the last one of each episode. A draw is the number of a transition.

    def _count_transitions(self, steps: np.ndarray) -> np.ndarray:
        """Return the number of transitions among a history's first `steps` steps."""
        return steps if self.dataset.has_states else steps - -(-steps // self._draws.kept_steps)

    def _transition_steps(self, transition: np.ndarray) -> np.ndarray:
        """Return the step of each transition; steps and transitions are numbered from the start of the history."""
        return transition if self.dataset.has_states else transition + transition // (self._draws.kept_steps - 1)
