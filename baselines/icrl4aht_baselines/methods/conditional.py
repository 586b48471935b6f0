"""A conditional change of an ego's memory that is computed only when a row of the batch needs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

Changed = TypeVar("Changed")


def change_if(
    condition: Bool[Array, ""], change: Callable[[Any, Changed], Changed], params: Any, memory: Changed
) -> Changed:
    """Return `change(params, memory)` if the condition holds, otherwise the memory.

    `jax.vmap` turns `jax.lax.cond` into a selection, which computes both branches in every step. Here the change is
    computed only in steps in which the condition holds for at least one row of the batch.

    Args:
        condition: bool ().
        change: pure function that uses no other arrays than its arguments, and keeps shapes and dtypes of the memory.
        params: pytree of arrays.
        memory: pytree of arrays.
    """

    @custom_vmap
    def choose(condition: Array, params: Any, memory: Changed) -> Changed:
        return jax.lax.cond(condition, change, lambda params, memory: memory, params, memory)

    @choose.def_vmap
    def choose_rows(rows: int, batched: Any, condition: Array, params: Any, memory: Changed) -> tuple[Changed, Any]:
        def with_rows(array: Array, has_rows: bool) -> Array:
            return array if has_rows else jnp.broadcast_to(array, (rows, *array.shape))

        condition_B = with_rows(condition, batched[0])
        memory = jax.tree.map(with_rows, memory, batched[2])
        axes = jax.tree.map(lambda has_rows: 0 if has_rows else None, batched[1])

        def change_rows(params: Any, memory: Changed) -> Changed:
            def choose_leaf(new: Array, old: Array) -> Array:
                return jnp.where(condition_B.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            return jax.tree.map(choose_leaf, jax.vmap(change, in_axes=(axes, 0))(params, memory), memory)

        memory = jax.lax.cond(condition_B.any(), change_rows, lambda params, memory: memory, params, memory)
        return memory, jax.tree.map(lambda _: True, memory)

    return choose(condition, params, memory)
