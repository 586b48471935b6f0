"""Registry of methods by name, and the `World` that describes OvercookedV2 to models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from icrl4aht_generation.learners.config import EncoderKind
from icrl4aht_generation.learners.encoder import CompactView, WindowEncoder

from icrl4aht_baselines.methods.ad import ad
from icrl4aht_baselines.methods.amago_offline import amago_offline
from icrl4aht_baselines.methods.bc import bc
from icrl4aht_baselines.methods.dpt import dpt
from icrl4aht_baselines.methods.hybrid_ad import hybrid_ad
from icrl4aht_baselines.methods.method import Method, World
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.rl2 import rl2
from icrl4aht_baselines.methods.tokens import FEATURES, BatchView
from icrl4aht_data.errors import unknown_name
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.plugins import METHOD_GROUP, Plugins

METHODS: dict[str, Callable[[ModelOptions, World], Method]] = {
    "ad": ad,
    "dpt": dpt,
    "hybrid_ad": hybrid_ad,
    "amago_offline": amago_offline,
    "bc": bc,
    "rl2": rl2,
}
"""Name -> function from (ModelOptions, World) to the method. Scripts may add methods."""

METHOD_PLUGINS = Plugins(METHOD_GROUP, METHODS)
"""Methods that other installed packages register; they must learn from histories."""

PLAYING = ("rl2",)
"""Names of the methods that are trained by playing, not on histories."""


def get_method(name: str) -> Callable[[ModelOptions, World], Method]:
    """Return the function that makes a method from (ModelOptions, World).

    Raises:
        UnknownNameError: if the name is unknown; the message lists the valid names.
        PluginError: if another package's method cannot be used; the returned function may raise it as well.
    """
    if name in METHODS:
        return METHODS[name]
    if name not in METHOD_PLUGINS.names:
        raise unknown_name("method", name, all_methods())
    make = METHOD_PLUGINS.load(name, Callable)

    def make_checked(options: ModelOptions, world: World) -> Method:
        method = make(options, world)
        if not isinstance(method, Method) or method.name != name or method.data not in ("ad", "dpt"):
            expected = f"expected a function that returns a Method with name {name!r} and data 'ad' or 'dpt'"
            raise METHOD_PLUGINS.error(name, f"{expected}, found {method!r:.100}")
        return method

    return make_checked


def all_methods() -> list[str]:
    """Return the names of all methods, with those of other packages at the end."""
    return [*METHODS, *METHOD_PLUGINS.names]


def overcooked_world(
    layouts: Sequence[Layout],
    encoder: EncoderKind = "paper",
    view: BatchView | None = None,
    canonical: bool = False,
    partners: int = 0,
) -> World:
    """Return the description of OvercookedV2 that methods need; all layouts must have observations of one shape.

    Args:
        layouts: layouts of the batches.
        encoder: kind of the encoder, see `EncoderKind`.
        view: function that returns the encoder's input for a batch; by default batches hold state records, which are
            converted to the encoder's compact input.
        canonical: whether observations have the canonical channels, which all layouts share, or the layouts' own.
        partners: see `World`.
    """
    compact = CompactView(encoder, tuple(layouts), canonical=canonical)

    def make_encoder(dtype: Any) -> WindowEncoder:
        return WindowEncoder(FEATURES, encoder, view=compact, dtype=dtype)

    obs_shape = observation_shape(layouts[0], canonical)
    return World(make_encoder, obs_shape, view or compact, observations=compact.observations, partners=partners)
