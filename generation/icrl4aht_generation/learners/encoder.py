"""Encoder of observations for learners and sequence models: convolutions, or a dense layer on flat observations.

Inputs are observations, or a compact form of them. An encoder has the same parameters for both, and equal results up to
the order of summation. Convolutions take a `WordWindow`: a 1 x 1 convolution sees one cell, so it is computed once per
word, which is a possible content of a cell. The dense layer takes `WindowEntries`: most entries of an agent's flat
window are always 0, because the agent stays in its room. B denotes the batch dimensions.

Convolutions are matrix products: a 3 x 3 SAME convolution of a 5 x 5 patch is one dense matrix built from its kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, UInt8

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.cells import VISIBLE, WINDOW
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.words import CellWords, cell_words
from icrl4aht_generation.learners.config import EncoderKind

MLP_WIDTH = 64
"""Width of the first dense layer of encoder `mlp`."""


class WordWindow(NamedTuple):
    """Observations as word ids, one for the content of each visible cell.

    Attributes:
        ids: int32 (*B, 25), see `CellWords.ids`.
    """

    ids: Int[Array, "*B 25"]


class WindowEntries(NamedTuple):
    """Flat observations without the entries that are always 0.

    Attributes:
        values: uint8 (*B, E), see `CellWords.entries`.
    """

    values: UInt8[Array, "*B E"]


class GroupedWords(NamedTuple):
    """Observations as word ids of cells, in groups of equal observations that are encoded only once.

    N denotes the number of observations, the product of the batch dimensions B.

    Attributes:
        ids: int32 (*B, 25), see `CellWords.ids`.
        first: int32 (N,), index of one observation of each group, padded with zeros.
        group: int32 (*B,), the group of each observation.
        groups: int32 (), number of groups.
    """

    ids: Int[Array, "*B 25"]
    first: Int[Array, " N"]
    group: Int[Array, "*B"]
    groups: Int[Array, ""]


Seen = Num[Array, "*B 5 5 C"] | WordWindow | GroupedWords | WindowEntries
"""Input of an encoder: observations, uint8 or float, or one of their compact forms."""

_BLOCKS = 4
"""Number of blocks in which grouped observations are encoded; blocks without groups are skipped."""


@dataclass(frozen=True)
class CompactView:
    """Converter of state records or observations to the encoder's inputs: for kind `paper` these are observations.

    Attributes:
        kind: kind of the encoder.
        layouts: layouts of the records.
        agents: observing agents, 0 (ego) or 1 (teammate). In each record, the observing agent comes first.
        canonical: whether observations have the canonical channels instead of the layouts' channels.
    """

    kind: EncoderKind
    layouts: tuple[Layout, ...]
    agents: tuple[int, ...] = (EGO,)
    canonical: bool = False

    @property
    def words(self) -> CellWords:
        """Words of the layouts: the possible contents of a visible cell."""
        return cell_words(self.layouts, self.canonical)

    @property
    def channels(self) -> int:
        """Number C of channels of an observation."""
        return self.words.channels.shape[-1]

    @property
    def entries(self) -> np.ndarray:
        """Indices of the E entries of a flat observation that are not always 0, int32; see `WindowEntries`."""
        return self.words.entries(self.agents)

    def __call__(self, record: UInt8[Array, "*B S"], layout_number: Array | None = None) -> Seen:
        """Return the encoder's input for state records; several layouts need `layout_number`, see `CellWords.ids`."""
        batch = record.shape[:-1]
        if self.kind == "words":
            return WordWindow(self.words.ids(record, layout_number))
        if layout_number is None:
            obs: Any = observe(self.layouts[0], record, EGO, self.canonical)
        else:
            # XLA on CPUs would compute a cell's word again for each channel, if this product did not store the words.
            ids = self.words.ids(record, layout_number) @ np.eye(VISIBLE, dtype=np.int32)
            obs = jnp.asarray(self.words.channels)[ids]
            obs = obs.reshape(*batch, WINDOW, WINDOW, self.channels)
        return self.compact(obs)

    def compact(self, obs: Num[Array, "*B 5 5 C"]) -> Seen:
        """Convert observations to `WindowEntries` for `mlp`, and return them unchanged for other kinds of encoder."""
        return WindowEntries(obs.reshape(*obs.shape[:-3], -1)[..., self.entries]) if self.kind == "mlp" else obs

    def observations(self, seen: Seen) -> Num[Array, "*B 5 5 C"]:
        """Convert an encoder's input back to observations."""
        if isinstance(seen, (WordWindow, GroupedWords)):
            flat = jnp.asarray(self.words.channels)[seen.ids]
        elif isinstance(seen, WindowEntries):
            zeros = jnp.zeros((*seen.values.shape[:-1], VISIBLE * self.channels), seen.values.dtype)
            flat = zeros.at[..., self.entries].set(seen.values)
        else:
            return seen
        return flat.reshape(*jax.tree.leaves(seen)[0].shape[:-1], WINDOW, WINDOW, self.channels)


