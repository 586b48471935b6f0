"""AD and DPT samplers (paper, App. D.4): sequences of batches, each a pure function of (selection, options, seed, i).

`sampler[i]` is the same in any process, on any number of workers, from a lite or a full release; to resume, go on from
the next i. `len(sampler)` batches hold as many steps as the selection; `i` may go on beyond.
`B` denotes the batch size, `L` the window's length, `K` the context's, `(5, 5, C)` an observation.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from icrl4aht_data.benchmark import unknown
from icrl4aht_data.dataset import Dataset, History, render
from icrl4aht_data.errors import LabelsMissingError, OptionError

ContextOrder = Literal["contiguous", "random"]
CONTEXT_ORDERS: tuple[ContextOrder, ...] = ("contiguous", "random")


class ADBatch(NamedTuple):
    """Windows of learning histories (paper, table of the AD batch). With obs_dtype="state", obs is (B, L, S) uint8."""

    obs: np.ndarray  # float32 (B, L, 5, 5, C)
    prev_actions: np.ndarray  # int32 (B, L); 0 at a history's first step
    prev_rewards: np.ndarray  # float32 (B, L); 0 at a history's first step
    target_actions: np.ndarray  # int32 (B, L)
    dones: np.ndarray  # bool (B, L)
    attention_mask: np.ndarray  # bool (B, L); False on padding behind the end of a history shorter than L
    prev_teammate_actions: np.ndarray | None = None  # int32 (B, L), on request

    def describe(self) -> str:
        """Fields, dtypes and shapes, one a line."""
        return _describe(self)


class DPTBatch(NamedTuple):
    """Queries with contexts (paper, table of the DPT batch). With obs_dtype="state", observations are state records."""

    query_obs: np.ndarray  # float32 (B, 5, 5, C)
    query_target: np.ndarray  # int32 (B,), the expert's action
    context_obs: np.ndarray  # float32 (B, K, 5, 5, C)
    context_actions: np.ndarray  # int32 (B, K)
    context_next_obs: np.ndarray  # float32 (B, K, 5, 5, C); what followed in that episode
    context_rewards: np.ndarray  # float32 (B, K)
    context_teammate_actions: np.ndarray | None = None  # int32 (B, K), on request

    def describe(self) -> str:
        """Fields, dtypes and shapes, one a line."""
        return _describe(self)


def _describe(batch: Any) -> str:
    present = {name: array for name, array in batch._asdict().items() if array is not None}
    width = max(map(len, present))
    return "\n".join(f"{name:<{width}}  {a.dtype!s:<8} {a.shape}" for name, a in present.items())


class _Sampler:
    """What both samplers share: options, histories of one shape, draws, rendering."""

    def __init__(self, dataset: Dataset, *, batch_size: int, length: int, seed: int, teammate_actions: bool) -> None:
        batch_size, length = _whole("batch_size", batch_size, 1), _whole("length", length, 1)
        seed = _whole("seed", seed, 0)
        layouts = list(dict.fromkeys(entry.layout for entry in dataset.entries))
        if len(layouts) > 1:
            raise OptionError(
                f"the selection spans layouts {', '.join(layouts)}, a sampler takes one: add layout={layouts[0]!r}"
            )
        if teammate_actions and not all(entry.has_teammate_actions for entry in dataset.entries):
            raise LabelsMissingError("teammate actions were asked for, but some histories have none")
        self.dataset = dataset
        self.batch_size, self.length, self.seed = batch_size, length, seed
        self.teammate_actions = teammate_actions
        self._entry = dataset.entries[0]
        self._lengths = np.array([entry.T for entry in dataset.entries])

    def __len__(self) -> int:
        return max(1, int(self._lengths.sum()) // (self.batch_size * self.length))

    def _draws(self, i: int, count: int) -> np.ndarray:
        """uint64 (count, B): random words below 2**32, from (seed, i) alone.

        Philox's raw output is fixed by its definition, so batches stay the same across NumPy versions.
        """
        i = _whole("batch", i, 0)
        raw = np.random.Philox(key=np.array([self.seed, i], np.uint64)).random_raw(count * self.batch_size)
        return (raw >> np.uint64(32)).reshape(count, self.batch_size)

    def _present(self, states: np.ndarray) -> np.ndarray:
        """State records (..., S) as the dataset presents observations."""
        return states if self.dataset.obs_dtype == "state" else render(self._entry, states, self.dataset.obs_dtype)


class ADSampler(_Sampler):
    """Windows for Algorithm Distillation.

    A history is drawn uniformly from the selection, a start uniformly from 0..T - L; windows cross episode boundaries;
    a history shorter than L is padded at the end. `prev_*` is what preceded each step in the history.

    Args:
        dataset: a selection on one layout.
        batch_size: B.
        length: L, in steps.
        seed: any non-negative integer.
        teammate_actions: whether to give `prev_teammate_actions`.

    Raises:
        OptionError: for impossible options, or a selection that spans layouts.
    """

    def windows(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Which windows batch i holds: history ids and starts, int64 (B,) each."""
        which, where = self._draws(i, 2)
        position = _below(which, len(self.dataset))
        starts = np.maximum(self._lengths[position] - self.length, 0) + 1
        return self.dataset.ids[position].astype(np.int64), _below(where, starts)

    def __getitem__(self, i: int) -> ADBatch:
        shape = (self.batch_size, self.length)
        ids, starts = self.windows(i)
        states = None
        batch = {
            "prev_actions": np.zeros(shape, np.int32),
            "prev_rewards": np.zeros(shape, np.float32),
            "target_actions": np.zeros(shape, np.int32),
            "dones": np.zeros(shape, bool),
            "attention_mask": np.zeros(shape, bool),
        }
        if self.teammate_actions:
            batch["prev_teammate_actions"] = np.zeros(shape, np.int32)
        previous = {"prev_actions": "actions", "prev_rewards": "rewards", "prev_teammate_actions": "teammate_actions"}
        for row, (history_id, start) in enumerate(zip(ids.tolist(), starts.tolist(), strict=True)):
            history = self.dataset.history(history_id)
            stop = min(start + self.length, len(history))
            window = history.read("state", start, stop)
            if states is None:
                states = np.zeros((*shape, window.shape[-1]), np.uint8)
            states[row, : stop - start] = window
            batch["target_actions"][row, : stop - start] = history.read("actions", start, stop)
            batch["dones"][row, : stop - start] = history.read("dones", start, stop)
            batch["attention_mask"][row, : stop - start] = True
            skip = start == 0  # nothing precedes a history's first step
            for name in batch.keys() & previous.keys():
                batch[name][row, skip : stop - start] = history.read(previous[name], start - 1 + skip, stop - 1)
        assert states is not None
        obs = self._present(states)
        if self.dataset.obs_dtype != "state":
            obs[~batch["attention_mask"]] = 0
        return ADBatch(obs=obs, **batch)

    def __iter__(self) -> Iterator[ADBatch]:
        return (self[i] for i in range(len(self)))


