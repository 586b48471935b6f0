"""Checks of option values."""

from __future__ import annotations

import operator
from typing import Any

from icrl4aht_data.errors import OptionError, PositionError, PositionTypeError


def check_int(name: str, value: Any, least: int) -> int:
    """The value as an int, checked to be an integer from `least` to 2**63 - 1.

    Raises:
        OptionError: names the option.
    """
    try:
        number = operator.index(value)
    except TypeError as error:
        raise OptionError(f"{name} = {value!r}: expected an integer") from error
    if not least <= number < 2**63:
        raise OptionError(f"{name} = {number}: expected at least {least} and below 2**63")
    return number


def check_position(sequence: str, position: Any, count: int) -> int:
    """The position of an item as an int, checked to be an integer from -count to count - 1.

    Args:
        sequence: the sequence in words, for the message.
        position: from 0, or from the end if negative.
        count: number of items.

    Raises:
        PositionTypeError: for anything but an integer.
        PositionError: for a position that the sequence does not have.
    """
    try:
        number = operator.index(position)
    except TypeError as error:
        raise PositionTypeError(f"position {position!r} of {sequence}: expected an integer or a slice") from error
    if not -count <= number < count:
        within = f"a number from {-count} to {count - 1}" if count else "no position, as it is empty"
        raise PositionError(f"position {number} of {sequence}: expected {within}")
    return number
