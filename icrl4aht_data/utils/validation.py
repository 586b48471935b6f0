"""Checks of option values."""

from __future__ import annotations

import operator
from typing import Any

from icrl4aht_data.errors import OptionError


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
