"""Words: one id for the content of each visible cell, computed from state records, for NumPy and JAX.

A *word* is the vector of observation channels of one visible cell. A layout has only a few hundred different words, so
a network can compute its per-cell layers once per word and read the results from a table. Several layouts share the
lookup tables, so one batch may mix layouts.

`B` denotes the batch dimensions, `S` the bytes of a state record, `V` the number of words, `C` channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.overcooked.cells import CENTRE, COOKED, FACINGS, GOAL, INDICATOR, NOWHERE, PLATE, VISIBLE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.rules import look_up
from icrl4aht_data.overcooked.state import (
    BUTTON_STEPS,
    POT_STEPS,
    Array,
    columns,
    ingredient_count,
    possible_items,
    record_size,
)

# The channels of a cell depend on its kind and two numbers of the state record: an item or recipe byte, and a timer,
# flag or facing. Lookup tables have an entry for every pair of numbers, so no record gives an index out of range.
_SECONDS = 32
_PAIRS = 256 * _SECONDS
_FIXED, _RECIPE, _GOAL, _POT, _BUTTON, _COUNTER, _SELF, _OTHER = range(8)


class _Slot(NamedTuple):
    """Two columns of the state record that determine the content of some cells, such as a pot's item and timer.

    Args:
        kind: number of the lookup table, such as `_POT`.
        cells: numbers of the cells that show the content.
        byte: column of the state record with the item or recipe byte.
        second: column of the state record with the timer, flag or facing; None if there is none.
    """

    kind: int
    cells: list[int]
    byte: int
    second: int | None = None


class CellWords:
    """Vocabulary of observations: a word is a possible state of a visible cell. `cell_words` caches instances.

    Attributes:
        layouts: layouts whose observations have the same channels.
        canonical: whether words show the canonical channels instead of the layouts' own.
        channels: uint8 (V + 1, C), observation channels of each word. The last row is 255 everywhere and stands for
            contents that the rules cannot produce.
    """

    def __init__(self, layouts: Sequence[Layout], canonical: bool = False) -> None:
        self.layouts, self.canonical = tuple(layouts), canonical
        fixed = [_fixed_cells(layout, canonical) for layout in layouts]
        contents = [_contents(layout, canonical) for layout in layouts]
        shown = fixed + [channels for kinds in contents for _, channels in kinds.values()]
        # `unique` sorts the rows, so word 0 has zeros only: empty floor and cells outside the map.
        words, numbers = np.unique(np.concatenate(shown), axis=0, return_inverse=True)
        self.channels = np.append(words, np.full_like(words[:1], 255), axis=0)
        parts = iter(np.split(numbers.reshape(-1).astype(np.int16), np.cumsum([len(rows) for rows in shown])[:-1]))
        self._size = max(map(record_size, layouts))
        self._fill_views([next(parts) for _ in layouts])
        self._words = np.full((len(layouts), _OTHER + 1, _PAIRS), len(words), np.int16)
        self._words[:, _FIXED] = 0
        for number, kinds in enumerate(contents):
            for kind, (pairs, _) in kinds.items():
                self._words[number, kind, pairs] = next(parts)

    def _fill_views(self, fixed: list[np.ndarray]) -> None:
        """Fill the lookup tables indexed by the observer's cell or by slot, see `_Slot`; slot 0 is for fixed cells."""
        count, cells = len(self.layouts), max(layout.cells for layout in self.layouts)
        slots = [[_Slot(_FIXED, [], 0), *_slots(layout)] for layout in self.layouts]
        self._slot = np.zeros((count, cells, VISIBLE), np.uint8)
        self._fixed = np.zeros((count, cells, VISIBLE), np.int16)
        self._window_position = np.full((count, cells, cells), NOWHERE, np.uint8)
        self._kind = np.zeros((count, max(map(len, slots))), np.int32)
        self._byte, self._second = np.zeros_like(self._kind), np.full_like(self._kind, self._size)
        for number, layout in enumerate(self.layouts):
            slot_of = np.zeros(layout.cells, np.uint8)
            for k, slot in enumerate(slots[number]):
                slot_of[slot.cells] = k
                self._kind[number, k], self._byte[number, k] = slot.kind, slot.byte
                if slot.second is not None:
                    self._second[number, k] = slot.second
            here = number, slice(layout.cells)
            self._slot[here] = np.where(layout.window >= 0, slot_of[layout.window], 0)
            self._fixed[here] = np.where(self._slot[here] == 0, fixed[number].reshape(-1, VISIBLE), 0)
            self._window_position[(*here, slice(layout.cells))] = layout.window_position

    def ids(self, record: Array, layout_number: Array | None = None, agent: int = 0) -> Array:
        """Return the number of the word of each of the 25 cells that one agent sees.

        Args:
            record: uint8 (B, S), state records; for several layouts, shorter records are padded at the end.
            layout_number: int, index of each record's layout in `layouts`; its shape is B or the first axes of B. None
                if there is one layout.
            agent: 0 (ego) or 1 (teammate).

        Returns:
            Word ids int32 (B, 25); `channels[ids]` are the observations that `observe` returns.
        """
        xp = record.__array_namespace__()
        batch = record.shape[:-1]
        several = layout_number is not None
        number: Any = 0
        if several:
            number = xp.reshape(layout_number, (*layout_number.shape, *[1] * (len(batch) - layout_number.ndim)))
            number = xp.astype(xp.broadcast_to(number, batch), xp.int32)

        def layout_values(table: np.ndarray, *indices: Array) -> Array:
            """Return `table[number, *indices]`, where `number` is the index of each record's layout in `layouts`."""
            flat = number
            for index, size in zip(indices, table.shape[1:], strict=False):
                flat = flat * size + xp.astype(index, xp.int32)
            rest = table.shape[1 + len(indices) :]
            return look_up(table.reshape(-1, *rest), flat) if several or indices else xp.asarray(table[0])

        def pair_number(byte: Array, second: Array) -> Array:
            return xp.astype(second & (_SECONDS - 1), xp.int32) << 8 | xp.astype(byte, xp.int32)

        zeros = xp.zeros((*batch, self._size + 1 - record.shape[-1]), dtype=xp.uint8)
        padded = xp.concat([record, zeros], axis=-1)
        if several:
            byte, second = (xp.take_along_axis(padded, layout_values(c), axis=-1) for c in (self._byte, self._second))
        else:
            byte, second = padded[..., self._byte[0]], padded[..., self._second[0]]
        first = (number[..., None] if several else 0) * self._words[0].size + layout_values(self._kind) * _PAIRS
        by_slot = look_up(self._words.reshape(-1), first + pair_number(byte, second))

        me, other = record[..., agent], record[..., 1 - agent]
        slots = xp.astype(layout_values(self._slot, me), xp.int32)
        words = xp.take_along_axis(by_slot, slots, axis=-1) + layout_values(self._fixed, me)
        facings, hands = record[..., 2:4], record[..., 4:6]
        own = layout_values(self._words[:, _SELF], pair_number(hands[..., agent], facings[..., agent]))
        others = layout_values(self._words[:, _OTHER], pair_number(hands[..., 1 - agent], facings[..., 1 - agent]))
        position, relative = xp.arange(VISIBLE, dtype=xp.uint8), layout_values(self._window_position, me, other)
        words = xp.where(position == relative[..., None], others[..., None], words)
        return xp.astype(xp.where(position == CENTRE, own[..., None], words), xp.int32)

    @lru_cache  # noqa: B019 - instances live as long as the process, see `cell_words`
    def entries(self, agents: tuple[int, ...] = (0,)) -> np.ndarray:
        """Return the entries of a flattened observation that can differ from 0 on at least one of `layouts`.

        Args:
            agents: the observing agents: 0 (ego), 1 (teammate). Agents can have different reachable cells, so two
                agents can have more such entries than one agent.

        Returns:
            Entries int32 (E,), ascending: cell * C + channel, with cells of the window in reading order. JAX uses
            int32 as it is, with and without 64-bit types.
        """
        nonzero = self.channels[:-1] > 0
        shown = np.zeros((VISIBLE, nonzero.shape[-1]), bool)
        for number, layout in enumerate(self.layouts):
            of_kind = np.stack([nonzero[words[words < len(nonzero)]].any(axis=0) for words in self._words[number]])
            for agent in agents:
                room, other_room = layout.rooms[agent], layout.rooms[1 - agent]
                kinds = self._kind[number, self._slot[number, room]]  # shape (reachable cells, 25)
                shown |= (of_kind[kinds] | nonzero[self._fixed[number, room]]).any(axis=0)
                relative = np.unique(layout.window_position[np.ix_(room, other_room)])
                shown[np.setdiff1d(relative, [NOWHERE, CENTRE])] |= of_kind[_OTHER]
                shown[CENTRE] |= of_kind[_SELF]
        return np.flatnonzero(shown).astype(np.int32)


