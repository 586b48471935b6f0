"""Names of observation channels, and the canonical channels, which are the same for all layouts.

A layout's own channels depend on its number of ingredient types and on whether it has the delivery channel, so
observations of different layouts can differ in shape. The canonical channels are the union of all layouts' channels;
channels that a layout does not have are 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.cells import CANONICAL_TYPES, WINDOW
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Array, packed_channels

Channels = Literal["own", "canonical"]
CHANNELS: tuple[Channels, ...] = ("own", "canonical")
"""Sets of observation channels: "own" differs between layouts, "canonical" is the same for all layouts."""

CANONICAL_CHANNELS: tuple[str, ...] = tuple(packed_channels(CANONICAL_TYPES, True))
"""Names of the 46 canonical channels, in order, for four ingredient types and the delivery indicator."""


def channel_names(layout: Layout) -> tuple[str, ...]:
    """Return the names of the C observation channels of a layout; the module docstring of `observe` explains them."""
    return tuple(packed_channels(layout.ingredient_types, layout.indicates_delivery))


@lru_cache(maxsize=64)
def canonical_positions(layout: Layout) -> np.ndarray:
    """Return the positions of a layout's own channels in `CANONICAL_CHANNELS`, ascending, as int64 of shape (C,).

    Raises:
        OptionError: if an ingredient has no canonical channel, because no published layout uses it.
    """
    names = channel_names(layout)
    missing = [name for name in names if name not in CANONICAL_CHANNELS]
    if missing:
        raise OptionError(
            f"layout {layout.name}: channels {missing} are not among the {len(CANONICAL_CHANNELS)} canonical channels: "
            f"use own channels, or ingredients with ids below {CANONICAL_TYPES}, which the published layouts have"
        )
    positions = np.array([CANONICAL_CHANNELS.index(name) for name in names])
    positions.flags.writeable = False  # the cached array is shared by all callers
    return positions


def observation_shape(layout: Layout, canonical: bool = False) -> tuple[int, int, int]:
    """Return the shape of an observation: (5, 5, C), or (5, 5, 46) with canonical channels."""
    return (WINDOW, WINDOW, len(CANONICAL_CHANNELS)) if canonical else layout.obs_shape


def to_canonical(layout: Layout, obs: Array) -> Array:
    """Convert observations with a layout's own channels to the canonical channels, in NumPy or JAX.

    The result equals `observe` with canonical=True.

    Args:
        layout: the layout.
        obs: observations of shape (..., C).

    Returns:
        Observations of shape (..., 46).
    """
    xp = obs.__array_namespace__()
    # Canonical channels that the layout does not have are taken from an appended channel of zeros.
    source = np.full(len(CANONICAL_CHANNELS), layout.channels)
    source[canonical_positions(layout)] = np.arange(layout.channels)
    return xp.take(xp.concat([obs, xp.zeros_like(obs[..., :1])], axis=-1), xp.asarray(source), axis=-1)
