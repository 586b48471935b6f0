"""Methods by name, and OvercookedV2 as the world they act in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from baselines.methods.ad import ad
from baselines.methods.amago_offline import amago_offline
from baselines.methods.dpt import dpt
from baselines.methods.encoder import FEATURES
from baselines.methods.hybrid_ad import hybrid_ad
from baselines.methods.method import Method, World
from baselines.methods.options import ModelOptions
from baselines.methods.rl2 import rl2
from baselines.methods.tokens import BatchView
from generation.learners.config import EncoderKind
from generation.learners.encoder import CompactView, WindowEncoder
from icrl4aht_data.errors import unknown
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout

METHODS: dict[str, Callable[[ModelOptions, World], Method]] = {
    "ad": ad,
    "dpt": dpt,
    "hybrid_ad": hybrid_ad,
    "amago_offline": amago_offline,
    "rl2": rl2,
}
"""Methods: name -> function from (ModelOptions, World) to the method."""


PLAYING = ("rl2",)
"""Methods that are trained by playing."""


def get_method(name: str) -> Callable[[ModelOptions, World], Method]:
    """Returns the function that makes a method from (ModelOptions, World).

    Raises:
        UnknownNameError: if there is no such method; lists the valid names and the nearest.
    """
    if name not in METHODS:
        raise unknown("method", name, METHODS)
    return METHODS[name]


def overcooked_world(
    layouts: Sequence[Layout],
    encoder: EncoderKind = "paper",
    view: BatchView | None = None,
    canonical: bool = False,
) -> World:
    """Returns the world of OvercookedV2 on layouts with observations of one shape.

    Args:
        layouts: the layouts in batches.
        encoder: kind of the encoder, see `EncoderKind`.
        view: function that returns the observations of a batch; by default the batches hold state records, of which the
            encoder's compact input is made.
        canonical: whether observations have the canonical channels, which all layouts share, or the layouts' own.
    """
    compact = CompactView(encoder, tuple(layouts), canonical=canonical)

    def make_encoder(dtype: Any) -> WindowEncoder:
        return WindowEncoder(FEATURES, encoder, view=compact, dtype=dtype)

    obs_shape = observation_shape(layouts[0], canonical)
    return World(make_encoder, obs_shape, view or compact, observations=compact.observations)
