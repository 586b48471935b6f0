"""Episodes of a learning history; arrays are read when they are accessed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Self, overload

import numpy as np

from icrl4aht_data.format.schema import FIELDS
from icrl4aht_data.utils.options import check_position, take_slice

if TYPE_CHECKING:
    from icrl4aht_data.reading.history import History


class FieldArrays:
    """Fields of a history, or of one of its episodes, as NumPy arrays: `x.actions` is the same as `x["actions"]`.

    T is the number of steps, E the number of episodes.
    """

    obs: np.ndarray
    """Observations, float32 or uint8 (T, 5, 5, C); with obs="state", state records, uint8 (T, S).

    With channels="canonical", C is 46 on every layout.
    """

    state: np.ndarray
    """State record before each step, uint8 (T, S); see `overcooked.state`."""

    actions: np.ndarray
    """The ego's actions, int32 (T,), from 0 to 5."""

    rewards: np.ndarray
    """The team's reward for each step, without shaping, float32 (T,)."""

    dones: np.ndarray
    """True at the last kept step of each episode, bool (T,)."""

    teammate_actions: np.ndarray
    """The teammate's actions, int32 (T,), from 0 to 5."""

    expert_actions: np.ndarray
    """Greedy actions of the expert policy at each step, int32 (T,), from 0 to 5.

    The expert policy is the learner's last checkpoint, as in the paper (App. D.1), or an earlier checkpoint with a
    higher return; see `entry.expert_step` and `entry.expert_return`.
    """

    oracle_actions: np.ndarray
    """Actions of the scripted oracle, which knows the full state, at each step, int32 (T,), from 0 to 5.

    In a history of source "noise", oracle actions are the ego's actions without the noise. They equal
    `expert_actions`, so a release need not store both.
    """

    episode_end_state: np.ndarray
    """State record after the last kept step of each episode, uint8 (E, S); of a single episode, uint8 (S,)."""

    def __getitem__(self, name: str) -> np.ndarray:
        raise NotImplementedError

    __iter__ = None
    """Disabled, since Python would otherwise iterate over items 0, 1, .., which do not exist."""


for _name in FIELDS:
    setattr(FieldArrays, _name, property(itemgetter(_name)))


class Episode(FieldArrays):
    """One episode of a history: T consecutive steps, the last one with done = True.

    `episode.actions`, `.rewards`, `.obs` and so on are NumPy arrays, read from the release at each access;
    `episode["actions"]` is the same as `episode.actions`.

    Args:
        history: the history that contains the episode.
        number: number of the episode in its history, from 0.

    Attributes:
        entry: the history's entry of the index.
        number: number of the episode in its history, from 0.
        start, stop: first step of the episode in its history, and its end (exclusive).
    """

    def __init__(self, history: History, number: int) -> None:
        ends = history.episode_ends
        self._history, self.entry, self.number = history, history.entry, number
        self.start, self.stop = int(ends[number - 1]) if number else 0, int(ends[number])

    def __len__(self) -> int:
        return self.stop - self.start

    def __repr__(self) -> str:
        e = self.entry
        return (
            f"Episode({self.number} of {e.episodes} of history {e.history_id}: {e.layout} with {e.teammate_kind}, "
            f"steps {self.start}..{self.stop - 1}, return {self.total_return:g})"
        )

    def __getitem__(self, name: str) -> np.ndarray:
        if name == "episode_end_state":
            return self._history.rows(name, self.number, self.number + 1)[0]
        return self._history.rows(name, self.start, self.stop)

    @property
    def total_return(self) -> float:
        """The sum of the rewards of the episode's kept steps."""
        return float(self.rewards.sum(dtype=np.float64))


class Episodes(Sequence[Episode]):
    """Sequence of all or some episodes of a history, in order.

    `episodes[i]` is the i-th `Episode`, `episodes[a:b]` a shorter sequence. Only the ends of episodes are read before
    an episode's arrays are accessed.

    Args:
        history: the history.
        numbers: numbers of the episodes in their history; all of them by default.
    """

    def __init__(self, history: History, numbers: range | None = None) -> None:
        self._history = history
        self.numbers = range(history.entry.episodes) if numbers is None else numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __repr__(self) -> str:
        e, n = self._history.entry, len(self)
        part = "" if n == e.episodes else f" of {e.episodes}"
        return f"Episodes({n}{part} of history {e.history_id}: {e.layout} with {e.teammate_kind})"

    @overload
    def __getitem__(self, position: int) -> Episode: ...

    @overload
    def __getitem__(self, position: slice) -> Self: ...

    def __getitem__(self, position: int | slice) -> Episode | Self:
        if isinstance(position, slice):
            return type(self)(self._history, take_slice(self.numbers, position, "episodes"))
        return Episode(self._history, self.numbers[check_position(repr(self), position, len(self))])

    def __iter__(self) -> Iterator[Episode]:
        return (self[position] for position in range(len(self)))

    def returns(self) -> np.ndarray:
        """Return the return of each episode, which is the sum of the episode's rewards, as float64 (E,)."""
        return self._history.returns()[np.array(self.numbers, np.int64)]
