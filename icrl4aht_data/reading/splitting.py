"""Choice of teammates and histories to hold out of training, determined by names and a seed.

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
    """Choose a share of the teammates to hold out: at least one teammate, but none if there is only one teammate.

    Args:
        teammates: strings (H,), the name of each history's teammate.
        share: share of the teammates, between 0 and 1.
        seed: seed of the choice.

    Returns:
        bool (H,): True for the histories with a chosen teammate.
    """
    names = sorted(set(teammates.tolist()), key=lambda name: _rank(seed, name))
    return np.isin(teammates, names[: _held_out_count(share, len(names)) if len(names) > 1 else 0])


def choose_histories(selection: Selection, share: float, seed: int) -> np.ndarray:
    """Choose a share of the histories to hold out: at least one history, but never all histories of a task.

    Args:
        selection: the histories to divide.
        share: share of the histories, between 0 and 1.
        seed: seed of the choice.

    Returns:
        bool (H,): True for the chosen histories.

    Raises:
        OptionError: if every task has only one history.
    """
    names, of_task = selection.index.values("task_id"), defaultdict(list)
    columns = [selection.column_codes("task_id"), selection.column("env_idx"), selection.column("learner")]
    for row, (code, stream, learner) in enumerate(np.stack(columns, axis=1).tolist()):
        # Learner 0 is left out, so that releases with one learner per task keep the same held-out histories.
        name = (names[code], stream, learner) if learner else (names[code], stream)
        of_task[code].append((_rank(seed, *name), row))
    # The history with the highest rank in each task always stays in training.
    candidates = sorted(one for ranked in of_task.values() for one in sorted(ranked)[:-1])
    if not candidates:
        raise OptionError(
            f"every task of {selection!r} has one history: expected a task with two or more histories, one to train "
            f"on and one to hold out"
        )
    chosen = np.zeros(len(selection), bool)
    chosen[[row for _, row in candidates[: _held_out_count(share, len(selection))]]] = True
    return chosen


def _held_out_count(share: float, total: int) -> int:
    return max(1, min(round(share * total), total - 1))


def _rank(seed: int, *name: object) -> bytes:
    return hashlib.blake2b(repr((seed, *name)).encode(), digest_size=8).digest()
