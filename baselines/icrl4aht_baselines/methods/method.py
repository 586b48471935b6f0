"""Parts that all methods share: the environment's description `World`, the interface `Method`, and losses.

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
from icrl4aht_baselines.methods.tokens import BatchView, StepInput, Tokenizer
from icrl4aht_baselines.methods.transformer import Transformer
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import ACTIONS

Loss = Callable[[Any, Any, Any, Any], tuple[Array, dict[str, Array]]]
"""Function from (parameters, slow parameters or None, batch, dropout key or None) to the loss and numbers to log."""

TokenizerType = TypeVar("TokenizerType", bound=Tokenizer)
Changed = TypeVar("Changed")


class World(NamedTuple):
    """Description of the environment that a model acts in.

    Attributes:
        encoder: function from a dtype to a module, which maps the output of `view` (or observations) to features.
        obs_shape: shape of one observation.
        view: function that returns the encoder's input for a batch.
        actions: number of actions.
        observations: function from the encoder's input (*B, ..) back to observations.
        partners: number of teammates, if the ego observes in every step which one it plays with; otherwise 0.
    """

    encoder: Callable[[Any], nn.Module]
    obs_shape: tuple[int, ...]
    view: BatchView
    actions: int = len(ACTIONS)
    observations: Callable[[Any], Num[Array, "*B ..."]] = lambda seen: seen
    partners: int = 0


@dataclass(frozen=True)
class Method:
    """A training method: model, data and loss. Methods are made by functions that take `ModelOptions` and a `World`.

    Attributes:
        name: name in `registry.METHODS`.
        label: name in reports.
        data: training data: batches of the sampler "ad" or "dpt", or "tasks" for a method that learns by playing.
        model: module with the methods `start` and `act`.
        example: example arguments of the model, to initialize its parameters with.
        loss: loss function, see `Loss`.
        logits: function from the model's output to the policy's logits (*B, A).
        slow: step size of the slow copy of the parameters; 0 for a method without a slow copy.
        takes_labels: whether the method can learn labels, such as expert actions, instead of the histories' actions.
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
        """Return randomly initialized parameters, float32."""
        return jax.jit(self.model.init)(key, *self.example)["params"]

    def start(self, context: int, cached: bool) -> Any:
        """Return the memory of an ego before its first step.

        Args:
            context: K, number of steps or transitions in the memory; older ones do not influence the actions.
            cached: whether the memory stores the results of earlier computations; otherwise the complete context is
                computed in each step. See `agents.egos.ACTING`.
        """
        return self.model.apply({}, context, cached, method="start")

    def act(self, params: Any, step: StepInput, done: Bool[Array, ""], memory: Any) -> tuple[Float[Array, " A"], Any]:
        """Return policy logits, float32, and the new memory; `done` is true if the previous step ended an episode."""
        output, memory = self.model.apply({"params": params}, step, done, memory, method="act")  # type: ignore[misc]
        return self.logits(output).astype(jnp.float32), memory


def compute_dtype(options: ModelOptions) -> Any:
    """Return the dtype of a model's activations."""
    return jnp.bfloat16 if options.bfloat16 else jnp.float32


def make_transformer(options: ModelOptions) -> Transformer:
    """Return a transformer with the architecture of the options.

    Raises:
        OptionError: if the width is not a multiple of twice the number of heads.
    """
    if options.width % (2 * options.heads):
        raise OptionError(f"width = {options.width}: expected a multiple of twice the heads ({2 * options.heads})")
    return Transformer(options.layers, options.width, options.heads, options.dropout, options.positions, options.remat)


def make_tokenizer(kind: type[TokenizerType], options: ModelOptions, world: World, **own: Any) -> TokenizerType:
    """Return a tokenizer of the class `kind`; `own` are arguments that only this class takes."""
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
    """Head that predicts the flat next observation from features and action (paper, App. F, "Auxiliary Loss")."""

    width: int
    actions: int
    size: int

    @nn.compact
    def __call__(self, features: Float[Array, "*B F"], action: Int[Array, "*B"]) -> Float[Array, "*B N"]:
        action = jax.nn.one_hot(action, self.actions, dtype=features.dtype)
        hidden = nn.gelu(nn.Dense(self.width)(jnp.concatenate([features, action], axis=-1)))
        return nn.Dense(self.size)(hidden)


def make_next_obs_head(options: ModelOptions, world: World) -> NextObsHead | None:
    """Return the head that predicts the next observation; None for models without +next_obs."""
    return NextObsHead(options.width, world.actions, int(np.prod(world.obs_shape))) if options.next_obs else None


def squared_error(predicted: Float[Array, "*B N"], obs: Num[Array, "*B ..."]) -> Float[Array, "*B"]:
    """Return the mean squared error of each predicted observation."""
    target = obs.astype(jnp.float32).reshape(predicted.shape)
    return jnp.square(predicted.astype(jnp.float32) - target).mean(axis=-1)


def cross_entropy(logits: Float[Array, "*B A"], action: Int[Array, "*B"], smoothing: float) -> Float[Array, "*B"]:
    """Return the cross-entropy between actions and a policy's logits, with label smoothing."""
    target = optax.smooth_labels(jax.nn.one_hot(action, logits.shape[-1]), smoothing)
    return optax.softmax_cross_entropy(logits.astype(jnp.float32), target)


def mean_of_rows(values: Float[Array, "B L"], mask: Bool[Array, "B L"]) -> Float[Array, ""]:
    """Return the mean of a loss over valid positions in each row (1/|M| in the paper), then over rows.

    All rows have the same weight, so the loss of a batch is the mean of the losses of equally large parts.
    """
    return (jnp.where(mask, values, 0.0).sum(axis=1) / jnp.maximum(mask.sum(axis=1), 1)).mean()


def run_model(model: nn.Module, options: ModelOptions, params: Any, key: Any, *inputs: Any, **named: Any) -> Any:
    """Return the model's output, computed in the dtype of the options, with dropout if `key` is not None."""
    dtype = compute_dtype(options)
    params = jax.tree.map(lambda leaf: leaf.astype(dtype), params)
    rngs = {} if key is None else {"dropout": key}
    return model.apply({"params": params}, *inputs, **named, deterministic=key is None, rngs=rngs)


def apply_if(
    condition: Bool[Array, ""], change: Callable[[Any, Changed], Changed], params: Any, memory: Changed
) -> Changed:
    """Return `change(params, memory)` if the condition holds, otherwise `memory`.

    `jax.vmap` turns `jax.lax.cond` into a selection, which always computes both branches. This function, however,
    computes the change only if the condition holds for at least one row of the batch.

    Args:
        condition: a scalar bool.
        change: pure function of its arguments alone; the result has the shapes and dtypes of `memory`.
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
