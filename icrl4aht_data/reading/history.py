"""One learning history with its fields as lazy arrays, which read only the rows that are indexed."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike

from icrl4aht_data.errors import LabelsMissingError, NotStoredError, unknown
from icrl4aht_data.format.schema import FIELDS, Entry, Field, Kind, episode_returns
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.shard import RowRange, Shard, fetch_rows
from icrl4aht_data.utils.memory import new_array

Obs = Literal["float32", "uint8", "state"]
OBS: tuple[Obs, ...] = ("float32", "uint8", "state")
"""Presentations of observations: float32 (the paper's interface), uint8 (the same integers), or the state records that
`icrl4aht_data.overcooked.observe` renders, if the release has them."""


class History:
    """One learning history: an ego that learns with one fixed teammate, T steps in E episodes.

    `history.actions`, `.rewards`, `.obs` and so on are lazy arrays: indexing them reads only the chunks it needs.

    Args:
        entry: the history's entry of the index.
        shard: the shard that stores the history.
        obs: presentation of observations in `History.obs`; see `OBS`.

    Attributes:
        entry: the history's entry of the index: ids, layout, teammate, T, returns and others.
    """

    def __init__(self, entry: Entry, shard: Shard, obs: Obs) -> None:
        self.entry = entry
        self._shard = shard
        self._obs: Obs = obs

    def __len__(self) -> int:
        return self.entry.T

    def __repr__(self) -> str:
        e = self.entry
        return (
            f"History({e.history_id}: {e.layout} with {e.teammate_kind}, T={e.T}, {e.episodes} episodes, "
            f"return {e.return_start:.1f} -> {e.return_end:.1f})"
        )

    @property
    def kind(self) -> Kind:
        """The release's kind: "full", "lite" or "observations"."""
        return self._shard.kind

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return rows start..stop of a field; see `schema.FIELDS` for names, dtypes and shapes.

        Args:
            name: the field.
            start, stop: steps (episodes for `episode_end_state`), as in a slice; all rows by default.

        Raises:
            UnknownNameError: for a name that is not a field.
            LabelsMissingError: for expert or teammate actions of a history without them.
            NotStoredError: for states of a release without state records.
            ShardCorruptError: names the chunk whose checksum is wrong.
        """
        field = self._field(name)
        rows = self.entry.rows(field)
        start, stop, _ = slice(start, stop).indices(rows)
        stop = max(start, stop)
        if self.kind in field.absent:
            return self._rendered(start, stop, np.uint8)
        fetch_rows([RowRange(self._shard, self.entry.history_id, field, start, stop)])
        return self._shard.read(self.entry.history_id, field, start, stop)

    def _rendered(self, start: int, stop: int, dtype: DTypeLike) -> np.ndarray:
        """Observations (stop - start, 5, 5, C) of a release that stores states only."""
        what = f"{self._shard.path}: history {self.entry.history_id}: obs"
        out = new_array((stop - start, *self.entry.obs_shape), dtype, what)
        return fast_observe(self._shard.layout, self.read("state", start, stop), out)

    def _field(self, name: str) -> Field:
        if name not in FIELDS:
            raise unknown("field", name, FIELDS)
        field = FIELDS[name]
        if field.row == "state" and self.kind in field.absent:
            raise NotStoredError(
                f"{self._shard.path}: no {name}: this release has observations only, which do not determine the state; "
                f"use a full or lite release for what needs states, such as replay and drawing"
            )
        if not self.entry.has(field):
            raise LabelsMissingError(
                f"history {self.entry.history_id} ({self.entry.task_id}) has no {name.replace('_', ' ')}: its index "
                f"entry says has_{name} = false; choose histories that have them"
            )
        return field

    @property
    def obs(self) -> LazyArray:
        """(T, 5, 5, C) float32 or uint8: observations; or (T, S) uint8: state records, if the dataset's obs="state"."""
        return LazyArray(self, "state" if self._obs == "state" else "obs", self._obs)

    @property
    def state(self) -> LazyArray:
        """(T, S) uint8: the state record before each step; see `overcooked.state`."""
        return LazyArray(self, "state")

    @property
    def actions(self) -> LazyArray:
        """(T,) int32: the ego's actions, 0..5."""
        return LazyArray(self, "actions")

    @property
    def rewards(self) -> LazyArray:
        """(T,) float32: the team's reward of each step, without shaping."""
        return LazyArray(self, "rewards")

    @property
    def dones(self) -> LazyArray:
        """(T,) bool: True at the last kept step of each episode."""
        return LazyArray(self, "dones")

    @property
    def teammate_actions(self) -> LazyArray:
        """(T,) int32: the teammate's actions, 0..5."""
        return LazyArray(self, "teammate_actions")

    @property
    def expert_actions(self) -> LazyArray:
        """(T,) int32: greedy actions of a checkpoint of the ego at the same steps, 0..5 (paper, App. D.1)."""
        return LazyArray(self, "expert_actions")

    @property
    def episode_end_state(self) -> LazyArray:
        """(E, S) uint8: the state after each episode's last kept step."""
        return LazyArray(self, "episode_end_state")

    def returns(self) -> np.ndarray:
        """Return the learning curve, float64 (E,): each episode's return over its kept steps."""
        return episode_returns(self.read("rewards"), self.read("dones"))


class LazyArray:
    """One field of a history that is read when it is indexed. Supports NumPy indexing.

    Args:
        history: the history.
        name: the field, one of `schema.FIELDS`.
        obs: for the field `obs`, "float32" or "uint8".

    Attributes:
        dtype: the rows' dtype.
        shape: (T, ...), or (E, ...) for `episode_end_state`.
    """

    def __init__(self, history: History, name: str, obs: Obs | None = None) -> None:
        self._history, self._name = history, name
        entry, field = history.entry, history._field(name)
        self.dtype = np.dtype(field.dtype)
        if name == "obs" and obs == "float32":
            self.dtype = np.dtype("float32")
        row = {"scalar": (), "obs": entry.obs_shape}.get(field.row)
        if row is None:
            row = field.element(get_layout(entry.layout), "full").shape
        self.shape = (entry.rows(field), *row)

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"LazyArray({self._name}, shape={self.shape}, dtype={self.dtype})"

    def __getitem__(self, key: Any) -> np.ndarray:
        first, *rest = key if isinstance(key, tuple) else (key,)
        if isinstance(first, slice):
            rows = range(len(self))[first]
            low, high = sorted((rows[0], rows[-1])) if rows else (0, -1)
            return self._read(low, high + 1)[:: rows.step][(slice(None), *rest)]
        if isinstance(first, (int, np.integer)):
            row = range(len(self))[first]
            return self._read(row, row + 1)[(0, *rest)]
        return self._read(0, len(self))[key]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or self.dtype, copy=False)

    def _read(self, start: int, stop: int) -> np.ndarray:
        if self._name == "obs" and self._history.kind in FIELDS["obs"].absent:
            return self._history._rendered(start, stop, self.dtype)
        return self._history.read(self._name, start, stop).astype(self.dtype, copy=False)
