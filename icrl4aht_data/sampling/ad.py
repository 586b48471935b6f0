"""TODO."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrl4aht_data.sampling.base import ChunkRequest, Group, Sampler, _describe
from icrl4aht_data.sampling.draws import random_uint32, scale_to_range, weighted_choice


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

    def windows(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Which windows batch i holds: history ids and starts, int64 (B,) each."""
        position, starts, _ = self._windows(i)
        return self.dataset.ids[position].astype(np.int64), starts

    def _windows(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions in the selection, starts, and how many steps of each window are in its range."""
        which, where = self._local(random_uint32(self.seed, i, 2, self.batch_size))
        low, high = self._steps(i)
        weights = self._history_weights(low, high)
        position = scale_to_range(which, len(self.dataset)) if weights is None else weighted_choice(which, weights)
        low, high = low[position], high[position]
        starts = low + scale_to_range(where, np.maximum(high - low - self.length, 0) + 1)
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
        scalars = [
            ("actions", 0, batch.target_actions),
            ("dones", 0, batch.dones),
            ("actions", -1, batch.prev_actions),
            ("rewards", -1, batch.prev_rewards),
            ("teammate_actions", -1, batch.prev_teammate_actions),
        ]
        place = self.dataset.holding.place
        groups = [(group, place[group.select(which)], group.select(starts)) for group in self._groups(which)]
        fields = list(dict.fromkeys([self._record, *(name for name, _, array in scalars if array is not None)]))
        self._bring(ChunkRequest(g.source, fields, where, low - 1, low + self.length) for g, where, low in groups)
        for group, place, start in groups:

            def fill(first: int, last: int, group=group, place=place, start=start) -> None:
                part, which, low = group.part(first, last), place[first:last], start[first:last]
                for field, shift, array in scalars:
                    if array is not None:
                        self._fill_scalar(field, part, which, low + shift, array)
                self._fill_obs(part, which, low, batch.obs)

            self._on_threads(len(place), fill)
            if batch.layouts is not None:
                batch.layouts[group.rows] = self.layouts.index(group.layout)
        batch.attention_mask[...] = True
        if valid.min() < self.length:
            np.less(np.arange(self.length), valid[:, None], out=batch.attention_mask)
            padding = ~batch.attention_mask
            for array in (batch.obs, *(array for _, _, array in scalars)):
                if array is not None:
                    array[padding] = 0
        return batch

    def _fill_scalar(self, field: str, group: Group, place: np.ndarray, start: np.ndarray, out: np.ndarray) -> None:
        if isinstance(group.rows, slice):
            group.source.windows(field, place, start, out[group.rows])
            return
        rows = np.empty((len(place), self.length), out.dtype)
        group.source.windows(field, place, start, rows)
        out[group.rows] = rows

    def _fill_obs(self, group: Group, place: np.ndarray, start: np.ndarray, obs: np.ndarray) -> None:
        if not self._paints and obs.dtype == np.uint8 and isinstance(group.rows, slice):
            group.source.windows(self._record, place, start, obs[group.rows])
            return
        for low, high in self._slabs(0, len(place)):
            records = self._empty_records(group, high - low, self.length)
            group.source.windows(self._record, place[low:high], start[low:high], records)
            self._present(group.part(low, high), records, obs)
