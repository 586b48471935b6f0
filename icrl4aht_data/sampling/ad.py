"""Batches for Algorithm Distillation (paper, App. D.4). `B` denotes the batch size, `L` the window length."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Unpack, cast

import numpy as np

from icrl4aht_data.benchmark.facts import all_families
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.reading.sources import ReadRequest
from icrl4aht_data.sampling.base import A, Sampler, SamplerOptions, batch_repr, check_labels, describe_batch
from icrl4aht_data.sampling.draws import scale_to_range, weighted_choice
from icrl4aht_data.sampling.observer import ArraySpec
from icrl4aht_data.utils.options import Share, check_int, check_number

if TYPE_CHECKING:
    import jax  # noqa: F401 - used by a type argument of the base class
    import torch  # noqa: F401


class ADBatch(NamedTuple, Generic[A]):
    """Windows of learning histories (paper, App. D.4).

    Rows are padded with zeros if the history, or the part selected by `episodes` or `curriculum`, is shorter than L.
    The `prev_*` fields hold the values of the previous step of the history, also at the first step of a window or of an
    episode. Where `is_first` is True there is no previous step: zeros are placeholders, although 0 is the action "up".

    Attributes:
        obs: float32 or uint8 (B, L, 5, 5, C): the ego's observations; with obs="state" uint8 (B, L, S): state records.
        prev_actions: int32 (B, L): the ego's actions in the previous steps, 0..5; 0 at a history's first step.
        prev_rewards: float32 (B, L): the team's rewards in the previous steps; 0 at a history's first step.
        target_actions: int64 (B, L): the actions that a model learns to predict, 0..5: the ego's actions, or with the
            option `labels` the actions of the expert or the oracle. In both cases, the next column of `prev_actions`
            has the actions taken by the ego.
        dones: bool (B, L): True at the last step of an episode.
        attention_mask: bool (B, L): False on padding.
        prev_teammate_actions: int32 (B, L): the teammate's actions in the previous steps, 0..5, and 0 at a history's
            first step; None unless the sampler was made with teammate_actions=True.
        layouts: int32 (B,): index of each row's layout in `sampler.layouts`; None unless obs="state" and there are
            several layouts.
        is_first: bool (B, L): True at the first step of a history, where the `prev_*` fields are placeholders.
        families: int32 (B,): index of the family of each row's teammate in `benchmark.facts.all_families()`; None
            unless the sampler was made with families=True.
    """

    obs: A
    prev_actions: A
    prev_rewards: A
    target_actions: A
    dones: A
    attention_mask: A
    prev_teammate_actions: A | None = None
    layouts: A | None = None
    is_first: A = cast(Any, None)  # Python requires a default here; it is never used
    families: A | None = None

    describe = describe_batch
    __repr__ = batch_repr


class ADSampler(Sampler[ADBatch[np.ndarray], "ADBatch[jax.Array]", "ADBatch[torch.Tensor]"]):
    """A sequence of batches for Algorithm Distillation; batch i is a pure function of (selection, options, seed, i).

    For each row, a history is drawn uniformly from the selection (or by `weights`), and the first step of a window
    uniformly from 0..T - L (or by `at_start`). Windows cross episode boundaries. Rows are padded with zeros at the end
    if the history, or the part selected by `episodes` or `curriculum`, is shorter than L.

    `sampler[i]` does not depend on the process, the number of workers and threads, the cache, or whether the release is
    lite or full. To resume, continue with the next i.

    Args:
        dataset: a selection with observations of one shape: layouts with equally many channels, or
            channels="canonical".
        batch_size: B, the number of rows of a batch over all processes.
        length: L, the number of steps of a window.
        every: n; windows consist of every n-th episode of a history, so few episodes show much of the learning. The
            first episode is drawn at random for each window; at the first step of later episodes, `prev_*` come from
            the previous episode of the window.
        labels: targets are labels of this kind, "expert" or "oracle", instead of the actions taken; see
            `history.LABELS`.
        at_start: share of the windows that begin at the first step of a history, or of the part selected by `episodes`
            or `curriculum`, 0..1. A test begins there, but few windows would.
        families: whether batches have the field `families`, from which a model can learn to predict the teammate's
            family.
        seed: seed of the random draws, a non-negative integer below 2**63.
        teammate_actions: whether batches have the field `prev_teammate_actions`.
        weights: probabilities of the histories: "uniform", "length" (proportional to the steps that windows may
            contain) or one non-negative number per history, float (H,).
        episodes: range of episodes of each history to which windows are limited, such as (0, 10) or (-10, None).
        curriculum: part of each history to which windows are limited, which moves with i; see `Curriculum`.
        process_index, process_count: index of this process, and number of processes; each process gets batch_size /
            process_count rows of every batch.

    Warns:
        WeakLabelsWarning: with `labels`, for tasks whose labels come from a policy or an oracle that earns less than
            half of what the histories earn at the end; see `DPTSampler`.

    Raises:
        OptionError: for impossible options, or a selection with observations of several shapes.
        LabelsMissingError: if some history does not have the labels, or with teammate_actions=True no teammate actions.
    """

    batch_type = ADBatch

    def __init__(
        self,
        dataset: Selection,
        *,
        batch_size: int,
        length: int,
        every: int = 1,
        labels: Labels | None = None,
        at_start: float = 0.0,
        families: bool = False,
        **options: Unpack[SamplerOptions],
    ) -> None:
        super().__init__(dataset, batch_size=batch_size, length=length, **options)
        self.every = check_int("every", every, 1)
        self.families, self.labels, self.at_start = families, labels, check_number("at_start", at_start, Share)
        if labels is not None:
            check_labels(dataset, labels)

    def options(self) -> dict[str, Any]:
        # Options with default values are left out, so a position stored before an option existed can be resumed.
        chosen = {"every": self.every > 1, "labels": self.labels is not None, "families": self.families}
        chosen["at_start"] = self.at_start > 0
        return super().options() | {name: getattr(self, name) for name, differs in chosen.items() if differs}

    @cached_property
    def specs(self) -> dict[str, ArraySpec]:
        shape = self.local_size, self.length
        return {
            "obs": self._observer.spec(*shape),
            "prev_actions": ArraySpec("int32", shape),
            "prev_rewards": ArraySpec("float32", shape),
            "target_actions": ArraySpec("int64", shape),
            "dones": ArraySpec("bool", shape),
            "attention_mask": ArraySpec("bool", shape),
            **({"prev_teammate_actions": ArraySpec("int32", shape)} if self.teammate_actions else {}),
            **self._layout_specs(),
            "is_first": ArraySpec("bool", shape),
            **({"families": ArraySpec("int32", (self.local_size,))} if self.families else {}),
        }

    @cached_property
    def _family_numbers(self) -> np.ndarray:
        """Position of each history's teammate family in `all_families()`, int32 (H,)."""
        families = all_families()
        return np.array([families.index(str(name)) for name in self.dataset.column("teammate_family")], np.int32)

    def windows(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the history ids and the first steps of the windows of batch i, int64 (B,) each."""
        position, starts, *_ = self._draw(i)
        return self.dataset.ids[position].astype(np.int64), starts

    def _draw(self, i: int) -> tuple[np.ndarray, ...]:
        """Draw the windows of batch i.

        Returns:
            int64 (B,), position of each window's history in the selection.
            int64 (B,), first step of each window.
            The rows to read as in `ReadRequest`: first steps, int64 (B,), or all steps, int64 (B, L).
            The step before each of these rows; -1 before the first step of a history.
            int64 (B,), number of steps of each window before padding.
        """
        for_history, for_start, for_episode = self._random(i, 3)
        low, high = self._draws.steps(i)
        position = weighted_choice(for_history, self._draws.history_weights(low, high), 0, len(low))
        low, high, steps = low[position], high[position], self._draws.kept_steps
        # A window is drawn from the `total` steps of every n-th episode of a history's range, or without `every` from
        # all steps of the range. With `every`, an unfinished episode is excluded: its missing steps would be a gap.
        first, total = np.zeros_like(low), high - low
        lowest, size = np.uint64(self.at_start * 2**32), np.uint64(2**32)
        begins = for_start < lowest
        if self.every > 1:
            episodes = total // steps
            first = np.where(begins, 0, scale_to_range(for_episode, np.minimum(episodes, self.every)))
            total = -(-(episodes - first) // self.every) * steps
        # The lowest random numbers, a share of `at_start`, mean the first step; the others are scaled to all numbers.
        scaled = (for_start - lowest) * size // max(size - lowest, np.uint64(1))
        start = np.where(begins, 0, scale_to_range(scaled, np.maximum(total - self.length, 0) + 1))
        valid = np.minimum(total - start, self.length)
        if self.every == 1:
            # A window given by its first row is copied as a block, ten times faster than L single rows.
            return position, low + start, low + start, low + start - 1, valid
        # `t` counts only steps of every n-th episode: t means step t % steps of episode first + n * (t // steps).
        # The step before the window comes first, for `prev_*`. Padding repeats the last step.
        t = np.minimum(start[:, None] + np.arange(-1, self.length), total[:, None] - 1)
        rows = low[:, None] + (first[:, None] + self.every * (t // steps)) * steps + t % steps
        # At the first step of episode `first`, `prev_*` come from the history's preceding episode, if there is one.
        rows[start == 0, 0] = (low + first * steps - 1)[start == 0]
        return position, rows[:, 1], rows[:, 1:], rows[:, :-1], valid

    def batch(self, i: int, out: ADBatch[np.ndarray] | None = None) -> ADBatch[np.ndarray]:
        batch = self._buffer(out)  # first, so that a batch that is too large raises an error at once
        position, starts, rows, previous, valid = self._draw(i)
        if self.every > 1:
            previous = np.maximum(previous, 0)  # sources accept -1 as first row of a window, not as a single row

        records = self._observer.records(batch.obs)
        targets = "actions" if self.labels is None else f"{self.labels}_actions"
        reads = [
            ReadRequest(self._observer.field, position, rows, records),
            ReadRequest(targets, position, rows, batch.target_actions),
            ReadRequest("dones", position, rows, batch.dones),
            ReadRequest("actions", position, previous, batch.prev_actions),
            ReadRequest("rewards", position, previous, batch.prev_rewards),
        ]
        if batch.prev_teammate_actions is not None:
            reads.append(ReadRequest("teammate_actions", position, previous, batch.prev_teammate_actions))
        self.dataset.storage.read(reads)

        self._observer.observe(position, records, batch.obs)
        if batch.layouts is not None:
            batch.layouts[...] = self.dataset.layout_numbers[position]
        if batch.families is not None:
            batch.families[...] = self._family_numbers[position]
        at_start = starts == 0
        batch.is_first[...] = False
        batch.is_first[:, 0] = at_start
        for read in reads[3:]:  # the `prev_*` fields
            read.out[at_start, 0] = 0
        batch.attention_mask[...] = True
        if valid.min() < self.length:
            np.less(np.arange(self.length), valid[:, None], out=batch.attention_mask)
            # Padding contains steps of later episodes, or observations rendered from zeros, and is set to zero here.
            for array in (batch.obs, *(read.out for read in reads[1:])):
                array[~batch.attention_mask] = 0
        return batch
