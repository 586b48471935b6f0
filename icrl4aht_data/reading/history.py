"""One learning history, and its fields as lazy arrays: what is not asked for is not read."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike

from icrl4aht_data.errors import LabelsMissingError, NotStoredError, unknown
from icrl4aht_data.format.schema import FIELDS, Entry, Field, Kind, episode_returns
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.remote.partial_file import fetch_chunks
from icrl4aht_data.utils.memory import new_array

Obs = Literal["float32", "uint8", "state"]
OBS: tuple[Obs, ...] = ("float32", "uint8", "state")
"""How observations are presented: float32 (the paper's contract), uint8 (the same integers), or the state records
from which `icrl4aht_data.overcooked.observe` renders them, where a release has any."""


class History:
    """One learning history: an ego that learns beside one teammate, T steps of E episodes.

    `history.actions`, `.rewards`, `.obs`, ... are lazy arrays: slicing reads only the chunks it needs.
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
        """Of the release: "full", "lite" or "observations"."""
        return self._shard.kind

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start..stop of a field; see `schema.FIELDS` for names, dtypes and shapes.

        Raises:
            LabelsMissingError: if expert or teammate actions are asked of a history without them.
            NotStoredError: if states are asked of a release without state records.
            ShardCorruptError: names the chunk whose checksum is wrong.
        """
        field = self._field(name)
        rows = self.entry.rows(field)
        start, stop, _ = slice(start, stop).indices(rows)
        stop = max(start, stop)
        if self.kind in field.absent:
            return self._painted(start, stop, np.uint8)
        if self._shard.is_remote:
            fetch_chunks(self._shard.lacking(self._shard.needed(self.entry.history_id, field, start, stop)))
        return self._shard.read(self.entry.history_id, field, start, stop)

    def _painted(self, start: int, stop: int, dtype: DTypeLike) -> np.ndarray:
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
                f"what needs states, such as replay and drawing, needs a full or lite release"
            )
        if not self.entry.has(field):
            raise LabelsMissingError(
                f"history {self.entry.history_id} ({self.entry.task_id}) has no {name.replace('_', ' ')}: its index "
                f"entry says has_{name} = false; choose histories that have them"
            )
        return field

    @property
    def obs(self) -> LazyArray:
        """(T, 5, 5, C) float32 or uint8, or the state records (T, S) uint8, as the dataset's `obs` says."""
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
        """(T,) float32: the team's reward, unshaped."""
        return LazyArray(self, "rewards")

    @property
    def dones(self) -> LazyArray:
        """(T,) bool: the last kept step of each episode."""
        return LazyArray(self, "dones")

    @property
    def teammate_actions(self) -> LazyArray:
        """(T,) int32: the teammate's actions, 0..5."""
        return LazyArray(self, "teammate_actions")

    @property
    def expert_actions(self) -> LazyArray:
        """(T,) int32: what the converged ego would do (paper, App. D.1)."""
        return LazyArray(self, "expert_actions")

    @property
    def episode_end_state(self) -> LazyArray:
        """(E, S) uint8: the state after each episode's last kept step."""
        return LazyArray(self, "episode_end_state")

    def returns(self) -> np.ndarray:
        """float64 (E,): return of each episode over its kept steps: the learning curve."""
        return episode_returns(self.read("rewards"), self.read("dones"))


class LazyArray:
    """One field of one history, read on indexing. Takes what a NumPy array's first axis takes."""

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
        first, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        if isinstance(first, slice):
            start, stop, step = first.indices(len(self))
            low, high = (start, stop) if step > 0 else (stop + 1, start + 1)
            rows = self._read(max(low, 0), max(high, low, 0))
            rows = rows[::step] if step > 0 else rows[::-1][::-step]
        elif isinstance(first, (int, np.integer)):
            position = range(len(self))[first]
            rows = self._read(position, position + 1)[0]
        elif first is None or first is Ellipsis:
            return self._read(0, len(self))[key]
        else:
            rows = self._read(0, len(self))[np.asarray(first)]
        if not rest:
            return rows
        return rows[rest] if isinstance(first, (int, np.integer)) else rows[(slice(None), *rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or self.dtype, copy=False)

    def _read(self, start: int, stop: int) -> np.ndarray:
        if self._name == "obs" and self._history.kind in FIELDS["obs"].absent:
            return self._history._painted(start, max(start, stop), self.dtype)
        return self._history.read(self._name, start, stop).astype(self.dtype, copy=False)
