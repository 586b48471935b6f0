"""Compare trees of arrays bit by bit."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def same_bytes(one: Any, other: Any) -> bool:
    """Return whether all leaves of two trees have the same bytes."""
    pairs = zip(jax.tree.leaves(_with_key_data(one)), jax.tree.leaves(_with_key_data(other)), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def _with_key_data(tree: Any) -> Any:
    """Replace JAX's typed random keys in a tree by their data."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree)
