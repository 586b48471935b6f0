"""Random draws as pure functions of their arguments, and the ranges of steps that samplers draw from.

`H` denotes the number of histories in a selection, `B` the batch size.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.random import Philox  # imported early: a fork must not interrupt the import of np.random

from icrl4aht_data.errors import OptionError, check_choice
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.utils.options import check_int

Weights = Literal["uniform", "length"] | Sequence[float] | np.ndarray
WEIGHTS = ("uniform", "length")
"""Names of weights of histories in random draws: equal, or proportional to the number of steps to draw from."""

EpisodeRange = tuple[int | None, int | None]
"""Range of episodes as in a slice: (None, 10) are the first ten, (-10, None) the last ten."""


@dataclass(frozen=True)
class Curriculum:
    """The part of every history that windows are drawn from; this part moves linearly with the batch number.

    A part is given as fractions of a history's episodes, or of the sampler's range `episodes`. The part moves from
    `first` at batch 0 to `last` at batch `batches` and does not change afterwards.

    Args:
        batches: number of the first batch with the part `last`, at least 1.
        first: the part at batch 0: fractions (low, high), such as (0.0, 0.25) for the first quarter.
        last: the final part: fractions (low, high).

    Raises:
        OptionError: unless 0 <= low < high <= 1 for both parts.
    """

    batches: int
    first: tuple[float, float] = (0.0, 0.25)
    last: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        check_int("curriculum batches", self.batches, 1)
        for name, part in (("first", self.first), ("last", self.last)):
            with suppress(TypeError, ValueError):
                low, high = part
                if 0 <= low < high <= 1:
                    continue
            raise OptionError(f"curriculum {name} = {part!r}: expected fractions 0 <= low < high <= 1")

    def part(self, i: int) -> tuple[float, float]:
        """Return the part of histories at batch i, as fractions (low, high)."""
        share = min(1.0, i / self.batches)
        low, high = (a + (b - a) * share for a, b in zip(self.first, self.last, strict=True))
        return low, high


def random_uint32(seed: int, i: int, count: int, batch_size: int) -> np.ndarray:
    """Return random integers below 2**32, uint64 (count, batch_size), that depend only on the arguments."""
    i = check_int("batch", i, 0)
    # The raw output of Philox is specified, so batches do not depend on the NumPy version.
    raw = Philox(key=np.array([seed, i], np.uint64)).random_raw(count * batch_size)
    return (raw >> np.uint64(32)).reshape(count, batch_size)


def draw_subset(seed: int, total: int, count: int) -> np.ndarray:
    """Return a uniformly random subset of 0..total - 1 of size `count`, int64 (count,), ascending.

    Floyd's algorithm (Bentley and Floyd 1987) takes one random integer per member.
    """
    raw = Philox(key=np.array([seed, total], np.uint64)).random_raw(count)
    chosen: set[int] = set()
    for last, random in zip(range(total - count, total), raw.tolist(), strict=True):
        drawn = random % (last + 1)
        chosen.add(last if drawn in chosen else drawn)
    return np.array(sorted(chosen), np.int64)


def scale_to_range(random: np.ndarray, n: Any) -> np.ndarray:
    """Return random integers below 2**32 scaled to 0..n - 1, as int64."""
    # Multiply and shift: exact in integers, and several times faster than a remainder.
    return (random * np.asarray(n).astype(np.uint64) >> np.uint64(32)).astype(np.int64)


def weighted_choice(random: np.ndarray, weights: np.ndarray | None, first: Any, stop: Any) -> np.ndarray:
    """Return positions in first..stop - 1, drawn with probabilities proportional to their weights.

    Args:
        random: uint64 (B,), integers below 2**32.
        weights: float64 (N,), not negative, with a finite sum; None for equal weights.
        first, stop: start and end (exclusive) of the range of each draw, numbers or int (B,).

    Returns:
        int64 (B,).
    """
    if weights is None:
        return first + scale_to_range(random, stop - first)
    # A weight of 0 gives two equal edges; side="right" skips the empty interval between them.
    edges = np.concatenate([[0.0], np.cumsum(weights, dtype=np.float64)])
    low, high = edges[first], edges[stop]
    position = np.searchsorted(edges, low + random.astype(np.float64) / 2**32 * (high - low), side="right") - 1
    return np.clip(position, first, np.asarray(stop) - 1).astype(np.int64)  # rounding may give `stop` itself


class HistoryDraws:
    """Ranges of steps from which samplers draw in each batch, and weights of the histories.

    Args:
        selection: the histories.
        weights: a name in `WEIGHTS`, or one number for each history.
        episodes: range of episodes to draw from, see `EpisodeRange`; None for all episodes.
        curriculum: part of each history to draw from, by batch; None for the same episodes in every batch.

    Attributes:
        lengths: int64 (H,), number of steps of each history.
        kept_steps: number of steps of an episode.

    Raises:
        UnknownNameError, OptionError: for impossible options.
    """

    def __init__(
        self, selection: Selection, weights: Weights, episodes: EpisodeRange | None, curriculum: Curriculum | None
    ) -> None:
        self.lengths, self._counts = selection.column("T"), selection.column("episodes")
        self.kept_steps: int = selection.info.environment.kept_steps
        if curriculum is not None and not isinstance(curriculum, Curriculum):
            raise OptionError(f"curriculum = {curriculum!r}: expected a Curriculum, such as Curriculum(batches=1000)")
        self.weights, self.episodes, self.curriculum = _check_weights(weights, len(selection)), episodes, curriculum
        self._range = _episode_range(episodes, self._counts)

    def steps(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first step and the end (exclusive) of each history's range at batch i, int64 (H,) each."""
        first, stop = self._range
        if self.curriculum is not None:
            low, high = self.curriculum.part(i)
            count = stop - first
            # The part has one or more complete episodes. Without 1e-9, rounding could make ceil(0.3 * 10) equal to 4.
            low = np.minimum(np.floor(low * count + 1e-9).astype(np.int64), count - 1)
            high = np.maximum(np.ceil(high * count - 1e-9).astype(np.int64), low + 1)
            first, stop = first + low, first + high
        # A range up to the last episode includes the last episode's steps even if the episode is unfinished.
        return first * self.kept_steps, np.where(stop == self._counts, self.lengths, stop * self.kept_steps)

    def fewest_steps(self) -> np.ndarray:
        """Return the number of steps in each history's range, int64 (H,); with a curriculum, a lower bound for it."""
        low, high = self.steps(0)
        if self.curriculum is None or self.curriculum.first == self.curriculum.last:
            return high - low
        first, stop = self._range
        # The part of a history that a curriculum selects grows or shrinks linearly.
        share = min(high - low for low, high in (self.curriculum.first, self.curriculum.last))
        return self.kept_steps * np.maximum(np.ceil(share * (stop - first) - 1e-9).astype(np.int64), 1)

    def history_weights(self, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
        """Return the histories' weights for ranges of steps low..high, float64 (H,); None for equal weights."""
        if isinstance(self.weights, str):
            return None if self.weights == "uniform" else (high - low).astype(np.float64)
        # Sums of weights near 1e308 would be infinite. Scaling by a power of 2 is exact and changes no draw.
        return np.ldexp(self.weights, -np.frexp(self.weights.max())[1])

    def options(self) -> dict[str, Any]:
        """Return the options that determine the draws, as values that JSON can store."""
        curriculum = self.curriculum
        return {
            "weights": self.weights if isinstance(self.weights, str) else self.weights.tolist(),
            "episodes": self.episodes and list(self.episodes),
            "curriculum": curriculum and [curriculum.batches, *curriculum.first, *curriculum.last],
        }


def _check_weights(weights: Weights, histories: int) -> str | np.ndarray:
    """Return the name of the weights, or the numbers as float64 (H,).

    Raises:
        UnknownNameError, OptionError: unless `weights` is a known name, or H numbers, none negative and not all 0.
    """
    if isinstance(weights, str):
        check_choice("weights", weights, WEIGHTS)
        return weights
    try:
        numbers = np.asarray(weights, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"weights: expected numbers, found {weights!r}") from error
    if numbers.shape != (histories,) or not np.isfinite(numbers).all() or (numbers < 0).any() or not numbers.any():
        values = f"{numbers.min():g} to {numbers.max():g}" if numbers.size else "no values"
        raise OptionError(
            f"weights: expected {histories} numbers, one per history, none negative and not all zero; found shape "
            f"{numbers.shape} with {values}"
        )
    return numbers


def _episode_range(episodes: EpisodeRange | None, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first episode and the end (exclusive) of a range of episodes in every history, int64 (H,) each.

    `counts` has the number of episodes of each history.

    Raises:
        OptionError: if the range is malformed, or some history has no episode in the range.
    """
    if episodes is None:
        return np.zeros_like(counts), counts
    try:
        if not isinstance(episodes, tuple) or any(isinstance(bound, bool) for bound in episodes):
            raise TypeError
        first, stop = episodes
        bounds = slice(first, stop)
        # Most histories have equally many episodes, so the Python loop is short.
        distinct, number = np.unique(counts, return_inverse=True)
        first, stop = np.array([bounds.indices(count)[:2] for count in distinct.tolist()], np.int64)[number].T
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"episodes = {episodes!r}: expected a pair of integers or None such as (0, 10), (None, 10) or (-10, None)"
        ) from error
    if (first >= stop).any():
        fewest = int(counts[first >= stop].min())
        raise OptionError(f"episodes = {episodes!r}: a history with {fewest} episodes has no episode in this range")
    return first, stop
