"""The episodes of a history, whose arrays are read when they are used."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Self, overload

import numpy as np

from icrl4aht_data.format.schema import Entry, episode_returns
from icrl4aht_data.plotting import curve_svg
from icrl4aht_data.reading.lazy_array import LazyArray
from icrl4aht_data.utils.options import check_position
from icrl4aht_data.utils.signatures import show_method_types
from icrl4aht_data.utils.text import facts_html

ReadField = Callable[[str], LazyArray]
"""Function from the name of a history's field to its lazy array."""


class Episode:
    """One episode of a history: T consecutive steps, of which the last one is done.

    `episode.actions`, `.rewards`, `.obs` and so on are NumPy arrays, read from the release at each access;
    `episode["actions"]` is the same as `episode.actions`.

    Args:
        entry: the history's entry of the index.
        number: number of the episode in its history, from 0.
        start: the episode's first step in its history.
        stop: the step after its last one.
        field: reads a field of the history.

    Attributes:
        entry: the history's entry of the index.
        number: number of the episode in its history, from 0.
        start, stop: the episode's first step in its history, and the one after its last.
    """

    def __init__(self, entry: Entry, number: int, start: int, stop: int, field: ReadField) -> None:
        self.entry, self.number, self.start, self.stop = entry, number, start, stop
        self._field = field

    def __len__(self) -> int:
        return self.stop - self.start

    def __repr__(self) -> str:
        e = self.entry
        return (
            f"Episode({self.number} of {e.episodes} of history {e.history_id}: {e.layout} with {e.teammate_kind}, "
            f"steps {self.start}..{self.stop - 1}, return {self.total_return:g})"
        )

    def _repr_html_(self) -> str:
        """The episode's facts and its return by step, for notebooks."""
        e, rewards = self.entry, self.rewards
        given = ", ".join(f"{reward:+g} at step {step}" for step, reward in enumerate(rewards) if reward)
        facts = {
            "history": f"{e.history_id}, {e.layout} with {e.teammate_family}, {e.teammate_kind}",
            "steps": f"{self.start:,} to {self.stop - 1:,} of the history",
            "rewards": given or "none",
            "return": f"{self.total_return:g}",
        }
        title = f"Episode {self.number} of history {e.history_id}"
        return facts_html(title, facts, curve_svg({"return": np.cumsum(rewards)}, "step"))

    def __getitem__(self, name: str) -> np.ndarray:
        array = self._field(name)
        if name == "episode_end_state":
            return array[self.number]
        return array[self.start : self.stop]

    __iter__ = None
    """Disabled: Python would otherwise count through `episode[0]`, `episode[1]`, which are no fields."""

    @property
    def obs(self) -> np.ndarray:
        """(T, 5, 5, C) float32 or uint8: observations; or (T, S) uint8: state records, if the dataset's obs="state"."""
        return self["obs"]

    @property
    def state(self) -> np.ndarray:
        """(T, S) uint8: the state record before each step; see `overcooked.state`."""
        return self["state"]

    @property
    def actions(self) -> np.ndarray:
        """(T,) int32: the ego's actions, 0..5."""
        return self["actions"]

    @property
    def rewards(self) -> np.ndarray:
        """(T,) float32: the team's reward of each step, without shaping."""
        return self["rewards"]

    @property
    def dones(self) -> np.ndarray:
        """(T,) bool: True at the last step."""
        return self["dones"]

    @property
    def teammate_actions(self) -> np.ndarray:
        """(T,) int32: the teammate's actions, 0..5."""
        return self["teammate_actions"]

    @property
    def expert_actions(self) -> np.ndarray:
        """(T,) int32: greedy actions of one policy at the same steps, 0..5; see `History.expert_actions`."""
        return self["expert_actions"]

    @property
    def oracle_actions(self) -> np.ndarray:
        """(T,) int32: actions of the scripted oracle at the same steps, 0..5; see `History.oracle_actions`."""
        return self["oracle_actions"]

    @property
    def episode_end_state(self) -> np.ndarray:
        """(S,) uint8: the state after the last step."""
        return self["episode_end_state"]

    @property
    def total_return(self) -> float:
        """The sum of the rewards of the episode's kept steps."""
        return float(self.rewards.sum(dtype=np.float64))


class Episodes(Sequence[Episode]):
    """The episodes of a history in order, or a part of them.

    `len(episodes)` is their number, `episodes[i]` the i-th `Episode`, `episodes[a:b]` a part; iteration yields them in
    order. Nothing but the ends of episodes is read before an episode's arrays are used.

    Args:
        entry: the history's entry of the index.
        field: reads a field of the history.
        ends: returns the step after each of the history's episodes, int64 (E,).
        numbers: numbers of the episodes in their history; all of them by default.
    """

    def __init__(
        self, entry: Entry, field: ReadField, ends: Callable[[], np.ndarray], numbers: range | None = None
    ) -> None:
        self._entry, self._field, self._ends = entry, field, ends
        self.numbers = range(entry.episodes) if numbers is None else numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __repr__(self) -> str:
        e, n = self._entry, len(self)
        part = "" if n == e.episodes else f" of {e.episodes}"
        return f"Episodes({n}{part} of history {e.history_id}: {e.layout} with {e.teammate_kind})"

    @overload
    def __getitem__(self, position: int) -> Episode: ...

    @overload
    def __getitem__(self, position: slice) -> Self: ...

    def __getitem__(self, position: int | slice) -> Episode | Self:
        if isinstance(position, slice):
            return type(self)(self._entry, self._field, self._ends, self.numbers[position])
        number = self.numbers[check_position(repr(self), position, len(self))]
        ends = self._ends()
        start = int(ends[number - 1]) if number else 0
        return Episode(self._entry, number, start, int(ends[number]), self._field)

    def __iter__(self) -> Iterator[Episode]:
        return (self[position] for position in range(len(self)))

    def returns(self) -> np.ndarray:
        """Return the sum of the rewards of each of these episodes, float64 (E,)."""
        returns = episode_returns(self._field("rewards")[:], self._field("dones")[:])
        return returns[np.array(self.numbers, np.int64)]


show_method_types(Episode)
