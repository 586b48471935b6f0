"""A learning history, whose fields are NumPy arrays, read on first access."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike

from icrl4aht_data.errors import LabelsMissingError, NotStoredError, OptionError, check_choice
from icrl4aht_data.format.schema import FIELDS, Entry, Field, Kind, episode_returns
from icrl4aht_data.overcooked.channels import Channels, observation_shape, to_canonical
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.plotting import Picture, animate_episode, plot_history
from icrl4aht_data.reading.episodes import Episodes, FieldArrays
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.system import new_array
from icrl4aht_data.utils.text import counted_noun

Obs = Literal["float32", "uint8", "state"]
"""Values of the option `obs`: observations as float32 (the paper's dtype) or uint8 (the same integers), or
state records, which `icrl4aht_data.overcooked.observe` renders as observations."""

Labels = Literal["expert", "oracle"]
LABELS: tuple[Labels, ...] = ("expert", "oracle")
"""Kinds of labels, the actions that a model learns to predict: "expert" (field `expert_actions`), actions of a policy
without noise (`Entry.expert_return` is its return, where known), or "oracle" (field `oracle_actions`), actions of the
scripted oracle, which knows the full state."""


class History(FieldArrays):
    """One learning history: an ego that learns with one fixed teammate, T steps in E episodes.

    `history.actions`, `.rewards`, `.obs` and so on are read-only NumPy arrays, read on first access and then cached;
    `history["actions"]` is the same as `history.actions`. `history.read("obs", 0, 100)` reads only some rows;
    `history.episodes[-1].actions` are the actions of the last episode.

    Args:
        entry: the history's entry of the index.
        open_shard: function from a shard's name to the opened shard, called on first access of a field.
        obs: form of the observations in `History.obs`; see `Obs`.
        channels: channels of `History.obs`, "own" (of the layout) or "canonical"; see `channels.CHANNELS`.

    Attributes:
        entry: the history's index entry, with ids, layout, teammate, T, returns and other fields.
    """

    def __init__(self, entry: Entry, open_shard: Callable[[str], Shard], obs: Obs, channels: Channels = "own") -> None:
        self.entry = entry
        self._open_shard, self._obs, self._canonical = open_shard, obs, channels == "canonical"
        self._arrays: dict[str, np.ndarray] = {}

    @property
    def _shard(self) -> Shard:
        return self._open_shard(self.entry.shard)

    def __len__(self) -> int:
        return self.entry.T

    def __repr__(self) -> str:
        e = self.entry
        return (
            f"History({e.history_id}: {e.layout} with {e.teammate_kind}, T={e.T}, "
            f"{counted_noun(e.episodes, 'episode')}, return {e.return_start:.1f} -> {e.return_end:.1f}"
            + ("" if e.expert_return is None else f", labels {e.expert_return:.1f}")
            + f", source {e.source}"
            + (f", learner {e.learner})" if e.learner else ")")
        )

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            array = self.rows(name, 0, self.entry.T if name == "obs" else self.entry.rows(self._checked_field(name)))
            array.flags.writeable = False  # every later access returns the same array
            self._arrays[name] = array
        return self._arrays[name]

    @property
    def kind(self) -> Kind:
        """The release's kind: "full", "lite" or "observations"."""
        return self._shard.kind

    def read(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return rows start..stop of a field as stored; see `schema.FIELDS` for names, dtypes and shapes.

        Observations that a lite release does not store are rendered, with channels="own".

        Args:
            name: the field.
            start, stop: steps (episodes for `episode_end_state`), as in a slice; all rows by default.

        Raises:
            UnknownNameError: for a name that is not a field.
            OptionError: if `start` or `stop` is neither an integer nor None.
            LabelsMissingError: if the history does not have the expert, oracle or teammate actions asked for.
            NotStoredError: for states of a release without state records.
            ShardCorruptError: if the checksum of a chunk is wrong; the message names the chunk.
        """
        field = self._checked_field(name)
        try:
            if isinstance(start, bool) or isinstance(stop, bool):
                raise TypeError
            start, stop, _ = slice(start, stop).indices(self.entry.rows(field))
        except TypeError as error:
            raise OptionError(f"{name}[{start!r}:{stop!r}]: expected integers or None") from error
        stop = max(start, stop)
        if self.kind in field.absent:
            return self._render_rows(start, stop, np.uint8, canonical=False)
        return self._shard.read(self.entry.history_id, field, start, stop)

    def rows(self, name: str, start: int, stop: int) -> np.ndarray:
        """Return rows start..stop of a field; "obs" has the form given by the options `obs` and `channels`."""
        if name in self._arrays:
            return self._arrays[name][start:stop]
        if name != "obs":
            return self.read(name, start, stop)
        if self._obs == "state":
            return self.read("state", start, stop)
        if self.kind in FIELDS["obs"].absent:
            return self._render_rows(start, stop, self._obs, self._canonical)
        rows = self.read("obs", start, stop)
        return (to_canonical(self._shard.layout, rows) if self._canonical else rows).astype(self._obs, copy=False)

    def _render_rows(self, start: int, stop: int, dtype: DTypeLike, canonical: bool) -> np.ndarray:
        """Render observations (stop - start, 5, 5, C) of a release without stored observations."""
        layout = self._shard.layout
        what = f"{self._shard.path}: history {self.entry.history_id}: obs"
        out = new_array((stop - start, *observation_shape(layout, canonical)), dtype, what)
        return fast_observe(layout, self.read("state", start, stop), out, canonical=canonical)

    def _checked_field(self, name: str) -> Field:
        check_choice("field", name, FIELDS)
        field = FIELDS[name]
        if field.row == "state" and self.kind in field.absent:
            raise NotStoredError(
                f"{self._shard.path}: no {name}: this release has observations only, which do not determine the state; "
                f"use a full or lite release for replay, drawing and other uses of states"
            )
        if not self.entry.has(field):
            raise LabelsMissingError(
                f"history {self.entry.history_id} ({self.entry.task_id}) has no {name.replace('_', ' ')}: its index "
                f"entry says has_{name} = false; choose histories that have them"
            )
        return field

    def returns(self) -> np.ndarray:
        """Return the learning curve: the return of each episode over the kept steps, as float64 (E,)."""
        return episode_returns(self.read("rewards"), self.read("dones"))

    @property
    def episodes(self) -> Episodes:
        """The episodes as a sequence: `history.episodes[-1].actions` are the actions of the last episode."""
        return Episodes(self)

    @cached_property
    def episode_ends(self) -> np.ndarray:
        """End (exclusive) of each episode, int64 (E,)."""
        return np.flatnonzero(self.read("dones")) + 1

    def plot(self) -> Picture:
        """Return the learning curve (return by episode) as a picture, which notebooks show.

        Raises:
            OptionError: if matplotlib is not installed.
        """
        e = self.entry
        title = f"History {e.history_id}: {e.layout} with {e.teammate_kind}, source {e.source}"
        return Picture(f"{title}, return by episode", plot_history(self.returns(), title, e.expert_return))

    def animate(self, episode: int = -1, *, cell: int = 32, fps: int = 8) -> Picture:
        """Return an episode as an animated GIF, which notebooks play.

        Args:
            episode: number of the episode, from 0, or from the end if negative; the last one by default.
            cell: side of a map cell in pixels, 16 to 128.
            fps: frames per second, 1 to 50.

        Raises:
            PositionError: for an episode that the history does not have.
            OptionError: if `episode` is not an integer, `cell` or `fps` is out of range, or Pillow is not installed.
            NotStoredError: for a release without state records.
        """
        chosen = self.episodes[check_int("episode", episode, -(2**63))]
        return animate_episode(self._shard.layout, chosen.state, chosen.rewards, repr(chosen), cell=cell, fps=fps)
