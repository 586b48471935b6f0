"""Decoder-only pre-norm transformer (paper, App. E.1), for complete sequences or for one token at a time.

Shapes: `B` batch size, `N` tokens of a sequence, `D` width, `H` heads, `Dh` width of a head (D / H), `S` slots of a
cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from icrl4aht_baselines.methods.attention import causal_attention
from icrl4aht_baselines.methods.options import Positions


class AttentionCache(NamedTuple):
    """Keys and values of earlier tokens in one layer, one slot per token.

    Attributes:
        keys: float32 (H, S, Dh); the slots of a head are contiguous, which makes products per head fastest.
        values: float32 (H, S, Dh).
    """

    keys: Float[Array, "H S Dh"]
    values: Float[Array, "H S Dh"]


class TransformerMemory(NamedTuple):
    """Transformer memory of an acting ego for up to S tokens.

    Attributes:
        caches: one attention cache per layer.
        written: int32 (), number of stored tokens; token i is in slot i.
    """

    caches: tuple[AttentionCache, ...]
    written: Int[Array, ""]


class TransformerBlock(nn.Module):
    """Residual block: attention, then a feed-forward layer of width 4 D with GELU, each after a layer norm.

    Dropout is applied as in the paper, except that it is applied to the outputs of the heads instead of the attention
    weights.
    """

    width: int
    heads: int
    dropout: float
    rope: bool

    def setup(self) -> None:
        self.attention_norm, self.feed_norm = nn.LayerNorm(), nn.LayerNorm()
        self.qkv, self.out = nn.Dense(3 * self.width), nn.Dense(self.width)
        self.up, self.down = nn.Dense(4 * self.width), nn.Dense(self.width)
        self.drop = nn.Dropout(self.dropout)

    def __call__(
        self,
        x_BxNxD: Float[Array, "B N D"],
        positions_N: Int[Array, " N"],
        context: int,
        deterministic: bool,
    ) -> Float[Array, "B N D"]:
        """Return the features of complete sequences; arguments as in `Transformer.__call__`."""
        q, k, v = self._project(x_BxNxD, positions_N)  # each (B, N, H, Dh)
        attended = causal_attention(q[:, :context], k[:, :context], v[:, :context])
        if context < x_BxNxD.shape[1]:
            own = k[:, context:], v[:, context:]
            answers = causal_attention(q[:, context:], k[:, :context], v[:, :context], *own)
            attended = jnp.concatenate([attended, answers], axis=1)
        return self._add_residuals(x_BxNxD, attended, deterministic)

    def step(
        self, x_D: Float[Array, " D"], cache: AttentionCache, number: Int[Array, ""]
    ) -> tuple[Float[Array, " D"], AttentionCache]:
        """Return the features of a token, and the cache that includes this token."""
        q, k, v = (projected[0, 0] for projected in self._project(x_D[None, None], number[None]))  # each (H, Dh)
        cache = AttentionCache(cache.keys.at[:, number].set(k), cache.values.at[:, number].set(v))
        # `jax.nn.dot_product_attention` takes ten times as long for one token on a CPU.
        scores_HxS = jnp.einsum("hd,hsd->hs", q, cache.keys) / q.shape[-1] ** 0.5
        weights_HxS = jax.nn.softmax(scores_HxS, where=jnp.arange(scores_HxS.shape[1]) <= number)
        attended = jnp.einsum("hs,hsd->hd", weights_HxS, cache.values)
        return self._add_residuals(x_D[None, None], attended[None, None], True)[0, 0], cache

    def cache(
        self, x_NxD: Float[Array, "N D"], positions_N: Int[Array, " N"]
    ) -> tuple[Float[Array, "N D"], AttentionCache]:
        """Return the features of one sequence without padding, and a cache of its N keys and values."""
        q, k, v = self._project(x_NxD[None], positions_N)  # each (1, N, H, Dh)
        features = self._add_residuals(x_NxD[None], causal_attention(q, k, v), True)[0]
        return features, AttentionCache(*(part[0].swapaxes(0, 1) for part in (k, v)))

    def _project(self, x_BxNxD: Array, positions_N: Int[Array, " N"]) -> list[Float[Array, "B N H Dh"]]:
        """Return the queries, keys and values of tokens."""
        # The gradient of `split` is a concatenation; that of slices would pad each part with zeros and add them.
        parts = jnp.split(self.qkv(self.attention_norm(x_BxNxD)), 3, axis=-1)
        q, k, v = (part.reshape(*x_BxNxD.shape[:2], self.heads, -1) for part in parts)
        return [_rotate(q, positions_N), _rotate(k, positions_N), v] if self.rope else [q, k, v]

    def _add_residuals(self, x_BxNxD: Array, attended: Float[Array, "B N H Dh"], deterministic: bool) -> Array:
        def drop(y: Array) -> Array:
            return self.drop(y, deterministic=deterministic)

        x_BxNxD = x_BxNxD + drop(self.out(drop(attended.reshape(x_BxNxD.shape))))
        return x_BxNxD + drop(self.down(nn.gelu(self.up(self.feed_norm(x_BxNxD)))))


def _rotate(x_BxNxHxDh: Float[Array, "B N H Dh"], positions_N: Int[Array, " N"]) -> Float[Array, "B N H Dh"]:
    """Apply rotary position embedding: rotate feature pairs by angles proportional to the position (Su et al. 2021)."""
    half = x_BxNxHxDh.shape[-1] // 2
    angle_NxF = positions_N[:, None] * 10_000.0 ** (-jnp.arange(half) / half)
    cos, sin = (f(angle_NxF)[:, None, :].astype(x_BxNxHxDh.dtype) for f in (jnp.cos, jnp.sin))
    one, two = jnp.split(x_BxNxHxDh, 2, axis=-1)
    return jnp.concatenate([one * cos - two * sin, two * cos + one * sin], axis=-1)


class Transformer(nn.Module):
    """Transformer from tokens to features: blocks, followed by a layer norm.

    Args:
        layers: number of blocks.
        width: number of features of a token.
        heads: number of attention heads.
        dropout: dropout rate in training.
        positions: kind of position embedding, see `options.Positions`.
        remat: whether the activations in a block are recomputed in the backward pass instead of stored.
    """

    layers: int = 4
    width: int = 256
    heads: int = 4
    dropout: float = 0.1
    positions: Positions = "none"
    remat: bool = False

    def setup(self) -> None:
        block: Any = TransformerBlock
        if self.remat:
            block = nn.remat(TransformerBlock, static_argnums=(3, 4), methods=["__call__"])
        rope = self.positions == "rope"
        self.blocks = [block(self.width, self.heads, self.dropout, rope) for _ in range(self.layers)]
        self.norm = nn.LayerNorm()

    def __call__(
        self,
        x: Float[Array, "B N D"],
        *,
        context: int | None = None,
        deterministic: bool = True,
    ) -> Float[Array, "B N D"]:
        """Return the features of complete sequences, in which each token attends to itself and the tokens before it.

        Args:
            x: tokens.
            context: if given, the first `context` tokens are a context, followed by `context + 1` queries: query j
                attends to the first j tokens and to itself, with the position after these tokens.
            deterministic: whether dropout is off; otherwise the rng `dropout` is used.
        """
        length = x.shape[1]
        context = length if context is None else context
        positions_N = jnp.concatenate([jnp.arange(context), jnp.arange(length - context)])
        for block in self.blocks:
            x = block(x, positions_N, context, deterministic)
        return self.norm(x)

    def start(self, context: int) -> TransformerMemory:
        """Return an empty memory with `context` slots."""
        zeros = jnp.zeros((self.heads, context, self.width // self.heads))
        return TransformerMemory((AttentionCache(zeros, zeros),) * self.layers, jnp.int32(0))

    def start_after(self, x_NxD: Float[Array, "N D"], context: int) -> TransformerMemory:
        """Return a memory with `context` slots that stores a sequence of tokens."""
        length, caches = len(x_NxD), []
        if not length:  # the context of DPT may be empty
            return self.start(context)
        for block in self.blocks:
            x_NxD, cache = block.cache(x_NxD, jnp.arange(length))
            behind = ((0, 0), (0, context - length), (0, 0))
            caches.append(AttentionCache(*(jnp.pad(part, behind) for part in cache)))
        return TransformerMemory(tuple(caches), jnp.int32(length))

    def advance(
        self, x_D: Float[Array, " D"], memory: TransformerMemory
    ) -> tuple[Float[Array, " D"], TransformerMemory]:
        """Return the features of the next token, and the memory that includes it. The memory must not be full."""
        caches = []
        for block, cache in zip(self.blocks, memory.caches, strict=True):
            x_D, cache = block.step(x_D, cache, memory.written)
            caches.append(cache)
        return self.norm(x_D), TransformerMemory(tuple(caches), memory.written + 1)
