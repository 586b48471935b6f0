"""For tests of JAX programs that are small, so that compiling is their cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

FAST = {"xla_backend_optimization_level": 0}


def compiled(function: Callable[..., Any]) -> Any:
    """`jax.jit` that compiles in less time what then runs slower."""
    return jax.jit(function, compiler_options=FAST)


def same_bytes(one: Any, other: Any) -> bool:
    """Whether all leaves of two trees are bit-equal."""
    pairs = zip(jax.tree.leaves(_raw(one)), jax.tree.leaves(_raw(other)), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def _raw(tree: Any) -> Any:
    """Typed keys as their words."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree)
