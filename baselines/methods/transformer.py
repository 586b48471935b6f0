"""The one transformer (paper, App. E.1): decoder-only, pre-norm; whole sequences in training, one token when acting.

`B` denotes the batch size, `N` tokens of a sequence, `D` the width, `H` heads, `S` slots of a cache.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from baselines.methods.attention import causal, query_attention

Positions = Literal["none", "rope"]
POSITIONS: tuple[Positions, ...] = ("none", "rope")
"""Where a token stands: not said, as published, or by rotary embedding (Su et al. 2021)."""


class Cache(NamedTuple):
    """One layer's keys and values of earlier tokens, one slot each; a head's stand together."""

    keys: Float[Array, "H S D/H"]
    values: Float[Array, "H S D/H"]

    @property
    def slots(self) -> int:
        """How many tokens it holds."""
        return self.keys.shape[1]


class Memory(NamedTuple):
    """Every layer's cache, used as a ring, and how many tokens have gone into it."""

    caches: tuple[Cache, ...]
    written: Int[Array, ""]


class Block(nn.Module):
    """Attention, then a feed-forward layer of width 4 D with GELU, each behind a layer norm and added to its input.

    Dropout where the paper has it, but for the attention's: `jax.nn.dot_product_attention` offers none on its weights,
    here it falls on the heads' outputs.
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
        positions: Int[Array, " N"],
        context: int,
        lengths: Int[Array, " B"] | None,
        deterministic: bool,
    ) -> Float[Array, "B N D"]:
        """See `Transformer.__call__`."""
        (q, asked_q), (k, asked_k), (v, asked_v) = (
            (x[:, :context], x[:, context:]) for x in self._qkv(x_BxNxD, positions)
        )
        attended = causal(q, k, v, lengths)
        if context < x_BxNxD.shape[1]:
            attended = jnp.concatenate([attended, query_attention(asked_q, asked_k, asked_v, k, v)], axis=1)
        return self._join(x_BxNxD, attended, deterministic)

    def step(
        self,
        x_D: Float[Array, " D"],
        position: Int[Array, ""],
        cache: Cache,
        slot: Int[Array, ""],
        visible: Bool[Array, " S"],
    ) -> tuple[Float[Array, " D"], Cache]:
        """One token, whose key and value are written into a slot of the cache before it attends."""
        q, k, v = self._qkv(x_D[None, None], position[None])
        cache = Cache(cache.keys.at[:, slot].set(k[0, 0]), cache.values.at[:, slot].set(v[0, 0]))
        return self._join(x_D[None, None], _look_up(q[0, 0], cache, visible)[None, None], True)[0, 0], cache

    def _qkv(self, x: Float[Array, "B N D"], positions: Int[Array, " N"]) -> list[Float[Array, "B N H D/H"]]:
        qkv = self.qkv(self.attention_norm(x)).reshape(*x.shape[:2], 3, self.heads, -1)
        q, k, v = (qkv[:, :, i] for i in range(3))
        return [_rotated(q, positions), _rotated(k, positions), v] if self.rope else [q, k, v]

    def _join(self, x: Array, attended: Float[Array, "B N H D/H"], deterministic: bool) -> Array:
        def drop(y: Array) -> Array:
            return self.drop(y, deterministic=deterministic)

        x = x + drop(self.out(drop(attended.reshape(x.shape))))
        return x + drop(self.down(nn.gelu(self.up(self.feed_norm(x)))))


def _look_up(q: Float[Array, "H D/H"], cache: Cache, visible: Bool[Array, " S"]) -> Float[Array, "H D/H"]:
    """One token's attention: `jax.nn.dot_product_attention` takes ten times as long for it on a CPU."""
    scores = jnp.einsum("hd,hsd->hs", q, cache.keys) / q.shape[-1] ** 0.5
    return jnp.einsum("hs,hsd->hd", jax.nn.softmax(scores, where=visible), cache.values)


def _rotated(x: Float[Array, "B N H D"], positions: Int[Array, " N"]) -> Float[Array, "B N H D"]:
    """Each pair of features turned by an angle in proportion to the position."""
    half = x.shape[-1] // 2
    angle = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / half)
    cos, sin = (f(angle)[:, None, :].astype(x.dtype) for f in (jnp.cos, jnp.sin))
    one, two = x[..., :half], x[..., half:]
    return jnp.concatenate([one * cos - two * sin, two * cos + one * sin], axis=-1)


class Transformer(nn.Module):
    """Tokens -> features, with a last layer norm.

    Args:
        layers, width, heads: its size.
        dropout: rate, in training.
        positions: see `POSITIONS`.
        remat: compute a block's inside again in the backward pass instead of keeping it.
    """

    layers: int = 4
    width: int = 256
    heads: int = 4
    dropout: float = 0.1
    positions: Positions = "none"
    remat: bool = False

    def setup(self) -> None:
        block: Any = nn.remat(Block, static_argnums=(3, 5), methods=["__call__"]) if self.remat else Block
        rope = self.positions == "rope"
        self.blocks = [block(self.width, self.heads, self.dropout, rope) for _ in range(self.layers)]
        self.norm = nn.LayerNorm()

    def __call__(
        self,
        x: Float[Array, "B N D"],
        *,
        lengths: Int[Array, " B"] | None = None,
        context: int | None = None,
        deterministic: bool = True,
    ) -> Float[Array, "B N D"]:
        """Whole sequences: every token sees those up to itself.

        Args:
            x: tokens.
            lengths: of each sequence; what is behind is padding.
            context: so many are a context, and behind it stand context + 1 queries: of these, number j sees the first j
                tokens and itself, as if it stood behind them.
            deterministic: False for dropout, under the rng `dropout`.
        """
        length = x.shape[1]
        context = length if context is None else context
        positions = jnp.concatenate([jnp.arange(context), jnp.arange(length - context)])
        for block in self.blocks:
            x = block(x, positions, context, lengths, deterministic)
        return self.norm(x)

    def step(
        self,
        x: Float[Array, " D"],
        caches: tuple[Cache, ...],
        slot: Int[Array, ""],
        position: Int[Array, ""],
        visible: Bool[Array, " S"],
    ) -> tuple[Float[Array, " D"], tuple[Cache, ...]]:
        """One token: it is written into `slot` and sees the `visible` slots, its own among them."""
        after = []
        for block, cache in zip(self.blocks, caches, strict=True):
            x, cache = block.step(x, position, cache, slot, visible)
            after.append(cache)
        return self.norm(x), tuple(after)

    def empty(self, slots: int) -> tuple[Cache, ...]:
        """Caches of so many slots."""
        zeros = jnp.zeros((self.heads, slots, self.width // self.heads))
        return (Cache(zeros, zeros),) * self.layers

    def start(self, context: int) -> Memory:
        """The memory of the last `context` tokens."""
        return Memory(self.empty(context), jnp.int32(0))

    def advance(self, x: Float[Array, " D"], memory: Memory) -> tuple[Float[Array, " D"], Memory]:
        """One more token, in place of the oldest where the memory is full."""
        slots = memory.caches[0].slots
        visible = jnp.arange(slots) <= memory.written
        feature, caches = self.step(x, memory.caches, memory.written % slots, memory.written, visible)
        return feature, Memory(caches, memory.written + 1)
