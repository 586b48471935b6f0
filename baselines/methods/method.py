"""What the methods share: their options, what they need of a world, and what trainer and egos need of them.

`B` denotes the batch size, `L` the length of a window, `K` the context's, `A` the number of actions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Num

from baselines.methods.tokens import Step, Tokens, View
from baselines.methods.transformer import POSITIONS, Positions, Transformer
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.overcooked.actions import ACTIONS

Loss = Callable[[Any, Any, Any, Any], tuple[Array, dict[str, Array]]]
"""(parameters, slow parameters or None, batch, dropout key or None) -> what to minimise, and what to log."""

SIZES = {"small": (4, 256, 20_000), "medium": (8, 512, 50_000), "large": (12, 768, 100_000)}
"""Name -> layers, width, training steps (paper, Sec. 4.4, "Model Scale and Training Budget")."""


T = TypeVar("T", bound=Tokens)


@dataclass(frozen=True)
class ModelOptions:
    """How a model is built; the defaults are the paper's (App. E.5)."""

    layers: int = 4
    width: int = 256
    heads: int = 4
    recurrent_layers: int = 2  # of Hybrid-AD, in place of the transformer
    dropout: float = 0.1
    positions: Positions = "none"
    teammate_actions: bool = False  # +TA: the teammate's previous action as input
    next_obs: bool = False  # +next_obs: an auxiliary loss, the squared error of the predicted next observation
    label_smoothing: float = 0.0
    discounts: tuple[float, ...] = (0.9, 0.95, 0.99, 0.995)  # of AMAGO-Offline, which acts by the last
    bfloat16: bool = False  # compute in bfloat16; parameters stay float32
    remat: bool = False  # keep less for the backward pass, compute it again

    def __post_init__(self) -> None:
        for name in ("layers", "width", "heads", "recurrent_layers"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: expected at least 1")
        if self.width % (2 * self.heads):
            raise OptionError(f"width = {self.width}: expected a multiple of twice the heads ({2 * self.heads})")
        for name in ("dropout", "label_smoothing"):
            if not 0 <= getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}: expected 0 or more, and below 1")
        if self.positions not in POSITIONS:
            raise unknown("positions", self.positions, POSITIONS)
        if not self.discounts or not all(0 <= discount < 1 for discount in self.discounts):
            raise OptionError(f"discounts = {self.discounts}: expected numbers from 0 to below 1")

    @property
    def dtype(self) -> Any:
        """Of activations."""
        return jnp.bfloat16 if self.bfloat16 else jnp.float32

    def transformer(self) -> Transformer:
        """The transformer of this size."""
        return Transformer(self.layers, self.width, self.heads, self.dropout, self.positions, self.remat)

    def tokens(self, kind: type[T], world: World) -> T:
        """What makes tokens of that kind."""
        encoder = world.encoder(self.dtype)
        return kind(encoder, self.width, world.actions, self.teammate_actions, self.dropout, self.dtype)


class World(NamedTuple):
    """What a model needs to know of where it acts."""

    encoder: Callable[[Any], nn.Module]  # dtype -> encoder
    obs_shape: tuple[int, ...]
    view: View
    actions: int = len(ACTIONS)


@dataclass(frozen=True)
class Method:
    """One way to learn from histories; made by a function of (options, world)."""

    name: str
    label: str  # in tables
    data: Literal["ad", "dpt"]  # which sampler's batches it takes
    model: nn.Module
    example: tuple  # arguments that the model's parameters are made for
    loss: Loss
    logits: Callable[[Any], Float[Array, "*B A"]]  # the policy in the model's output
    slow: float = 0.0  # share of the parameters that goes into the slow copy each step; 0 for a method without one

    def init(self, key: Array) -> Any:
        """Fresh parameters, float32."""
        return jax.jit(self.model.init)(key, *self.example)["params"]

    def start(self, context: int, cached: bool) -> Any:
        """The memory of an ego of K = `context` before its first step.

        `cached` keeps what the trunk computed of each step, O(1) a step; otherwise the window is computed anew.
        """
        return self.model.apply({}, context, cached, method="start")

    def act(self, params: Any, step: Step, done: Bool[Array, ""], memory: Any) -> tuple[Float[Array, " A"], Any]:
        """One step of an ego, after one that ended an episode if `done`: policy logits, memory."""
        output, memory = self.model.apply({"params": params}, step, done, memory, method="act")  # type: ignore[misc]
        return self.logits(output).astype(jnp.float32), memory


class NextObs(nn.Module):
    """What is known and the action taken -> the next observation, flat (+next_obs; paper, App. F, "Auxiliary Loss")."""

    width: int
    actions: int
    size: int

    @nn.compact
    def __call__(self, known: Float[Array, "*B F"], action: Int[Array, "*B"]) -> Float[Array, "*B N"]:
        action = jax.nn.one_hot(action, self.actions, dtype=known.dtype)
        hidden = nn.gelu(nn.Dense(self.width)(jnp.concatenate([known, action], axis=-1)))
        return nn.Dense(self.size)(hidden)


def next_obs_head(options: ModelOptions, world: World) -> NextObs | None:
    """The head of that loss, if it is asked for."""
    return NextObs(options.width, world.actions, int(np.prod(world.obs_shape))) if options.next_obs else None


def squared_error(predicted: Float[Array, "*B N"], obs: Num[Array, "*B ..."]) -> Float[Array, "*B"]:
    """Mean over an observation's entries."""
    target = obs.astype(jnp.float32).reshape(predicted.shape)
    return jnp.square(predicted.astype(jnp.float32) - target).mean(axis=-1)


def cross_entropy(logits: Float[Array, "*B A"], action: Int[Array, "*B"], smoothing: float) -> Float[Array, "*B"]:
    """Of the action that was taken, against the policy."""
    target = optax.smooth_labels(jax.nn.one_hot(action, logits.shape[-1]), smoothing)
    return optax.softmax_cross_entropy(logits.astype(jnp.float32), target)


def mean_of_rows(values: Float[Array, "B L"], mask: Bool[Array, "B L"]) -> Float[Array, ""]:
    """The mean over each row's valid positions (the paper's 1/|M|), then over rows, so that parts of a batch add up."""
    return (jnp.where(mask, values, 0.0).sum(axis=1) / jnp.maximum(mask.sum(axis=1), 1)).mean()


def run_model(method_model: nn.Module, options: ModelOptions, params: Any, key: Any, *inputs: Any, **named: Any) -> Any:
    """The model's output in the options' dtype; with dropout if there is a key."""
    params = jax.tree.map(lambda leaf: leaf.astype(options.dtype), params)
    rngs = {} if key is None else {"dropout": key}
    return method_model.apply({"params": params}, *inputs, **named, deterministic=key is None, rngs=rngs)