def group_equal(seen: Seen) -> Seen:
    """Group equal observations of an input of kind `WordWindow`, and return any other input unchanged.

    Observations are sorted by a hash, and then compared exactly: if different observations have equal hashes, every
    observation becomes a separate group. Sorting needs all observations on one device, so with several devices nothing
    is grouped.
    """
    if not isinstance(seen, WordWindow) or jax.device_count() > 1:
        return seen
    shape, ids = seen.ids.shape[:-1], jnp.asarray(seen.ids).reshape(-1, VISIBLE)
    number = jnp.arange(len(ids), dtype=jnp.int32)
    *hashes, order = jax.lax.sort((*_hash_words(ids), number), num_keys=2)
    # Rows with equal hashes are now adjacent, so a group starts where a hash changes.
    starts = jnp.append(True, (jnp.diff(hashes[0]) != 0) | (jnp.diff(hashes[1]) != 0))
    group_of_sorted = jnp.cumsum(starts, dtype=jnp.int32) - 1
    group = jnp.zeros_like(number).at[order].set(group_of_sorted, unique_indices=True)
    first = jnp.zeros_like(number).at[jnp.where(starts, group_of_sorted, len(ids))].set(order, mode="drop")
    # This test detects different observations with equal hashes, which would otherwise be merged silently.
    exact = (ids[first[group]] == ids).all()
    first, group = (jnp.where(exact, found, number) for found in (first, group))
    count = jnp.where(exact, group_of_sorted[-1] + 1, len(ids))
    return GroupedWords(ids.reshape(*shape, VISIBLE), first, group.reshape(shape), count)


def _hash_words(ids: Int[Array, "N 25"]) -> tuple[Array, Array]:
    """Return two hashes of each row, uint32 of shape (N,): sums of the word ids times random odd numbers."""
    # A product with an odd factor loses no bits, because odd numbers are invertible modulo 2**32.
    factors = np.random.default_rng(0).integers(2**31, size=(2, VISIBLE), dtype=np.uint32) * 2 + 1
    one, two = ((ids.astype(jnp.uint32) * row).sum(axis=-1, dtype=jnp.uint32) for row in factors)
    return one, two


def encoding_metrics(seen: Seen) -> dict[str, Array]:
    """Return metrics of an encoder's input for the log: the share of distinct observations, if known."""
    return {"distinct_observations": seen.groups / seen.group.size} if isinstance(seen, GroupedWords) else {}