@lru_cache(maxsize=16)
def cell_words(layouts: tuple[Layout, ...], canonical: bool = False) -> CellWords:
    """Return the cached `CellWords` of the given layouts.

    Args:
        layouts: one layout or several layouts; without `canonical`, all must have the same number of channels.
        canonical: whether words show the canonical channels, see `channels`, instead of the layouts' own.
    """
    return CellWords(layouts, canonical)


def _slots(layout: Layout) -> list[_Slot]:
    where = columns(layout)
    indicators, goals = (np.flatnonzero(layout.kinds == kind).tolist() for kind in (INDICATOR, GOAL))
    return [
        _Slot(_RECIPE, indicators, where.recipe),
        _Slot(_GOAL, goals, where.delivered),
        *(_Slot(_POT, [c], where.pot_items.start + k, where.pot_timers.start + k) for k, c in enumerate(layout.pots)),
        *(_Slot(_BUTTON, [c], where.recipe, where.buttons.start + k) for k, c in enumerate(layout.buttons)),
        *(_Slot(_COUNTER, [c], where.counters.start + k) for k, c in enumerate(layout.counters)),
    ]


def _fixed_cells(layout: Layout, canonical: bool) -> np.ndarray:
    """Return channels uint8 (cells * 25, C) of the window around each cell, for an empty map without agents."""
    record = np.zeros((layout.cells, record_size(layout)), np.uint8)
    record[:, 0] = np.arange(layout.cells)
    obs = observe(layout, record, 0, canonical)
    obs[..., : fixed_channels(layout, canonical).start] = 0
    return obs.reshape(-1, obs.shape[-1])


