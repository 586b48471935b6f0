"""The methods by name, and the benchmark as their world."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from baselines.methods.ad import ad
from baselines.methods.amago_offline import amago_offline
from baselines.methods.dpt import dpt
from baselines.methods.encoder import GridEncoder
from baselines.methods.hybrid_ad import hybrid_ad
from baselines.methods.method import Method, ModelOptions, World
from baselines.methods.tokens import View, state_view
from icrl4aht_data.errors import unknown
from icrl4aht_data.overcooked.layouts import Layout

METHODS: dict[str, Callable[[ModelOptions, World], Method]] = {
    "ad": ad,
    "dpt": dpt,
    "hybrid_ad": hybrid_ad,
    "amago_offline": amago_offline,
}
"""Name -> maker."""


def get_method(name: str) -> Callable[[ModelOptions, World], Method]:
    """The maker of that name.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if name not in METHODS:
        raise unknown("method", name, METHODS)
    return METHODS[name]


def overcooked_world(layouts: Sequence[Layout], view: View | None = None) -> World:
    """OvercookedV2 in layouts with observations of one shape, from batches of state records unless a view is given."""
    return World(lambda dtype: GridEncoder(dtype=dtype), layouts[0].obs_shape, view or state_view(layouts))
