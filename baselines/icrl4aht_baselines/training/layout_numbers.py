"""Samplers whose batches number the layouts of the complete training data, and may change what is seen."""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import Any

import numpy as np

from icrl4aht_baselines.methods.view_change import MIRRORINGS, mirrored_action
from icrl4aht_data.overcooked.layouts import Layout


class NumberedBatches:
    """A sampler's batches of state records, with other numbers of the layouts, perhaps changed at random.

    `view_change.changed_view` has the changes.

    Args:
        sampler: of histories on some of the layouts.
        numbers: int32, new number of each layout of `sampler.layouts`.
        layouts: number of all layouts.
        mirrorings, namings: each row has one of the first so many of them; with 1 it is not changed.
    """

    def __init__(
        self, sampler: Any, numbers: np.ndarray, layouts: int = 1, mirrorings: int = 1, namings: int = 1
    ) -> None:
        self._sampler, self._numbers, self._layouts = sampler, numbers, layouts
        self._mirrorings, self._namings = mirrorings, namings

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
        if self._mirrorings == self._namings == 1:
            return batch._replace(layouts=numbers)
        # The change is a function of the batch's number and process, as the batch itself is.
        drawn = np.random.default_rng((self._sampler.seed, i, self._sampler.process_index))
        mirroring = drawn.integers(self._mirrorings, size=rows, dtype=np.int32)
        naming = drawn.integers(self._namings, size=rows, dtype=np.int32)
        actions = {
            name: mirrored_action(values, mirroring)
            for name, values in batch._asdict().items()
            if values is not None and (name.endswith("actions") or name == "query_target")
        }
        if hasattr(batch, "is_first"):  # no step precedes: the fillers stay 0, as they are when a model acts
            filler = batch.is_first | ~batch.attention_mask
            actions |= {name: np.where(filler, 0, actions[name]) for name in actions if name.startswith("prev_")}
        change = mirroring + MIRRORINGS * naming
        return batch._replace(**actions, layouts=numbers + self._layouts * change)


def number_layouts(sampler: Any, layouts: Sequence[Layout], mirror: bool = False, rename: bool = False) -> Any:
    """Return the sampler with its layouts numbered as in `layouts`; its histories may be on some of these only."""
    numbers = np.array([layouts.index(layout) for layout in sampler.layouts], np.int32)
    if mirror or rename:
        namings = factorial(max(layout.ingredient_types for layout in layouts))
        return NumberedBatches(sampler, numbers, len(layouts), MIRRORINGS if mirror else 1, namings if rename else 1)
    agree = sampler.dataset.obs != "state" or numbers.tolist() == list(range(len(layouts)))
    return sampler if agree else NumberedBatches(sampler, numbers)
