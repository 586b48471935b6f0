"""The protocol that agents and teammates share, and the memory that heuristics keep."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
from jaxtyping import Array, Int, Key

Noise = Literal["fixed", "seeded"]
"""Where a heuristic's randomness comes from: `fixed` is the published PRNGKey(slot) in every episode, so that numbers
compare with the paper's; `seeded` is the episode's own key."""


class Policy(NamedTuple):
    """Anything that can sit at a table: one instance, unbatched; roll-outs vmap it.

    `params` is a pytree of arrays, apart from the functions, so that policies of one family share one compilation.
    `sees` says what `act` is given: the state record uint8 (S,), or the observation uint8 (5, 5, C).
    """

    params: Any
    init: Callable[[Any, Key[Array, ""]], Any]  # (params, episode key) -> carry
    act: Callable[[Any, Any, Array, Key[Array, ""]], tuple[Int[Array, ""], Any]]  # (params, carry, view, key)
    sees: Literal["state", "observation"]


def first_key(noise: Noise, slot: int, key: Key[Array, ""]) -> Key[Array, ""]:
    """The key a heuristic starts an episode with."""
    return jax.random.key(slot) if noise == "fixed" else key


def next_key(key: Key[Array, ""]) -> Key[Array, ""]:
    """One link of a heuristic's key chain."""
    return jax.random.split(key)[0]
