"""Checks of the arguments of `Selection.filter`: functions and learners."""

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
    results = []
    for entry in entries:
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
        results.append(found)
    return np.array(results, bool)


def learner_numbers(wanted: int | Sequence[int]) -> np.ndarray:
    """Return the numbers of one or several learners as an integer array (N,).

    Raises:
        OptionError: for anything else.
    """
    numbers = np.atleast_1d(np.asarray(wanted))
    if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
        raise OptionError(f"learner = {wanted!r}: expected the number of a task's learner, from 0, or several")
    return numbers
