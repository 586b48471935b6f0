"""Attention in training: what a token sees is always the first so many tokens, and for a query itself.

`B` denotes the batch size, `N` tokens, `K` those of a context, `H` heads, `D` a head's width. Of long sequences `ROWS`
tokens are computed at a time, and again in the backward pass, so that memory grows with ROWS x N instead of N x N.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

ROWS = 512
"""The paper's usual context of 500 is whole."""


def causal(
    q: Float[Array, "B N H D"],
    k: Float[Array, "B N H D"],
    v: Float[Array, "B N H D"],
    lengths: Int[Array, " B"] | None = None,
) -> Float[Array, "B N H D"]:
    """Each token sees those up to itself; tokens from `lengths` on are padding."""

    def some(first: Int[Array, ""], q: Array) -> Array:
        mask = _first(first + 1, q, k)[None, None]
        return jax.nn.dot_product_attention(q, k, v, mask=mask, key_value_seq_lengths=lengths)

    return _in_parts(some, q)


def query_attention(
    q: Float[Array, "B K+1 H D"],
    own_k: Float[Array, "B K+1 H D"],
    own_v: Float[Array, "B K+1 H D"],
    k: Float[Array, "B K H D"],
    v: Float[Array, "B K H D"],
) -> Float[Array, "B K+1 H D"]:
    """Query j sees the first j tokens of a context, and itself.

    `jax.nn.dot_product_attention` would need all queries among the keys, for each to see one of them.
    """
    narrow = q.dtype == jnp.bfloat16  # as there: products in bfloat16, summed in float32
    precision = jax.lax.DotAlgorithmPreset.BF16_BF16_F32 if narrow else None
    product = partial(jnp.einsum, precision=precision, preferred_element_type=jnp.float32)

    def some(first: Int[Array, ""], q: Array, own_k: Array, own_v: Array) -> Array:
        seen = jnp.where(_first(first, q, k), product("bqhd,bkhd->bhqk", q, k), -jnp.inf)
        own = product("bqhd,bqhd->bhq", q, own_k)[..., None]
        weights = jax.nn.softmax(jnp.concatenate([seen, own], axis=-1) / q.shape[-1] ** 0.5).astype(v.dtype)
        of_context = jnp.einsum("bhqk,bkhd->bqhd", weights[..., :-1], v)
        return of_context + jnp.einsum("bhq,bqhd->bqhd", weights[..., -1], own_v)

    return _in_parts(some, q, own_k, own_v)


def _first(count: Int[Array, ""], q: Array, k: Array) -> Bool[Array, "rows keys"]:
    """The first row sees `count` keys, the next one more, and so on."""
    return jnp.arange(k.shape[1]) < count + jnp.arange(q.shape[1])[:, None]


def _in_parts(some: Callable[..., Array], *rows: Float[Array, "B N H D"]) -> Float[Array, "B N H D"]:
    """`some` of the rows at a time: it is given the first one's number, and the rows."""
    batch, length, *rest = rows[0].shape
    if length <= ROWS:
        return some(jnp.int32(0), *rows)
    parts = -(-length // ROWS)
    padding = ((0, 0), (0, parts * ROWS - length), (0, 0), (0, 0))
    split = [jnp.pad(x, padding).reshape(batch, parts, ROWS, *rest).swapaxes(0, 1) for x in rows]
    found = jax.lax.map(lambda part: jax.checkpoint(some)(*part), (ROWS * jnp.arange(parts), *split))
    return found.swapaxes(0, 1).reshape(batch, parts * ROWS, *rest)[:, :length]
