"""The protocol that agents and teammates share, and the memory that heuristics keep."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

Noise = Literal["fixed", "seeded"]
"""Where a heuristic's randomness comes from: `fixed` is the published PRNGKey(slot) in every episode, so that numbers
compare with the paper's; `seeded` is the episode's own key."""


class Policy(NamedTuple):
    """Anything that can sit at a table: one instance, unbatched; roll-outs vmap it.

    `params` is a pytree of arrays, apart from the functions, so that policies of one family share one compilation.
    `sees` says what `act` is given: the state record uint8 (S,), the observation uint8 (5, 5, C), or, an ego only, the
    observation with what the step before brought (`baselines.agents.egos.Percept`).
    """

    params: Any
    init: Callable[[Any, Key[Array, ""]], Any]  # (params, episode key) -> carry
    act: Callable[[Any, Any, Array, Key[Array, ""]], tuple[Int[Array, ""], Any]]  # (params, carry, view, key)
    sees: Literal["state", "observation", "percept"]


class Sampling(NamedTuple):
    """From what a split's parameters are drawn, where they are not published."""

    presets: tuple[str, ...]
    ranges: dict[str, tuple[float, float] | list[int]]  # (low, high), or the values to choose from


def stacked(trees: Iterable[Any]) -> Any:
    """Pytrees of one shape as one, on a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def as_params(theta: dict[str, float], defaults: dict[str, float]) -> dict[str, Array]:
    """A policy's `params`: int32 where the default is a whole number, else float32."""
    return {name: (jnp.int32 if isinstance(defaults[name], int) else jnp.float32)(theta[name]) for name in defaults}


def first_key(noise: Noise, slot: int, key: Key[Array, ""]) -> Key[Array, ""]:
    """The key a heuristic starts an episode with."""
    return jax.random.key(slot) if noise == "fixed" else key


def next_key(key: Key[Array, ""]) -> Key[Array, ""]:
    """One link of a heuristic's key chain."""
    return jax.random.split(key)[0]


def draw(key: Key[Array, ""]) -> tuple[Key[Array, ""], Float[Array, " 4"]]:
    """The next link of the key chain, and the step's uniform draws u1..u4, float32 in [0, 1)."""
    keys = jax.random.split(key, 5)
    return keys[0], jax.vmap(jax.random.uniform)(keys[1:])


def extra_split(key: Key[Array, ""], where: Bool[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """One more link of the chain where some branch draws more: the chain's key after it, and the key to draw from."""
    link, own = jax.random.split(key)
    return jnp.where(where, link, key), own
