"""Validation of arguments passed to the adapters for other libraries."""

from __future__ import annotations

from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import DTypeLike

from icrl4aht_data.errors import OptionError, unknown_name
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.channels import CHANNELS
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import faults, record_size
from icrl4aht_data.utils.options import check_int

RENDER_MODES = ["rgb_array"]
"""Render modes of the environments: only RGB arrays, which Pillow draws."""


def check_channels_and_render_mode(channels: str, render_mode: str | None = None) -> None:
    """Validate the names of an environment's observation channels and render mode.

    Raises:
        UnknownNameError: if one of the names does not exist.
    """
    for name, value, valid in (("channels", channels, CHANNELS), ("render_mode", render_mode, (None, *RENDER_MODES))):
        if value not in valid:
            raise unknown_name(name, value, map(str, valid))


def check_action(name: str, action: SupportsIndex) -> int:
    """Validate an action and return it as an int.

    Args:
        name: name of the argument, for the message.
        action: number of the action, 0..5.

    Raises:
        OptionError: if the action does not exist.
    """
    number = check_int(name, action, 0)
    if number >= len(ACTIONS):
        raise OptionError(f"{name}: expected 0..{len(ACTIONS) - 1} ({', '.join(ACTIONS)}), found {number}")
    return number


def check_record(layout: Layout, state: Any) -> np.ndarray:
    """Validate a state record of a layout and return it as a uint8 array of shape (S,).

    Raises:
        OptionError: if the shape is wrong, or a value is impossible on this layout.
    """
    record = check_integers("state", state, np.uint8, 255, (record_size(layout),))
    if wrong := faults(layout, record[None]):
        raise OptionError(f"state: expected a state record of {layout.name}, found {wrong[0]}")
    return record


def check_integers(
    name: str, value: Any, dtype: DTypeLike, highest: int, shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """Validate an array of integers and return it in another dtype.

    Args:
        name: name of the argument, for the message.
        value: integers in 0..highest.
        dtype: dtype of the result.
        highest: the largest valid integer.
        shape: the valid shape; by default any shape with one axis.

    Raises:
        OptionError: if the value is not an array of this shape with integers in this range.
    """
    found = np.asarray(value)
    numeric = found.dtype.kind in "iu" and found.size > 0
    fits = (found.ndim == 1 if shape is None else found.shape == shape) and (numeric or found.size == 0)
    if not fits or (numeric and not 0 <= found.min() <= found.max() <= highest):
        values = f" and values {found.min()}..{found.max()}" if numeric else ""
        wanted = "(n,)" if shape is None else shape
        raise OptionError(
            f"{name}: expected integers in 0..{highest} of shape {wanted}, found {found.dtype} of shape "
            f"{found.shape}{values}"
        )
    return found.astype(dtype)
