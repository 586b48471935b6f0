"""Samplers whose batches number the layouts of the complete training data, and may mirror histories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from icrl4aht_baselines.methods.view_change import mirrored_action
from icrl4aht_data.overcooked.layouts import Layout


class NumberedBatches:
    """A sampler's batches of state records, with other numbers of the layouts, perhaps mirrored at random.

    Args:
        sampler: of histories on some of the layouts.
        numbers: int32, new number of each layout of `sampler.layouts`.
        layouts: number of all layouts, to mirror each row at random, see `view_change.changed_view`; 0 mirrors none.
    """

    def __init__(self, sampler: Any, numbers: np.ndarray, layouts: int = 0) -> None:
        self._sampler, self._numbers, self._layouts = sampler, numbers, layouts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sampler, name)

    def __getitem__(self, i: int) -> Any:
        return self.batch(i)

    def batch(self, i: int, out: Any = None) -> Any:
        """Return batch i, written into `out` if it is given."""
        batch = self._sampler.batch(i, out)
        rows = len(batch.obs if hasattr(batch, "obs") else batch.query_obs)
        # A sampler of one layout does not number it.
        numbers = self._numbers[np.zeros(rows, np.int32) if batch.layouts is None else batch.layouts]
        if not self._layouts:
            return batch._replace(layouts=numbers)
        # The mirroring is a function of the batch's number and process, as the batch itself is.
        drawn = np.random.default_rng((self._sampler.seed, i, self._sampler.process_index))
        mirroring = drawn.integers(4, size=rows, dtype=np.int32)
        actions = {
            name: mirrored_action(values, mirroring)
            for name, values in batch._asdict().items()
            if values is not None and (name.endswith("actions") or name == "query_target")
        }
        if hasattr(batch, "is_first"):  # no step precedes: the fillers stay 0, as they are when a model acts
            filler = batch.is_first | ~batch.attention_mask
            actions |= {name: np.where(filler, 0, actions[name]) for name in actions if name.startswith("prev_")}
        return batch._replace(**actions, layouts=numbers + self._layouts * mirroring)


def number_layouts(sampler: Any, layouts: Sequence[Layout], mirror: bool = False) -> Any:
    """Return the sampler with its layouts numbered as in `layouts`; its histories may be on some of these only."""
    numbers = np.array([layouts.index(layout) for layout in sampler.layouts], np.int32)
    if mirror:
        return NumberedBatches(sampler, numbers, len(layouts))
    agree = sampler.dataset.obs != "state" or numbers.tolist() == list(range(len(layouts)))
    return sampler if agree else NumberedBatches(sampler, numbers)
