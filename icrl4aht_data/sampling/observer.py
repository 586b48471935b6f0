"""Rendering of records as the observations that the `obs` option of a selection names."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import record_field
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.utils.threads import in_slices

_STEPS = 8192  # steps of several layouts rendered at a time, so that the copies in between stay small


class ArraySpec(NamedTuple):
    """Declared dtype and shape of an array of a batch.

    Attributes:
        dtype: name of the dtype, such as "float32".
        shape: shape of the array.
    """

    dtype: str
    shape: tuple[int, ...]


class Observer:
    """Renders records of a selection.

    A record is a state record, or in a release without states the observation itself. `S` denotes the bytes of the
    selection's longest state record.

    Args:
        selection: histories whose layouts have observations of one shape (5, 5, C).

    Attributes:
        field: the field that stores records.

    Raises:
        OptionError: if observations have several shapes.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection, self._layouts = selection, selection.layouts
        if len({layout.obs_shape for layout in self._layouts}) > 1:
            raise OptionError(
                f"the selection spans layouts {', '.join(layout.name for layout in self._layouts)} with observations "
                f"of unequal shape, a sampler takes one shape: add layout={self._layouts[0].name!r}"
            )
        self.field = record_field(selection.info.kind).name
        self._renders = selection.has_states and selection.obs != "state"
        self._size = max(record_size(layout) for layout in self._layouts)

    def spec(self, *shape: int) -> ArraySpec:
        """dtype and shape of observations (*shape, 5, 5, C), or of state records (*shape, S) with obs="state"."""
        if self._selection.obs == "state":
            return ArraySpec("uint8", (*shape, self._size))
        return ArraySpec(self._selection.obs, (*shape, *self._layouts[0].obs_shape))

    def record_bytes(self, shape: tuple[int, ...]) -> int:
        """Bytes of the array that `records` makes for observations of this shape (..., 5, 5, C)."""
        return math.prod(shape[:-3]) * self._size if self._renders else 0

    def records(self, out: np.ndarray) -> np.ndarray:
        """The array to read the records of observations `out` into: uint8 (..., S), or `out` if nothing is rendered."""
        return np.empty((*out.shape[:-3], self._size), np.uint8) if self._renders else out

    def observe(self, histories: np.ndarray, records: np.ndarray, out: np.ndarray) -> None:
        """Render the observations of egos, unless the records were read into `out` directly.

        Args:
            histories: int (B,), positions in the selection.
            records: the array from `records`, filled: uint8 (B, ..., S).
            out: (B, ..., 5, 5, C), float32 or uint8, C-contiguous.
        """
        threads = self._selection.threads
        if not self._renders:
            return
        if len(self._layouts) == 1:
            fast_observe(self._layouts[0], records, out, threads)
            return
        steps_a_row = records[0].size // self._size
        slab = max(1, _STEPS // steps_a_row)
        numbers = self._selection.layout_numbers[histories]
        for number in np.unique(numbers).tolist():
            layout, rows = self._layouts[number], np.flatnonzero(numbers == number)

            def render(start: int, stop: int, layout=layout, rows=rows) -> None:
                for first in range(start, stop, slab):
                    part = rows[first : min(first + slab, stop)]
                    shown = records[part, ..., : record_size(layout)]
                    out[part] = fast_observe(layout, shown, np.empty((len(part), *out.shape[1:]), out.dtype))

            in_slices(render, len(rows), threads, least=slab)
