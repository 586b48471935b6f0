"""Causal attention in training, optionally with queries that attend to a context.

Shapes: `B` batch size, `N` tokens, `K` tokens of a context, `H` heads, `Dh` width of a head, `R` rows of a block.
Queries are computed in blocks of rows. For short sequences, a block has `SHORT_ROWS` rows and skips the keys that none
of its rows may attend to. For longer sequences, a block has `LONG_ROWS` rows and is computed again in the backward
pass, so memory grows with LONG_ROWS x N instead of N x N.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

SHORT_ROWS, LONG_ROWS = 64, 512
"""Number of query rows in a block, for short and for long sequences; short ones have up to `LONG_ROWS` tokens."""


def causal_attention(q: Array, k: Array, v: Array, *own: Array) -> Float[Array, "B N H Dh"]:
    """Return causal attention: each token attends to itself and the tokens before it.

    Args:
        q: queries, of shape (B, N, H, Dh).
        k, v: keys and values of the same tokens, of the same shape; with `own`, keys and values of a context, of shape
            (B, K, H, Dh).
        own: if given, keys and values of the queries, both of shape (B, N, H, Dh). Query j then attends to the first j
            tokens of the context and to itself.
    """
    seen_by_first = 0 if own else 1
    q, k, v = (x.swapaxes(1, 2) for x in (q / q.shape[-1] ** 0.5, k, v))
    length, rows = q.shape[2], (q, *(x.swapaxes(1, 2) for x in own))
    if length > LONG_ROWS:
        return _map_long_blocks(seen_by_first, k, v, *rows).swapaxes(1, 2)
    blocks = []
    for first in range(0, length, SHORT_ROWS):
        end = first + SHORT_ROWS
        block = (x[:, :, first:end] for x in rows)
        blocks.append(_attend(jnp.int32(seen_by_first + first), k[:, :, :end], v[:, :, :end], *block))
    return jnp.concatenate(blocks, axis=2).swapaxes(1, 2)


def _map_long_blocks(seen_by_first: int, k: Array, v: Array, *rows: Array) -> Array:
    """Return causal attention of arrays of shape (B, H, N, Dh), computed in blocks of `LONG_ROWS` rows."""
    batch, heads, length, width = rows[0].shape
    blocks = -(-length // LONG_ROWS)
    padding = ((0, 0), (0, 0), (0, blocks * LONG_ROWS - length), (0, 0))
    split = [jnp.moveaxis(jnp.pad(x, padding).reshape(batch, heads, blocks, LONG_ROWS, width), 2, 0) for x in rows]
    # `jax.checkpoint` avoids storing the attention weights of all blocks for the backward pass.
    attend = jax.checkpoint(lambda seen, *block: _attend(seen, k, v, *block))
    found = jax.lax.map(lambda block: attend(*block), (seen_by_first + LONG_ROWS * jnp.arange(blocks), *split))
    return jnp.moveaxis(found, 0, 2).reshape(batch, heads, -1, width)[:, :, :length]


def _attend(
    seen: Array,
    k_BxHxNxDh: Float[Array, "B H N Dh"],
    v_BxHxNxDh: Float[Array, "B H N Dh"],
    q_BxHxRxDh: Float[Array, "B H R Dh"],
    *own_BxHxRxDh: Float[Array, "B H R Dh"],
) -> Float[Array, "B H R Dh"]:
    """Return the attention of a block of rows: row i attends to the first `seen` + i keys.

    The softmax is normalized after the product with the values: R x Dh divisions instead of R x N.
    """
    dtype = q_BxHxRxDh.dtype
    product: Any = partial(
        jnp.einsum,
        precision=jax.lax.DotAlgorithmPreset.BF16_BF16_F32 if dtype == jnp.bfloat16 else None,
        preferred_element_type=jnp.float32,
    )
    visible_RxN = jnp.arange(k_BxHxNxDh.shape[2]) < seen + jnp.arange(q_BxHxRxDh.shape[2])[:, None]
    scores_BxHxRxN = jnp.where(visible_RxN, product("bhrd,bhnd->bhrn", q_BxHxRxDh, k_BxHxNxDh), -jnp.inf)
    largest_BxHxRx1 = scores_BxHxRxN.max(axis=-1, keepdims=True)
    if own_BxHxRxDh:
        own_scores_BxHxRx1 = product("bhrd,bhrd->bhr", q_BxHxRxDh, own_BxHxRxDh[0])[..., None]
        largest_BxHxRx1 = jnp.maximum(largest_BxHxRx1, own_scores_BxHxRx1)
    largest_BxHxRx1 = jax.lax.stop_gradient(largest_BxHxRx1)
    weights_BxHxRxN = jnp.exp(scores_BxHxRxN - largest_BxHxRx1)
    total_BxHxRx1 = weights_BxHxRxN.sum(axis=-1, keepdims=True)
    found_BxHxRxDh = product("bhrn,bhnd->bhrd", weights_BxHxRxN.astype(dtype), v_BxHxNxDh)
    if own_BxHxRxDh:
        own_weights_BxHxRx1 = jnp.exp(own_scores_BxHxRx1 - largest_BxHxRx1)  # type: ignore[possibly-undefined]
        total_BxHxRx1 += own_weights_BxHxRx1
        found_BxHxRxDh += own_weights_BxHxRx1 * own_BxHxRxDh[1]
    return (found_BxHxRxDh / total_BxHxRx1).astype(dtype)