class DPTSampler(_Sampler):
    """Queries with contexts for Decision-Pretrained Transformers.

    The task is drawn uniformly, then the query's history and the context's independently within the task, the query
    step uniformly, and K transitions of the context's history: `contiguous` (as published) or `random` (i.i.d. and
    unordered, as in the original DPT).

    Args:
        dataset: a selection on one layout whose histories all have expert actions.
        batch_size: B.
        context: K, in transitions.
        seed: any non-negative integer.
        order: see above.
        teammate_actions: whether to give `context_teammate_actions`.

    Raises:
        LabelsMissingError: if a history has no expert actions.
        OptionError: for impossible options, a selection that spans layouts, or K beyond the shortest history.
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
    ) -> None:
        super().__init__(dataset, batch_size=batch_size, length=context, seed=seed, teammate_actions=teammate_actions)
        if order not in CONTEXT_ORDERS:
            raise unknown("order", order, CONTEXT_ORDERS)
        unlabelled = [entry.history_id for entry in dataset.entries if not entry.has_expert_actions]
        if unlabelled:
            raise LabelsMissingError(
                f"DPT needs expert actions, but {len(unlabelled)} of {len(dataset)} histories have none "
                f"(first: {unlabelled[0]}); select labelled ones: entry.has_expert_actions"
            )
        shortest = int(self._lengths.min())
        if order == "contiguous" and self.length > shortest:
            raise OptionError(f"context = {context}: the shortest history has {shortest} transitions; take fewer")
        self.order: ContextOrder = order

    @cached_property
    def _members(self) -> list[np.ndarray]:
        """Positions in the selection of each task's histories, tasks in order of appearance."""
        tasks: dict[str, list[int]] = {}
        for position, entry in enumerate(self.dataset.entries):
            tasks.setdefault(entry.task_id, []).append(position)
        return [np.array(positions) for positions in tasks.values()]

    def __getitem__(self, i: int) -> DPTBatch:
        draws = self._draws(i, 4 + (self.length if self.order == "random" else 1))
        task = _below(draws[0], len(self._members))
        parts = [self._one(self._members[t], draws[1:, row]) for row, t in enumerate(task.tolist())]
        query, target, states, following, actions, rewards, mates = (np.stack(p) for p in zip(*parts, strict=True))
        return DPTBatch(
            query_obs=self._present(query),
            query_target=target.astype(np.int32),
            context_obs=self._present(states),
            context_actions=actions,
            context_next_obs=self._present(following),
            context_rewards=rewards,
            context_teammate_actions=mates if self.teammate_actions else None,
        )

    def _one(self, members: np.ndarray, draws: np.ndarray) -> tuple[np.ndarray, ...]:
        asking, showing = (self.dataset[int(members[_below(draw, len(members))])] for draw in draws[:2])
        step = int(_below(draws[2], len(asking)))
        if self.order == "random":
            rows = _below(draws[3:], len(showing))
        else:
            first = int(_below(draws[3], len(showing) - self.length + 1))
            rows = np.arange(first, first + self.length)
        low, high = int(rows.min()), int(rows.max()) + 1
        states, following = transitions(showing, low, high)
        rows = rows - low
        return (
            asking.read("state", step, step + 1)[0],
            asking.read("expert_actions", step, step + 1)[0],
            states[rows],
            following[rows],
            *(showing.read(name, low, high)[rows] for name in ("actions", "rewards", "teammate_actions")),
        )

    def __iter__(self) -> Iterator[DPTBatch]:
        return (self[i] for i in range(len(self)))


def transitions(history: History, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """State records before and after steps start..stop, uint8 (stop - start, S) each.

    The record after an episode's last kept step is the one that followed it in that episode, never the first of the
    next.
    """
    states = history.read("state", start, min(stop + 1, len(history)))
    following = np.zeros_like(states[: stop - start])
    following[: len(states) - 1] = states[1 : stop - start + 1]
    dones = history.read("dones", 0, stop)
    last = np.flatnonzero(dones[start:])
    episode = np.cumsum(dones)[start:][last] - 1
    following[last] = history.read("episode_end_state")[episode]
    return states[: stop - start], following


def _whole(name: str, value: Any, least: int) -> int:
    """The value as an int, if it is one from `least` to 2**63."""
    try:
        number = operator.index(value)
    except TypeError as error:
        raise OptionError(f"{name} = {value!r}: expected a whole number") from error
    if not least <= number < 2**63:
        raise OptionError(f"{name} = {number}: expected at least {least} and below 2**63")
    return number


def _below(words: np.ndarray, n: Any) -> np.ndarray:
    """int64: words below 2**32 scaled to 0..n - 1."""
    return (words * np.asarray(n).astype(np.uint64) >> np.uint64(32)).astype(np.int64)
