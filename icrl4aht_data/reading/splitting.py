"""Choice of teammates and histories to hold out of training, a function of names and a seed.

Each name has a random rank, so the choice between two histories does not depend on the rest of the selection.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from typing import Literal

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.reading.selection import Selection

SplitBy = Literal["teammate", "history"]
SPLIT_BY: tuple[SplitBy, ...] = ("teammate", "history")
"""Units that a split holds out: teammates with all their histories, or single histories."""


def choose_teammates(teammates: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Choose a share of the teammates to hold out, at least one unless there is only one.

    Args:
        teammates: strings (H,), the name of each history's teammate.
        share: share of the teammates.
        seed: seed of the choice.

    Returns:
        bool (H,): True for the histories with a chosen teammate.

    Raises:
        OptionError: if the share is not between 0 and 1.
    """
    _check_share(share)
    names = sorted(set(teammates.tolist()), key=lambda name: _rank(seed, name))
    return np.isin(teammates, names[: _count(share, len(names)) if len(names) > 1 else 0])


def choose_histories(selection: Selection, share: float, seed: int) -> np.ndarray:
    """Choose a share of the histories to hold out, at least one; every task keeps at least one history.

    Args:
        selection: the histories to divide.
        share: share of the histories.
        seed: seed of the choice.

    Returns:
        bool (H,): True for the chosen histories.

    Raises:
        OptionError: if the share is not between 0 and 1, or every task has only one history.
    """
    _check_share(share)
    names, of_task = selection.index.values("task_id"), defaultdict(list)
    streams = _stream_names(selection)
    for row, code in enumerate(selection.column_codes("task_id").tolist()):
        of_task[code].append((_rank(seed, names[code], *streams[row]), row))
    candidates = sorted(
        one for ranked in of_task.values() for one in sorted(ranked)[:-1]
    )  # one history per task stays in training
    if not candidates:
        raise OptionError(
            f"every task of {selection!r} has one history: expected a task with two or more, one to train on and one "
            f"to hold out"
        )
    chosen = np.zeros(len(selection), bool)
    chosen[[row for _, row in candidates[: _count(share, len(selection))]]] = True
    return chosen


def _check_share(share: float) -> None:
    if not 0 < share < 1:
        raise OptionError(f"share = {share}: expected a number between 0 and 1")


def _stream_names(selection: Selection) -> list[tuple[int, ...]]:
    """Return a key of each history within its task: its stream, and its learner unless that is 0."""
    pairs = zip(selection.column("env_idx").tolist(), selection.column("learner").tolist(), strict=True)
    return [(stream, learner) if learner else (stream,) for stream, learner in pairs]


def _count(share: float, total: int) -> int:
    return max(1, min(round(share * total), total - 1))


def _rank(seed: int, *name: object) -> bytes:
    return hashlib.blake2b(repr((seed, *name)).encode(), digest_size=8).digest()
