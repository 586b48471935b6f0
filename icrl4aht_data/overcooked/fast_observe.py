"""State records -> the ego's observations at the speed of memory, for NumPy, into buffers that may be reused.

`observe` says what an observation is, for NumPy and JAX alike. Here its answers for one thing at a time become tables:
what stands still and what a recipe or a delivery shows, by position; an agent, by facing and item; what lies on a
counter, cooks in a pot or glows on a button. A step is then one copy of a background and a few small patches.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import CENTRE, NOWHERE, VISIBLE, Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.state import columns, record_size
from icrl4aht_data.utils.threads import in_slices

_SLAB = 8192  # steps painted at a time: fewer cost more in calls than they save in cache misses
_IMPOSSIBLE = -(2**40)
_TIMERS = 32  # what a timer's five bits hold


def fast_observe(layout: Layout, record: np.ndarray, out: np.ndarray, threads: int = 1) -> np.ndarray:
    """Write the ego's observations into `out`.

    Args:
        layout: the kitchen.
        record: uint8 (..., S), state records.
        out: uint8 or float32 (..., 5, 5, C), C-contiguous.
        threads: how many share the work.

    Returns:
        `out`, equal to `observe(layout, record, 0)`.
    """
    if not out.flags.c_contiguous:
        raise ValueError("expected out to be C-contiguous")
    records = record.reshape(-1, record.shape[-1])
    flat = out.reshape(len(records), VISIBLE, layout.channels)
    renderer = _renderer(layout, out.dtype.str)

    def part(start: int, stop: int) -> None:
        for first in range(start, stop, _SLAB):
            last = min(first + _SLAB, stop)
            renderer.render(records[first:last], flat[first:last])

    in_slices(part, len(records), threads, least=_SLAB)
    return out


class _Renderer:
    """The tables of one layout and dtype."""

    def __init__(self, layout: Layout, dtype: str) -> None:
        self._layout, self._dtype = layout, np.dtype(dtype)
        self._columns = columns(layout)
        fixed = fixed_channels(layout)
        self._agent: int = fixed.start // 2  # channels of one agent: two agents come before what is fixed
        self._first: int = fixed.stop  # of the channels of what changes on a cell
        self._floor = np.flatnonzero(layout.walkable).astype(np.uint8)
        self._recipes = np.unique(np.array([0, *layout.recipe_items], np.uint8))
        self._relative = layout.window_position.astype(np.intp)
        self._background = self._make_background()
        self._bodies = _as_items(self._make_bodies())
        self._patches = _as_items(self._make_patches())
        self._make_lookups()

    def render(self, record: np.ndarray, out: np.ndarray) -> None:
        """uint8 (n, S) -> (n, 25, C), in place."""
        # The first eight columns as pairs of bytes: positions, facings, hands, recipe and delivery.
        pairs = record[:, :8].copy().view("<u2").T.astype(np.intp)
        positions, facings, hands, recipe = pairs
        scene = self._scene.take(positions)
        scene += self._recipe.take(recipe)
        if scene.min() < 0 or (facings & 0xFCFC).any() or (record[:, self._timers] >= _TIMERS).any():
            out.reshape(len(out), *self._layout.obs_shape)[...] = observe(self._layout, record, EGO)
            return  # not a record that the rules make
        np.take(self._background, scene, axis=0, out=out.reshape(len(out), -1), mode="clip")
        cells = out.reshape(-1, self._layout.channels)
        self._paint_agents(positions, facings, hands, cells)
        self._paint_things(record, positions, cells)

    def _paint_agents(self, positions: np.ndarray, facings: np.ndarray, hands: np.ndarray, cells: np.ndarray) -> None:
        mine = _as_items(cells[:, : self._agent])
        mine[CENTRE::VISIBLE] = self._bodies.take(((facings & 255) << 8) + (hands & 255))
        place = self._place.take(positions)
        seen = np.flatnonzero(place != NOWHERE)
        theirs = _as_items(cells[:, self._agent : 2 * self._agent])
        theirs[seen * VISIBLE + place[seen]] = self._bodies.take((facings[seen] & 0xFF00) + (hands[seen] >> 8))

    def _paint_things(self, record: np.ndarray, positions: np.ndarray, cells: np.ndarray) -> None:
        """What lies on counters, glows on buttons and is in pots, where there is anything and it is in view."""
        there = record[:, self._thing].copy()
        there[:, self._pots] |= record[:, self._timers]
        row, thing = np.divmod(np.flatnonzero(there), there.shape[1])
        place = self._places.take((positions[row] & 255) * there.shape[1] + thing)
        seen = np.flatnonzero(place != NOWHERE)
        row, thing, place = row[seen], thing[seen], place[seen]
        flat, start = np.ascontiguousarray(record).reshape(-1), row * record.shape[1]
        patch = self._kind.take(thing) + flat.take(start + self._low.take(thing))
        pots = np.flatnonzero(self._is_pot.take(thing))
        patch[pots] += flat.take(start[pots] + self._high.take(thing[pots])).astype(np.intp) << 8
        _as_items(cells[:, self._first :])[row * VISIBLE + place] = self._patches.take(patch)

    def _make_lookups(self) -> None:
        """Tables by a pair of bytes, negative for one that the rules do not make; and what each thing's patch is."""
        layout, where = self._layout, self._columns
        low, high = np.arange(2**16) & 255, np.arange(2**16) >> 8
        inside = np.maximum(low, high) < layout.cells
        seat = _lookup(self._floor)[low] * 2 * len(self._recipes)
        self._scene = np.where(inside, seat, _IMPOSSIBLE)
        self._recipe = np.where(high < 2, _lookup(self._recipes)[low] * 2 + high, _IMPOSSIBLE)
        self._place = np.where(inside, self._relative[low % layout.cells, high % layout.cells], NOWHERE)

        pots, buttons, counters = (len(cells) for cells in (layout.pots, layout.buttons, layout.counters))
        self._thing = np.r_[where.pot_items, where.buttons, where.counters]
        self._pots, self._timers = slice(0, pots), where.pot_timers
        self._places = self._relative[:, [*layout.pots, *layout.buttons, *layout.counters]].reshape(-1)
        self._kind = np.repeat([512, 256, 0], (pots, buttons, counters))
        self._low = np.concatenate([self._thing[:pots], np.full(buttons, where.recipe), self._thing[pots + buttons :]])
        self._high = self._low + pots
        self._is_pot = np.arange(len(self._thing)) < pots

    def _make_background(self) -> np.ndarray:
        """(floor * recipes * 2, 25 * C): everything but agents and items, by position, recipe and delivery."""
        shape = (len(self._floor), len(self._recipes), 2)
        record = np.zeros((*shape, record_size(self._layout)), np.uint8)
        record[..., 0], record[..., self._columns.recipe] = self._floor[:, None, None], self._recipes[:, None]
        record[..., 1, self._columns.delivered] = 1
        obs = observe(self._layout, record, EGO)
        obs[..., : 2 * self._agent] = 0
        return obs.reshape(np.prod(shape), -1).astype(self._dtype)

    def _make_bodies(self) -> np.ndarray:
        """(4 * 256, A): an agent's channels by facing and hand."""
        record = np.zeros((4, 256, record_size(self._layout)), np.uint8)
        record[..., 0], record[..., 1] = self._floor[0], self._floor[-1]
        record[..., self._columns.facings] = np.arange(4)[:, None, None]
        record[..., self._columns.hands] = np.arange(256)[:, None]
        obs = observe(self._layout, record, EGO).reshape(4 * 256, VISIBLE, -1)
        return obs[:, CENTRE, : self._agent].astype(self._dtype)

    def _make_patches(self) -> np.ndarray:
        """(512 + 32 * 256, C - first): what changes on a cell, by counter item, by glowing recipe, by pot content."""
        layout, where = self._layout, self._columns
        anything = np.arange(256, dtype=np.uint8)
        record = np.zeros((2 + _TIMERS, 256, record_size(layout)), np.uint8)
        record[0, :, where.counters] = anything[:, None]
        record[1, :, where.buttons], record[1, :, where.recipe] = 1, anything
        record[2:, :, where.pot_items] = anything[:, None]
        record[2:, :, where.pot_timers] = np.arange(_TIMERS)[:, None, None]
        kinds = ((slice(0, 1), layout.counters), (slice(1, 2), layout.buttons), (slice(2, None), layout.pots))
        table = np.zeros((*record.shape[:2], layout.channels - self._first), self._dtype)
        for rows, cells in kinds:
            for cell in cells:
                seats = [seat for seat in self._floor if self._relative[seat, cell] != NOWHERE]
                if seats:
                    record[rows, :, 0] = seats[0]
                    obs = observe(layout, record[rows], EGO).reshape(-1, 256, VISIBLE, layout.channels)
                    table[rows] = obs[:, :, self._relative[seats[0], cell], self._first :]
                    break
        return table.reshape(-1, table.shape[-1])


def _as_items(rows: np.ndarray) -> np.ndarray:
    """(n, k) -> (n,): a row as one opaque item, so that NumPy copies it whole."""
    return rows.view(np.dtype((np.void, rows.shape[-1] * rows.itemsize)))[..., 0]


def _lookup(values: np.ndarray) -> np.ndarray:
    """intp (256,): the place of a byte among the values, or a large negative number."""
    table = np.full(256, _IMPOSSIBLE, np.intp)
    table[values] = np.arange(len(values))
    return table


@lru_cache(maxsize=64)
def _renderer(layout: Layout, dtype: str) -> _Renderer:
    return _Renderer(layout, dtype)
