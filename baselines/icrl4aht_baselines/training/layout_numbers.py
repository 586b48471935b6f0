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
        layouts: all layouts.
        mirror: whether to mirror each row at random.
        rename: whether to rename the ingredients of each row's layout at random.
    """

    def __init__(
        self, sampler: Any, numbers: np.ndarray, layouts: Sequence[Layout], mirror: bool = False, rename: bool = False
    ) -> None:
        self._sampler, self._numbers, self._layouts = sampler, numbers, len(layouts)
        self._mirrorings = MIRRORINGS if mirror else 1
        self._namings = np.array([factorial(layout.ingredient_types) if rename else 1 for layout in layouts])

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
        if self._mirrorings == self._namings.max() == 1:
            return batch._replace(layouts=numbers)
        # The change is a function of the batch's number and process, as the batch itself is.
        drawn = np.random.default_rng((self._sampler.seed, i, self._sampler.process_index))
        mirroring = drawn.integers(self._mirrorings, size=rows, dtype=np.int32)
        naming = drawn.integers(self._namings[numbers], dtype=np.int32)
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
    agree = sampler.dataset.obs != "state" or numbers.tolist() == list(range(len(layouts)))
    changed = mirror or rename
    return NumberedBatches(sampler, numbers, layouts, mirror, rename) if changed or not agree else sampler
