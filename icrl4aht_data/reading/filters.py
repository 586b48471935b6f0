"""Checks of the arguments of `Selection.filter`: functions, learners and returns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.format.schema import ENTRY_HINTS, Entry


def passing(predicate: Callable[[Entry], bool], entries: Iterable[Entry]) -> np.ndarray:
    """Return bool (H,): the result of a function for each index entry.

    Raises:
        OptionError: if it is not a function, or does not return a bool.
        UnknownNameError: if it reads a field that entries do not have; names the nearest one.
    """
    if not callable(predicate):
        raise OptionError(
            f"filter: expected a function of an index entry, such as lambda entry: entry.return_end > 30, found "
            f"{predicate!r}; values have names: filter(layout={str(predicate)!r})"
        )
    return np.array([_passes(predicate, entry) for entry in entries], bool)


def _passes(predicate: Callable[[Entry], bool], entry: Entry) -> bool:
    try:
        found = predicate(entry)
    except AttributeError as error:
        if error.obj is not entry:
            raise
        raise unknown("field of an index entry", error.name, ENTRY_HINTS) from error
    if not isinstance(found, bool | np.bool_):
        raise OptionError(
            f"filter: expected the function to return True or False, such as lambda entry: entry.return_end > 30, "
            f"found {found!r} for history {entry.history_id}"
        )
    return bool(found)


def learner_numbers(wanted: int | Sequence[int]) -> np.ndarray:
    """Return the numbers of one or several learners as an integer array (N,).

    Raises:
        OptionError: for anything else.
    """
    numbers = np.atleast_1d(np.asarray(wanted))
    if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
        raise OptionError(f"learner = {wanted!r}: expected the number of a task's learner, from 0, or several")
    return numbers


def check_return(least: float) -> None:
    """Check that the option `min_expert_return` is a number.

    Raises:
        OptionError: for anything but a number.
    """
    if isinstance(least, bool) or not isinstance(least, (int, float, np.integer, np.floating)) or np.isnan(least):
        raise OptionError(f"min_expert_return = {least!r}: expected a number, the return of an episode")
