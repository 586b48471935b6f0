"""The protocol that agents and teammates share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

Noise = Literal["fixed", "seeded"]
"""Source of a heuristic's randomness: `fixed` is the published PRNGKey(slot) in every episode, so that numbers compare
with the paper's; `seeded` is the episode's own key."""


class Policy(NamedTuple):
    """Anything that can play an agent: one instance, unbatched; roll-outs vmap it.

    Attributes:
        params: pytree of arrays, apart from the functions, so that policies of one family share one compilation.
        init: (params, episode key) -> memory at the start of an episode.
        act: (params, memory, view, key) -> action, int32 scalar, and the memory after the step.
        sees: what `view` is: "state", the state record uint8 (S,); "observation", uint8 (5, 5, C); "percept", only for
            egos, the observation with the outcome of the last step (`baselines.agents.egos.Percept`).
    """

    params: Any
    init: Callable[[Any, Key[Array, ""]], Any]
    act: Callable[[Any, Any, Array, Key[Array, ""]], tuple[Int[Array, ""], Any]]
    sees: Literal["state", "observation", "percept"]


def stacked(trees: Iterable[Any]) -> Any:
    """Returns pytrees of one structure stacked on a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
