"""Attention in training, for sequences of a context and of queries about it.

Shapes: `B` batch size, `N` tokens, `K` tokens of a context, `H` heads, `Dh` width of a head. Sequences longer than
`ROWS` tokens are computed `ROWS` query rows at a time, and again in the backward pass, so that memory grows with
ROWS x N instead of N x N.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

ROWS = 512
"""Query rows computed at once; the paper's usual context of 500 fits."""


def causal_attention(
    q_BxNxHxDh: Float[Array, "B N H Dh"],
    k_BxNxHxDh: Float[Array, "B N H Dh"],
    v_BxNxHxDh: Float[Array, "B N H Dh"],
    lengths_B: Int[Array, " B"] | None = None,
) -> Float[Array, "B N H Dh"]:
    """Returns attention in which each token sees those up to itself; tokens from `lengths_B` on are padding."""

    def attend(first: Int[Array, ""], q_BxRxHxDh: Array) -> Array:
        mask_1x1xRxN = _visible_keys(first + 1, q_BxRxHxDh, k_BxNxHxDh)[None, None]
        return jax.nn.dot_product_attention(
            q_BxRxHxDh, k_BxNxHxDh, v_BxNxHxDh, mask=mask_1x1xRxN, key_value_seq_lengths=lengths_B
        )

    return _map_row_blocks(attend, q_BxNxHxDh)


def query_attention(
    q_BxQxHxDh: Float[Array, "B K+1 H Dh"],
    own_k_BxQxHxDh: Float[Array, "B K+1 H Dh"],
    own_v_BxQxHxDh: Float[Array, "B K+1 H Dh"],
    k_BxKxHxDh: Float[Array, "B K H Dh"],
    v_BxKxHxDh: Float[Array, "B K H Dh"],
) -> Float[Array, "B K+1 H Dh"]:
    """Returns attention in which query j sees the first j tokens of a context, and itself.

    `jax.nn.dot_product_attention` would need all queries among the keys, although each sees only one of them.
    """
    narrow = q_BxQxHxDh.dtype == jnp.bfloat16  # as in JAX's attention: bfloat16 products, summed in float32
    precision = jax.lax.DotAlgorithmPreset.BF16_BF16_F32 if narrow else None
    product = partial(jnp.einsum, precision=precision, preferred_element_type=jnp.float32)

    def attend(first: Int[Array, ""], q: Array, own_k: Array, own_v: Array) -> Array:
        visible_RxK = _visible_keys(first, q, k_BxKxHxDh)
        scores_BxHxRxK = jnp.where(visible_RxK, product("bqhd,bkhd->bhqk", q, k_BxKxHxDh), -jnp.inf)
        own_scores_BxHxRx1 = product("bqhd,bqhd->bhq", q, own_k)[..., None]
        # One softmax over the context and the query itself, which is the last column.
        scores = jnp.concatenate([scores_BxHxRxK, own_scores_BxHxRx1], axis=-1) / q.shape[-1] ** 0.5
        weights = jax.nn.softmax(scores).astype(own_v.dtype)
        context_part = jnp.einsum("bhqk,bkhd->bqhd", weights[..., :-1], v_BxKxHxDh)
        return context_part + jnp.einsum("bhq,bqhd->bqhd", weights[..., -1], own_v)

    return _map_row_blocks(attend, q_BxQxHxDh, own_k_BxQxHxDh, own_v_BxQxHxDh)


def _visible_keys(count: Int[Array, ""], q: Array, k: Array) -> Bool[Array, "R N"]:
    """Returns a mask whose first row shows `count` keys, the next one more, and so on."""
    return jnp.arange(k.shape[1]) < count + jnp.arange(q.shape[1])[:, None]


def _map_row_blocks(attend: Callable[..., Array], *rows_BxNxHxDh: Float[Array, "B N H Dh"]) -> Float[Array, "B N H Dh"]:
    """Applies `attend(first, *rows)` to `ROWS` rows at a time; `first` is the number of the first row."""
    batch, length, *rest = rows_BxNxHxDh[0].shape
    if length <= ROWS:
        return attend(jnp.int32(0), *rows_BxNxHxDh)
    blocks = -(-length // ROWS)
    padding = ((0, 0), (0, blocks * ROWS - length), (0, 0), (0, 0))
    split = [jnp.pad(x, padding).reshape(batch, blocks, ROWS, *rest).swapaxes(0, 1) for x in rows_BxNxHxDh]
    # The checkpoint keeps a block's weights, ROWS x N, out of what the backward pass stores.
    found = jax.lax.map(lambda block: jax.checkpoint(attend)(*block), (ROWS * jnp.arange(blocks), *split))
    return found.swapaxes(0, 1).reshape(batch, blocks * ROWS, *rest)[:, :length]