def _contents(layout: Layout, canonical: bool) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the possible contents of cells, int (n,), and their channels, uint8 (n, C), by kind such as `_POT`.

    A content is a number that combines two columns of the state record, see `_Slot`: `byte` + 256 * `second`.
    """
    item = np.arange(256)
    possible, count = possible_items(layout), ingredient_count(item)
    carried = np.flatnonzero(possible & ((item & PLATE > 0) | (count <= 1)))
    recipes = np.flatnonzero(possible & (item & (PLATE | COOKED) == 0) & (count == 3))
    potted = np.setdiff1d(np.flatnonzero(possible & (item & PLATE == 0)), recipes)
    cooking = (recipes + (np.arange(1, POT_STEPS + 1)[:, None] << 8)).ravel()
    lit = (recipes + (np.arange(BUTTON_STEPS + 1)[:, None] << 8)).ravel()
    pairs = {_RECIPE: recipes, _GOAL: np.arange(2), _POT: np.append(potted, cooking), _BUTTON: lit, _COUNTER: carried}
    size, channels = record_size(layout), fixed_channels(layout, canonical).start // 2  # channels of one agent
    found = {}
    for slot in _slots(layout):
        views = np.argwhere(layout.window_position[:, slot.cells] != NOWHERE)
        if slot.kind in found or not views.size:
            continue
        observer, cell = views[0][0], slot.cells[views[0][1]]
        record = np.zeros((len(pairs[slot.kind]), size), np.uint8)
        record[:, 0], record[:, slot.byte] = observer, pairs[slot.kind] & 255
        if slot.second is not None:
            record[:, slot.second] = pairs[slot.kind] >> 8
        shown = observe(layout, record, 0, canonical).reshape(len(record), VISIBLE, -1)
        shown = shown[:, layout.window_position[observer, cell]]
        shown[:, : 2 * channels] = 0
        found[slot.kind] = pairs[slot.kind], shown
    bodies = (carried + (np.arange(len(FACINGS))[:, None] << 8)).ravel()
    record = np.zeros((len(bodies), size), np.uint8)
    where = columns(layout)
    record[:, 0] = np.flatnonzero(layout.walkable)[0]
    record[:, where.facings.start], record[:, where.hands.start] = bodies >> 8, bodies & 255
    own = observe(layout, record, 0, canonical).reshape(len(bodies), VISIBLE, -1)[:, CENTRE]
    own[:, channels:] = 0
    return found | {_SELF: (bodies, own), _OTHER: (bodies, np.roll(own, channels, axis=-1))}
