"""Random draws that are functions of their arguments alone, and the parts of histories that windows come from."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.utils.validation import check_int

Weights = Literal["uniform", "length"] | Sequence[float] | np.ndarray
WEIGHTS = ("uniform", "length")
"""How histories are weighted in a draw: equally, or by the steps they offer. Or one number for each history."""

Episodes = tuple[int | None, int | None]
"""The first episode, and the one behind the last, as a slice has them: (None, 10) the first ten, (-10, None) the last
ten."""


@dataclass(frozen=True)
class Curriculum:
    """The part of every history that windows come from, moving as training goes on.

    Parts are fractions of a history's episodes (of those in `episodes`, where that is given). Between batch 0 and batch
    `batches` the part moves linearly from `first` to `last`, and stays there.

    Raises:
        OptionError: unless 0 <= low < high <= 1 for both parts.
    """

    batches: int
    first: tuple[float, float] = (0.0, 0.25)
    last: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        check_int("curriculum batches", self.batches, 1)
        for name, part in (("first", self.first), ("last", self.last)):
            if len(part) != 2 or not 0 <= part[0] < part[1] <= 1:
                raise OptionError(f"curriculum {name} = {part}: expected fractions 0 <= low < high <= 1")

    def part(self, i: int) -> tuple[float, float]:
        """Low and high fraction at batch i."""
        share = min(1.0, i / self.batches)
        low, high = (a + (b - a) * share for a, b in zip(self.first, self.last, strict=True))
        return low, high


def random_uint32(seed: int, i: int, count: int, batch_size: int) -> np.ndarray:
    """uint64 (count, batch_size): random words below 2**32, from (seed, i) alone.

    Philox's raw output is fixed by its definition, so batches stay the same across NumPy versions.
    """
    i = check_int("batch", i, 0)
    raw = np.random.Philox(key=np.array([seed, i], np.uint64)).random_raw(count * batch_size)
    return (raw >> np.uint64(32)).reshape(count, batch_size)


def scale_to_range(random: np.ndarray, n: Any) -> np.ndarray:
    """int64: words below 2**32 scaled to 0..n - 1."""
    return (random * np.asarray(n).astype(np.uint64) >> np.uint64(32)).astype(np.int64)


def weighted_choice(random: np.ndarray, weights: np.ndarray, first: Any = 0, stop: Any = None) -> np.ndarray:
    """int64: positions first..stop - 1 of `weights`, drawn in proportion to them. `first` and `stop` may be arrays.

    A position of weight zero is never drawn.
    """
    ends = np.concatenate([[0.0], np.cumsum(weights, dtype=np.float64)])
    stop = len(weights) if stop is None else stop
    low, high = ends[first], ends[stop]
    place = np.searchsorted(ends, low + random.astype(np.float64) / 2**32 * (high - low), side="right") - 1
    return np.clip(place, first, np.asarray(stop) - 1).astype(np.int64)


def check_weights(weights: Weights, histories: int) -> Weights:
    """The weights as they are, or as float64 (H,).

    Raises:
        UnknownNameError, OptionError: if they are neither a known name nor H numbers of which some is positive.
    """
    if isinstance(weights, str):
        if weights not in WEIGHTS:
            raise unknown("weights", weights, WEIGHTS)
        return weights
    try:
        numbers = np.asarray(weights, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"weights: expected numbers, found {weights!r}") from error
    if numbers.shape != (histories,) or not np.isfinite(numbers).all() or (numbers < 0).any() or not numbers.any():
        raise OptionError(
            f"weights: expected {histories} numbers, one a history, none negative and not all zero; found shape "
            f"{numbers.shape} with {numbers.min(initial=0):g}..{numbers.max(initial=0):g}"
        )
    return numbers


def episode_range(episodes: Episodes | None, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First episode and the one behind the last, int64 (H,) each, in histories of `counts` episodes.

    Raises:
        OptionError: if the range is malformed, or holds no episode of some history.
    """
    if episodes is None:
        return np.zeros_like(counts), counts
    if not isinstance(episodes, tuple) or len(episodes) != 2:
        raise OptionError(f"episodes = {episodes!r}: expected a pair such as (0, 10), (None, 10) or (-10, None)")
    edges = []
    for edge, default in zip(episodes, (np.zeros_like(counts), counts), strict=True):
        if edge is None:
            edges.append(default)
            continue
        try:
            number = operator.index(edge)
        except TypeError as error:
            raise OptionError(f"episodes = {episodes!r}: expected whole numbers or None") from error
        edges.append(np.clip(number + counts if number < 0 else np.full_like(counts, number), 0, counts))
    first, stop = edges
    if (first >= stop).any():
        fewest = int(counts[first >= stop].min())
        raise OptionError(f"episodes = {episodes!r}: a history of {fewest} episodes has none of them")
    return first, stop


def part_of(part: tuple[float, float], first: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The episodes of that part of first..stop: whole ones, at least one."""
    count = stop - first
    low = np.minimum(np.floor(part[0] * count + 1e-9).astype(np.int64), count - 1)
    high = np.maximum(np.ceil(part[1] * count - 1e-9).astype(np.int64), low + 1)
    return first + low, first + high
