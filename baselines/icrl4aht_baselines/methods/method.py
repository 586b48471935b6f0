"""Parts that all methods share: `World`, the interface `Method` for trainer and egos, and losses.

Shapes: `B` batch size, `L` length of a window, `K` length of a context, `A` number of actions, `N` entries of an
observation, `F` features.
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
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, Num

from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import BatchView, StepInput, Tokens
from icrl4aht_baselines.methods.transformer import Transformer
from icrl4aht_data.overcooked.actions import ACTIONS

Loss = Callable[[Any, Any, Any, Any], tuple[Array, dict[str, Array]]]
"""(parameters, slow parameters or None, batch, dropout key or None) -> what to minimise, and numbers to log."""

TokensType = TypeVar("TokensType", bound=Tokens)
Changed = TypeVar("Changed")


class World(NamedTuple):
    """Description of the world that a model acts in.

    Attributes:
        encoder: dtype -> module from observations, or what `view` makes of a batch, to features.
        obs_shape: shape of one observation.
        view: function that returns the encoder's input for a batch.
        actions: number of actions.
        observations: function from the encoder's input (*B, ..) back to observations.
        partners: number of teammates, if the ego is told in every step which one it plays with; otherwise 0.
    """

    encoder: Callable[[Any], nn.Module]
    obs_shape: tuple[int, ...]
    view: BatchView
    actions: int = len(ACTIONS)
    observations: Callable[[Any], Num[Array, "*B ..."]] = lambda seen: seen
    partners: int = 0


@dataclass(frozen=True)
class Method:
    """A method of training: its model, data and loss; a function of (ModelOptions, World) makes it.

    Attributes:
        name: as in `registry.METHODS`.
        label: name in reports.
        data: what it is trained on: batches of the sampler "ad" or "dpt", or "tasks" that it plays.
        model: module with the methods `start` and `act`.
        example: arguments that the model's parameters are made for.
        loss: see `Loss`.
        logits: the policy's logits (*B, A) in the model's output.
        slow: share of the parameters that enters the slow copy each step; 0 for a method without a slow copy.
        takes_labels: whether it can learn labels, actions that others would have taken; DPT needs them.
    """

    name: str
    label: str
    data: Literal["ad", "dpt", "tasks"]
    model: nn.Module
    example: tuple
    loss: Loss
    logits: Callable[[Any], Float[Array, "*B A"]]
    slow: float = 0.0
    takes_labels: bool = True

    def init(self, key: Array) -> Any:
        """Return initial parameters, float32."""
        return jax.jit(self.model.init)(key, *self.example)["params"]

    def start(self, context: int, cached: bool) -> Any:
        """Return the memory of an ego before its first step.

        Args:
            context: K, the steps or transitions that it remembers; older ones do not influence its actions.
            cached: whether the memory keeps what was computed for each step; otherwise it keeps tokens, and each step
                computes the complete context. See `agents.egos.ACTING`.
        """
        return self.model.apply({}, context, cached, method="start")

    def act(self, params: Any, step: StepInput, done: Bool[Array, ""], memory: Any) -> tuple[Float[Array, " A"], Any]:
        """Return policy logits, float32, and the memory after one step; `done`: the step before ended an episode."""
        output, memory = self.model.apply({"params": params}, step, done, memory, method="act")  # type: ignore[misc]
        return self.logits(output).astype(jnp.float32), memory


def compute_dtype(options: ModelOptions) -> Any:
    """Return the dtype of activations."""
    return jnp.bfloat16 if options.bfloat16 else jnp.float32


def make_transformer(options: ModelOptions) -> Transformer:
    """Return the transformer of these options."""
    return Transformer(options.layers, options.width, options.heads, options.dropout, options.positions, options.remat)


def make_tokens(kind: type[TokensType], options: ModelOptions, world: World, **own: Any) -> TokensType:
    """Return a tokenizer of the given class for a world, with further arguments of that class."""
    dtype = compute_dtype(options)
    return kind(
        encoder=world.encoder(dtype),
        width=options.width,
        actions=world.actions,
        teammate_actions=options.teammate_actions,
        dropout=options.dropout,
        dtype=dtype,
        reward_scale=options.reward_scale,
        **own,
    )


class NextObsHead(nn.Module):
    """Prediction of the next observation, flat, from features and the action (paper, App. F, "Auxiliary Loss")."""

    width: int
    actions: int
    size: int

    @nn.compact
    def __call__(self, features: Float[Array, "*B F"], action: Int[Array, "*B"]) -> Float[Array, "*B N"]:
        action = jax.nn.one_hot(action, self.actions, dtype=features.dtype)
        hidden = nn.gelu(nn.Dense(self.width)(jnp.concatenate([features, action], axis=-1)))
        return nn.Dense(self.size)(hidden)


def make_next_obs_head(options: ModelOptions, world: World) -> NextObsHead | None:
    """Return the head of the auxiliary loss, or None without +next_obs."""
    return NextObsHead(options.width, world.actions, int(np.prod(world.obs_shape))) if options.next_obs else None


def squared_error(predicted: Float[Array, "*B N"], obs: Num[Array, "*B ..."]) -> Float[Array, "*B"]:
    """Return the squared error of predicted observations, mean over an observation's entries."""
    target = obs.astype(jnp.float32).reshape(predicted.shape)
    return jnp.square(predicted.astype(jnp.float32) - target).mean(axis=-1)


def cross_entropy(logits: Float[Array, "*B A"], action: Int[Array, "*B"], smoothing: float) -> Float[Array, "*B"]:
    """Return the cross-entropy of actions against a policy, with label smoothing."""
    target = optax.smooth_labels(jax.nn.one_hot(action, logits.shape[-1]), smoothing)
    return optax.softmax_cross_entropy(logits.astype(jnp.float32), target)


def mean_of_rows(values: Float[Array, "B L"], mask: Bool[Array, "B L"]) -> Float[Array, ""]:
    """Return the mean over rows of the mean over each row's valid positions (the paper's 1/|M|).

    Rows weigh the same whatever their padding, so the loss of a batch is the mean of the losses of its parts.
    """
    return (jnp.where(mask, values, 0.0).sum(axis=1) / jnp.maximum(mask.sum(axis=1), 1)).mean()


def run_model(model: nn.Module, options: ModelOptions, params: Any, key: Any, *inputs: Any, **named: Any) -> Any:
    """Return the model's output, computed in the dtype of the options; with dropout if there is a key."""
    dtype = compute_dtype(options)
    params = jax.tree.map(lambda leaf: leaf.astype(dtype), params)
    rngs = {} if key is None else {"dropout": key}
    return model.apply({"params": params}, *inputs, **named, deterministic=key is None, rngs=rngs)


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
