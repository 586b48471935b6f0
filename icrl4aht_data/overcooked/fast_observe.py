"""Fast rendering of the ego's observations from state records, with NumPy, into reusable buffers.

The function `observe` defines the observations, for NumPy and JAX. This module calls `observe` once for every value of
each record element and stores the results in lookup tables. An observation is then a copy of a background, selected by
the ego's cell, the recipe and the delivery flag, and of small patches: both agents by facing and item, and the contents
of counters, pots and lit buttons.

`n` denotes the number of steps, `S` the bytes of a state record, `A` the channels of one agent, `C` all channels.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.cells import CENTRE, NOWHERE, VISIBLE
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.state import columns, possible_recipes, record_size
from icrl4aht_data.utils.system import run_in_slices

_SLAB = 8192  # steps rendered at a time; in smaller blocks, function calls cost more time than the CPU cache saves
_IMPOSSIBLE = -(2**40)  # table entry so low that its sum with any other entry is negative
_TIMERS = 32  # number of values of a five-bit timer
_ON_COUNTER, _ON_BUTTON, _IN_POT = 0, 256, 512
"""Number of the first patch of each kind of cell. Patch b shows item byte b on a counter, patch 256 + b a lit button
with recipe byte b, and patch 512 + 256 * t + b a pot with item byte b and timer t."""


def fast_observe(
    layout: Layout, record: np.ndarray, out: np.ndarray, threads: int = 1, canonical: bool = False
) -> np.ndarray:
    """Render the ego's observations into the array `out`, and return `out`.

    Args:
        layout: layout of the state records.
        record: uint8 (..., S), state records.
        out: uint8 or float32 (..., 5, 5, C), C-contiguous.
        threads: number of threads that share the work.
        canonical: whether to render the canonical channels, see `channels`, instead of the layout's own.

    Returns:
        `out`, equal to `observe(layout, record, 0, canonical)`.

    Raises:
        ValueError: if `out` is not C-contiguous.
    """
    if not out.flags.c_contiguous:
        raise ValueError("out is not C-contiguous; pass np.ascontiguousarray(out)")
    records = record.reshape(-1, record.shape[-1])
    flat = out.reshape(len(records), VISIBLE, observation_shape(layout, canonical)[-1])
    renderer = _renderer(layout, out.dtype.str, canonical)

    def render_slice(start: int, stop: int) -> None:
        for first in range(start, stop, _SLAB):
            last = min(first + _SLAB, stop)
            renderer.render(records[first:last], flat[first:last])

    run_in_slices(render_slice, len(records), threads, least=_SLAB)
    return out


class _Renderer:
    """Renders observations from state records with lookup tables, for one layout, dtype and choice of channels."""

    def __init__(self, layout: Layout, dtype: str, canonical: bool) -> None:
        self._layout, self._dtype, self._canonical = layout, np.dtype(dtype), canonical
        self._shape = observation_shape(layout, canonical)
        self._columns = columns(layout)
        fixed = fixed_channels(layout, canonical)
        self._agent: int = fixed.start // 2  # number A of one agent's channels; the channels of both agents come first
        self._first: int = fixed.stop  # index of the first channel after these: items, recipes and timers
        self._floor = np.flatnonzero(layout.walkable).astype(np.uint8)
        self._recipes = np.append(np.uint8(0), possible_recipes(layout))
        self._in_window = layout.window_position.astype(np.intp)
        self._background = self._make_background()
        self._agents = _as_items(self._make_agent_channels())
        self._patches = _as_items(self._make_patches())
        self._make_pair_lookups()
        self._make_cell_lookups()

    def render(self, record: np.ndarray, out: np.ndarray) -> None:
        """Render state records uint8 (n, S) into `out` (n, 25, C)."""
        # The first eight columns are read as pairs of bytes, with the ego's byte as the low one: for the ego on cell 17
        # and the teammate on cell 20, `positions` is 17 + 20 * 256 = 5137. A pair needs one lookup instead of two.
        positions, facings, hands, recipe = record[:, :8].copy().view("<u2").T.astype(np.intp)
        background = self._by_positions.take(positions)
        background += self._by_recipe.take(recipe)
        if background.min() < 0 or (facings & 0xFCFC).any() or (record[:, self._columns.pot_timers] >= _TIMERS).any():
            # A record that the rules cannot produce has no table entries. `observe` then renders all given records.
            out.reshape(len(out), *self._shape)[...] = self._observe(record)
            return
        # mode="clip" avoids the temporary copy of `out` that the default mode makes in case an index is out of range.
        np.take(self._background, background, axis=0, out=out.reshape(len(out), -1), mode="clip")
        cells = out.reshape(-1, self._shape[-1])
        self._render_agents(positions, facings, hands, cells)
        self._render_cells(record, positions, cells)

    def _observe(self, record: np.ndarray) -> np.ndarray:
        return observe(self._layout, record, EGO, self._canonical)

    def _render_agents(self, positions: np.ndarray, facings: np.ndarray, hands: np.ndarray, cells: np.ndarray) -> None:
        ego = _as_items(cells[:, : self._agent])
        # The row of an agent's channels in the lookup table is facing * 256 + item byte.
        ego[CENTRE::VISIBLE] = self._agents.take(((facings & 255) << 8) + (hands & 255))
        where = self._teammate_in_window.take(positions)
        seen = np.flatnonzero(where != NOWHERE)
        teammate = _as_items(cells[:, self._agent : 2 * self._agent])
        teammate[seen * VISIBLE + where[seen]] = self._agents.take((facings[seen] & 0xFF00) + (hands[seen] >> 8))

    def _render_cells(self, record: np.ndarray, positions: np.ndarray, cells: np.ndarray) -> None:
        """Render visible cells that differ from the background: filled pots, lit buttons, and counters with an item."""
        filled = record[:, self._cell_columns].copy()
        filled[:, : self._pots] |= record[:, self._columns.pot_timers]
        row, cell = np.divmod(np.flatnonzero(filled), filled.shape[1])
        where = self._cell_in_window.take((positions[row] & 255) * filled.shape[1] + cell)
        seen = np.flatnonzero(where != NOWHERE)
        row, cell, where = row[seen], cell[seen], where[seen]
        flat, start = np.ascontiguousarray(record).reshape(-1), row * record.shape[1]
        # Row 512 + 8 of `_patches` shows a pot with item byte 8 (two pieces of ingredient 0) and timer 0; row
        # 512 + 19 * 256 + 12 shows a cooking pot with item byte 12 and timer 19. The row is copied to the pot's cell.
        patch = self._first_patch.take(cell) + flat.take(start + self._patch_column.take(cell))
        pots = np.flatnonzero(cell < self._pots)
        timers = flat.take(start[pots] + self._columns.pot_timers.start + cell[pots]).astype(np.intp)
        patch[pots] += timers * 256
        _as_items(cells[:, self._first :])[row * VISIBLE + where] = self._patches.take(patch)

    def _make_pair_lookups(self) -> None:
        """Make lookup tables with one entry for each pair of bytes, at index low byte + 256 * high byte.

        The background row of a state is its entry of `_by_positions` plus its entry of `_by_recipe`. An entry is
        negative if the background has no row for the pair.
        """
        low, high = np.arange(2**16) & 255, np.arange(2**16) >> 8
        cells = self._layout.cells
        on_map = np.maximum(low, high) < cells
        self._by_positions = np.where(on_map, _index_of(self._floor)[low] * 2 * len(self._recipes), _IMPOSSIBLE)
        self._by_recipe = np.where(high < 2, _index_of(self._recipes)[low] * 2 + high, _IMPOSSIBLE)
        self._teammate_in_window = np.where(on_map, self._in_window[low % cells, high % cells], NOWHERE)

    def _make_cell_lookups(self) -> None:
        """Make lookup tables of the cells that can change: first the pots, then the buttons, then the counters."""
        layout, where = self._layout, self._columns
        pots, buttons, counters = map(len, (layout.pots, layout.buttons, layout.counters))
        self._pots = pots
        self._cell_columns = np.r_[where.pot_items, where.buttons, where.counters]
        self._cell_in_window = self._in_window[:, [*layout.pots, *layout.buttons, *layout.counters]].reshape(-1)
        self._first_patch = np.repeat([_IN_POT, _ON_BUTTON, _ON_COUNTER], (pots, buttons, counters))
        # What a lit button shows depends on the recipe, not on the button's remaining time.
        self._patch_column = np.where(self._first_patch == _ON_BUTTON, where.recipe, self._cell_columns)

    def _make_background(self) -> np.ndarray:
        """Return observations of the empty map, an array of shape (floor cells * recipes * 2, 25 * C).

        The rows are ordered by ego cell, then by recipe, then by delivery flag.
        """
        shape = len(self._floor), len(self._recipes), 2
        record = np.zeros((*shape, record_size(self._layout)), np.uint8)
        record[..., 0], record[..., self._columns.recipe] = self._floor[:, None, None], self._recipes[:, None]
        record[..., 1, self._columns.delivered] = 1
        obs = self._observe(record)
        obs[..., : 2 * self._agent] = 0
        return obs.reshape(np.prod(shape), -1).astype(self._dtype)

    def _make_agent_channels(self) -> np.ndarray:
        """Return one agent's channels, of shape (4 * 256, A), with row facing * 256 + item byte."""
        record = np.zeros((4, 256, record_size(self._layout)), np.uint8)
        record[..., 0], record[..., 1] = self._floor[0], self._floor[-1]
        record[..., self._columns.facings] = np.arange(4)[:, None, None]
        record[..., self._columns.hands] = np.arange(256)[:, None]
        obs = self._observe(record).reshape(4 * 256, VISIBLE, -1)
        return obs[:, CENTRE, : self._agent].astype(self._dtype)

    def _make_patches(self) -> np.ndarray:
        """Return the channels from `_first` on of a cell for each content, of shape (512 + 32 * 256, C - `_first`).

        These channels show items, recipes and timers. Rows 0..255 show each item byte on a counter, rows 256..511 a lit
        button with each recipe byte, and row 512 + 256 * t + b a pot with item byte b and timer t.
        """
        layout, where = self._layout, self._columns
        every_byte = np.arange(256, dtype=np.uint8)
        record = np.zeros((2 + _TIMERS, 256, record_size(layout)), np.uint8)
        record[0, :, where.counters] = every_byte[:, None]
        record[1, :, where.buttons], record[1, :, where.recipe] = 1, every_byte
        record[2:, :, where.pot_items] = every_byte[:, None]
        record[2:, :, where.pot_timers] = np.arange(_TIMERS)[:, None, None]
        patches = np.zeros((*record.shape[:2], self._shape[-1] - self._first), self._dtype)
        kinds = (slice(0, 1), layout.counters), (slice(1, 2), layout.buttons), (slice(2, None), layout.pots)
        for rows, cells in kinds:
            # A cell looks the same from wherever the ego sees it, so one view of each kind of cell is enough.
            views = [(ego, cell) for cell in cells for ego in self._floor if self._in_window[ego, cell] != NOWHERE]
            if views:
                record[rows, :, 0] = views[0][0]
                obs = self._observe(record[rows]).reshape(-1, 256, VISIBLE, self._shape[-1])
                patches[rows] = obs[:, :, self._in_window[views[0]], self._first :]
        return patches.reshape(-1, patches.shape[-1])


def _as_items(rows: np.ndarray) -> np.ndarray:
    """View an array of shape (n, k) as n items, one for each row, since NumPy copies an item in one operation."""
    return rows.view(np.dtype((np.void, rows.shape[-1] * rows.itemsize)))[..., 0]


def _index_of(values: np.ndarray) -> np.ndarray:
    """Return an array of shape (256,) with each byte's position in `values`; `_IMPOSSIBLE` for all other bytes."""
    lookup = np.full(256, _IMPOSSIBLE, np.intp)
    lookup[values] = np.arange(len(values))
    return lookup


# The cache is limited, since a renderer takes up to 4 MB and a release can have hundreds of layouts.
_renderer = lru_cache(maxsize=256)(_Renderer)