class WindowEncoder(nn.Module):
    """Maps each observation to features (paper, App. B.1 and E.1).

    Args:
        features: width of the result.
        kind: how observations are encoded, see `EncoderKind`.
        pointwise: widths of the 1 x 1 convolutions of kinds `paper` and `words`.
        spatial: widths of the 3 x 3 convolutions of kinds `paper` and `words`.
        normalize: whether ReLU and a layer norm follow the last dense layer, as in learners.
        view: view that computes the compact inputs; None if all inputs are observations.
        dtype: dtype of the computation.
    """

    features: int
    kind: EncoderKind = "paper"
    pointwise: tuple[int, ...] = (128, 128, 8)
    spatial: tuple[int, ...] = (16, 32, 32)
    normalize: bool = False
    view: CompactView | None = None
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, seen: Seen) -> Float[Array, "*B F"]:
        if isinstance(seen, GroupedWords):
            return self._encode_groups(seen)
        if self.kind == "mlp":
            x = nn.relu(FlatDense(MLP_WIDTH, self.view, self.dtype)(seen))
        else:
            x = self._encode_cells(seen)
            batch = x.shape[:-2]
            x = x.reshape(-1, VISIBLE * x.shape[-1])
            for width in self.spatial:
                x = nn.relu(Conv3x3(width)(x))
            x = x.reshape(*batch, x.shape[-1])
        x = orthogonal_dense(self.features)(x)
        return nn.LayerNorm()(nn.relu(x)) if self.normalize else x

    def _encode_groups(self, seen: GroupedWords) -> Float[Array, "*B F"]:
        """Return the features of all observations by encoding one observation of each group."""
        # Flax modules cannot be called inside `cond` and `scan`; an unbound clone with explicit variables can.
        encoder, variables = self.clone(parent=None), self.variables
        size = -(-len(seen.first) // _BLOCKS)
        rows = jnp.pad(seen.first, (0, _BLOCKS * size - len(seen.first))).reshape(_BLOCKS, size)
        ids = seen.ids.reshape(-1, VISIBLE)[rows]

        def encode(variables: Any, ids: Array) -> Array:
            features: Any = encoder.apply(variables, WordWindow(ids))
            return features

        shape = jax.eval_shape(encode, variables, ids[0])

        def encode_block(_: None, block: tuple[Array, Array]) -> tuple[None, Array]:
            number, ids = block
            nothing = jnp.zeros(shape.shape, shape.dtype)
            return None, jax.lax.cond(number * size < seen.groups, encode, lambda *_: nothing, variables, ids)

        _, features = jax.lax.scan(encode_block, None, (jnp.arange(_BLOCKS), ids))
        return features.reshape(-1, self.features)[seen.group]

    def _encode_cells(self, seen: Num[Array, "*B 5 5 C"] | WordWindow | WindowEntries) -> Float[Array, "*B 25 F"]:
        """Apply the 1 x 1 convolutions to each cell; contents that the rules cannot produce become NaN."""
        if isinstance(seen, WordWindow):
            x = jnp.asarray(_required_view(self.view).words.channels, self.dtype)
        else:
            obs: Any = seen
            x = obs.reshape(*obs.shape[:-3], VISIBLE, obs.shape[-1]).astype(self.dtype)
        for width in self.pointwise:
            x = nn.relu(orthogonal_dense(width)(x))
        return x.at[-1].set(jnp.nan)[seen.ids] if isinstance(seen, WordWindow) else x


class FlatDense(nn.Module):
    """Dense layer on flat observations; the kernel has a row for each of 25 * C entries, also for compact inputs.

    Rows of entries that are always 0 in `view` start as zeros: these rows have no gradient, and random rows would
    add noise on other layouts.
    """

    features: int
    view: CompactView | None = None
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, seen: Seen) -> Float[Array, "*B F"]:
        if isinstance(seen, WindowEntries):
            x, rows = seen.values, VISIBLE * _required_view(self.view).channels
        else:
            obs: Any = seen
            x = obs.reshape(*obs.shape[:-3], -1)
            rows = x.shape[-1]
        kernel = self.param("kernel", self._initial_kernel, (rows, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        if isinstance(seen, WindowEntries):
            kernel = kernel[_required_view(self.view).entries]
        return x.astype(self.dtype) @ kernel + bias

    def _initial_kernel(self, key: Array, shape: tuple[int, int]) -> Array:
        kernel = nn.initializers.orthogonal(2**0.5)(key, shape)  # scale the kernel before any rows become zero
        if self.view is None:
            return kernel
        varies = np.zeros((shape[0], 1), bool)
        varies[self.view.entries] = True
        return jnp.where(varies, kernel, 0)


class Conv3x3(nn.Module):
    """A 3 x 3 SAME convolution of flat 5 x 5 patches, from shape (B, 25 * c_in) to shape (B, 25 * features)."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "B _"]) -> Float[Array, "B _"]:
        channels = x.shape[-1] // VISIBLE
        kernel = self.param("kernel", nn.initializers.orthogonal(2**0.5), (3, 3, channels, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        # Position 9 is zero, for pairs of cells that are more than one cell apart.
        weights = jnp.concatenate([kernel.reshape(9, channels, self.features), jnp.zeros_like(kernel[:1, 0])])
        matrix = weights[_kernel_position_of_cells()].transpose(0, 2, 1, 3)
        return x @ matrix.reshape(VISIBLE * channels, VISIBLE * self.features) + jnp.tile(bias, VISIBLE)


def _kernel_position_of_cells() -> np.ndarray:
    """Return the position in the kernel for each pair of input and output cells, (25, 25); 9 for distant pairs."""
    cell = np.arange(VISIBLE)
    dy = cell[:, None] // WINDOW - cell // WINDOW + 1
    dx = cell[:, None] % WINDOW - cell % WINDOW + 1
    near = (dy >= 0) & (dy < 3) & (dx >= 0) & (dx < 3)
    return np.where(near, dy * 3 + dx, 9)


def orthogonal_dense(width: int, scale: float = 2**0.5, name: str | None = None) -> nn.Dense:
    """Return a dense layer with orthogonal initial weights of a given scale."""
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(scale), name=name)


def _required_view(view: CompactView | None) -> CompactView:
    if view is None:
        raise TypeError("a compact input needs the argument `view`, found None")
    return view
