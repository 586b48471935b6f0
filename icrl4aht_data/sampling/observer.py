"""Rendering of stored records as observations, in the form of a selection's option `obs`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrl4aht_data.format.schema import record_field
from icrl4aht_data.overcooked.channels import canonical_positions
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.reading.selection import Selection

_STEPS = 8192  # number of steps that a thread renders at once with several layouts; limits temporary memory


class ArraySpec(NamedTuple):
    """Declared dtype and shape of an array of a batch.

    Attributes:
        dtype: name of the dtype, such as "float32".
        shape: shape of the array.
    """

    dtype: str
    shape: tuple[int, ...]


class Observer:
    """Renders the stored records of a selection as observations.

    A record is a state record, or in a release without states the stored observation. `R` denotes the shape of one
    record: (S,) with the longest state record of the selection, or (5, 5, C) with the most channels of its layouts.

    Args:
        selection: histories whose observations have one shape (5, 5, C).

    Attributes:
        field: name of the field that stores the records.

    Raises:
        OptionError: if observations have several shapes.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection, self._layouts = selection, selection.layouts
        self._shape = selection.obs_shape
        self._canonical = selection.channels == "canonical"
        self.field = record_field(selection.info.kind).name
        self._record_shape: tuple[int, ...] = (max(record_size(layout) for layout in self._layouts),)
        if not selection.has_states:
            self._record_shape = (*self._shape[:-1], max(layout.channels for layout in self._layouts))
        # If nothing is rendered, records are read directly into the batch.
        self._renders = selection.obs != "state" and (selection.has_states or self._canonical)

    def spec(self, *shape: int) -> ArraySpec:
        """Return dtype and shape of observations (*shape, 5, 5, C), or of state records (*shape, S) if obs="state"."""
        if self._selection.obs == "state":
            return ArraySpec("uint8", (*shape, *self._record_shape))
        return ArraySpec(self._selection.obs, (*shape, *self._shape))

    def records(self, out: np.ndarray) -> np.ndarray:
        """Return an array to read records into, uint8 (..., *R); `out` itself if nothing has to be rendered."""
        return np.empty((*out.shape[:-3], *self._record_shape), np.uint8) if self._renders else out

    def observe(self, histories: np.ndarray, records: np.ndarray, out: np.ndarray) -> None:
        """Write the egos' observations to `out`; do nothing if the records were read directly into `out`.

        Args:
            histories: int (B,), positions in the selection.
            records: uint8 (B, ..., *R), the array that the method `records` returned, now filled with records.
            out: (B, ..., 5, 5, C), float32 or uint8, C-contiguous.
        """
        threads = self._selection.threads
        if not self._renders:
            return
        if len(self._layouts) == 1 and self._selection.has_states:
            fast_observe(self._layouts[0], records, out, threads, self._canonical)
            return
        slab = max(1, threads * _STEPS // math.prod(out.shape[1:-3]))
        # Layouts differ in their channels, so the rows of each layout are rendered separately and then copied.
        numbers = self._selection.layout_numbers[histories]
        for number in np.unique(numbers).tolist():
            layout, rows = self._layouts[number], np.flatnonzero(numbers == number)
            for first in range(0, len(rows), slab):
                part = rows[first : first + slab]
                shown, own = np.zeros((len(part), *out.shape[1:]), out.dtype), records[part]
                if self._selection.has_states:
                    fast_observe(layout, own[..., : record_size(layout)], shown, threads, self._canonical)
                else:
                    shown[..., canonical_positions(layout)] = own[..., : layout.channels]
                out[part] = shown
