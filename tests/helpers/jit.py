"""Compilation and comparison of small JAX programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

FAST = {"xla_backend_optimization_level": 0}


def compiled(function: Callable[..., Any]) -> Any:
    """Return `jax.jit(function)` without optimizations, which compiles faster and runs slower."""
    return jax.jit(function, compiler_options=FAST)


def same_bytes(one: Any, other: Any) -> bool:
    """Return whether all leaves of two trees are bit-equal."""
    pairs = zip(jax.tree.leaves(_raw(one)), jax.tree.leaves(_raw(other)), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def _raw(tree: Any) -> Any:
    """Replace typed keys by their data."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree)
