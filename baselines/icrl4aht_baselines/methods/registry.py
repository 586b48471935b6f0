"""Methods by name, and OvercookedV2 as the world they act in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from icrl4aht_generation.learners.config import EncoderKind
from icrl4aht_generation.learners.encoder import CompactView, WindowEncoder

from icrl4aht_baselines.methods.ad import ad
from icrl4aht_baselines.methods.amago_offline import amago_offline
from icrl4aht_baselines.methods.dpt import dpt
from icrl4aht_baselines.methods.hybrid_ad import hybrid_ad
from icrl4aht_baselines.methods.method import Method, World
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.rl2 import rl2
from icrl4aht_baselines.methods.tokens import FEATURES, BatchView
from icrl4aht_data.errors import unknown
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.plugins import METHOD_GROUP, Plugins

METHODS: dict[str, Callable[[ModelOptions, World], Method]] = {
    "ad": ad,
    "dpt": dpt,
    "hybrid_ad": hybrid_ad,
    "amago_offline": amago_offline,
    "rl2": rl2,
}
"""Methods: name -> function from (ModelOptions, World) to the method. Scripts may add theirs."""

METHOD_PLUGINS = Plugins(METHOD_GROUP, METHODS)
"""Methods of other installed packages, which are trained on histories."""

PLAYING = ("rl2",)
"""Methods that are trained by playing."""


def get_method(name: str) -> Callable[[ModelOptions, World], Method]:
    """Return the function that makes a method from (ModelOptions, World).

    Raises:
        UnknownNameError: if there is no such method; lists the valid names and the nearest.
        PluginError: if a registered method cannot be used; also raised by the returned function.
    """
    if name in METHODS:
        return METHODS[name]
    if name not in METHOD_PLUGINS.names:
        raise unknown("method", name, all_methods())
    make = METHOD_PLUGINS.load(name, Callable)

    def make_checked(options: ModelOptions, world: World) -> Method:
        method = make(options, world)
        if not isinstance(method, Method):
            raise METHOD_PLUGINS.error(name, f"expected a function that returns a Method, it returned {method!r:.100}")
        if method.name != name or method.data not in ("ad", "dpt"):
            raise METHOD_PLUGINS.error(
                name,
                f"expected name {name!r} and data 'ad' or 'dpt', found name {method.name!r} and data {method.data!r}",
            )
        return method

    return make_checked


def all_methods() -> list[str]:
    """Return the names of all methods, those of other packages last."""
    return [*METHODS, *METHOD_PLUGINS.names]


def overcooked_world(
    layouts: Sequence[Layout],
    encoder: EncoderKind = "paper",
    view: BatchView | None = None,
    canonical: bool = False,
    partners: int = 0,
) -> World:
    """Return the world of OvercookedV2 on layouts with observations of one shape.

    Args:
        layouts: the layouts in batches.
        encoder: kind of the encoder, see `EncoderKind`.
        view: function that returns the observations of a batch; by default the batches hold state records, of which the
            encoder's compact input is made.
        canonical: whether observations have the canonical channels, which all layouts share, or the layouts' own.
        partners: see `World`.
    """
    compact = CompactView(encoder, tuple(layouts), canonical=canonical)

    def make_encoder(dtype: Any) -> WindowEncoder:
        return WindowEncoder(FEATURES, encoder, view=compact, dtype=dtype)

    obs_shape = observation_shape(layouts[0], canonical)
    return World(make_encoder, obs_shape, view or compact, observations=compact.observations, partners=partners)
