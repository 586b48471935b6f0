"""Algorithm Distillation (paper, App. E.2): predict the source algorithm's next action from the preceding history.

Shapes: `B` batch size, `L` length of a window, `D` width, `N` entries of an observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import encoding_metrics
from jaxtyping import Array, Bool, Float, Int

from icrl4aht_baselines.methods.method import (
    Loss,
    Method,
    World,
    apply_if,
    cross_entropy,
    make_next_obs_head,
    make_tokenizer,
    make_transformer,
    mean_of_rows,
    run_model,
    squared_error,
)
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import StepInput, StepTokenizer, Tokenizer, batch_steps
from icrl4aht_data.sampling.ad import ADBatch


class StepOutput(NamedTuple):
    """Output of a `StepModel`.

    Attributes:
        head: output of the model's head, float (B, L, ..).
        next_obs: float (B, L, N), predicted observation after the action; None if the model does not predict it.
    """

    head: Any
    next_obs: Float[Array, "B L N"] | None


class WindowMemory(NamedTuple):
    """Memory of an ego: the tokens of its window, and the trunk's state after them.

    Attributes:
        tokens: float32 (K, D), tokens of the window's steps; further rows are unused.
        steps: int32 (), number of steps in the window.
        trunk: the trunk's state; None if the trunk processes the complete window in every step.
    """

    tokens: Float[Array, "K D"]
    steps: Int[Array, ""]
    trunk: Any


class StepModel(nn.Module):
    """Model of AD, Hybrid-AD, AMAGO-Offline and BC: a tokenizer of steps, a trunk, and a head.

    A trunk takes complete sequences of tokens (B, L, D), or one token at a time by `advance(token, memory)`, with a
    memory from `start(context)` or `start_after(tokens, context)`. A trunk is causal, and padding is at the end of
    sequences, so padding needs no mask except in the loss.
    """

    tokens: Tokenizer
    trunk: Any
    head: nn.Module
    next_obs: nn.Module | None = None

    def __call__(
        self, steps: StepInput, actions: Int[Array, "B L"] | None = None, deterministic: bool = True
    ) -> StepOutput:
        """Return the output for windows of steps, with predicted observations if actions are given."""
        tokens_BxLxD = self.tokens(steps, deterministic)
        features_BxLxD = self.trunk(tokens_BxLxD, deterministic=deterministic)
        predicted = None if self.next_obs is None or actions is None else self.next_obs(features_BxLxD, actions)
        return StepOutput(self.head(features_BxLxD), predicted)

    def start(self, context: int, cached: bool) -> Any:
        """Return the memory of an ego before its first step."""
        states = self.trunk.start(context) if cached else None
        return WindowMemory(jnp.zeros((context, self.tokens.width)), jnp.int32(0), states)

    def act(self, step: StepInput, done: Bool[Array, ""], memory: WindowMemory) -> tuple[Any, WindowMemory]:
        """Return the head's output for one step of an acting ego, and the memory that includes this step."""
        tokens, steps, states = self._drop_oldest_if_full(memory)
        token = self.tokens(step)
        tokens = tokens.at[steps].set(token)
        if states is None:
            feature = self.trunk(tokens[None])[0, steps]
        else:
            feature, states = self.trunk.advance(token, states)
        return self.head(feature), WindowMemory(tokens, steps + 1, states)

    def _drop_oldest_if_full(self, memory: WindowMemory) -> WindowMemory:
        """Return the memory with space for a step: a full window loses its oldest steps.

        The trunk's memory is then computed again from the remaining steps, because it depends on the dropped steps.
        """
        trunk, variables = self.trunk.unbind()
        context = len(memory.tokens)
        kept = context - (1 if memory.trunk is None else dropped_steps(context))

        def drop_oldest(variables: Any, memory: WindowMemory) -> WindowMemory:
            tokens = jnp.roll(memory.tokens, kept - context, axis=0)
            states = None if memory.trunk is None else trunk.start(context)
            if kept and states is not None:
                states = trunk.apply(variables, tokens[:kept], context, method="start_after")
            return WindowMemory(tokens, jnp.int32(kept), states)

        return apply_if(memory.steps == context, drop_oldest, variables, memory)


def dropped_steps(context: int) -> int:
    """Return how many steps an ego with a cached memory drops if its window of `context` steps is full: a fifth.

    After a drop, the other 4/5 of the context are computed again: on average 4 tokens for each step. From then on the
    window never has less than 4/5 of the context.
    """
    return max(1, context // 5)


def make_step_model(
    options: ModelOptions, world: World, trunk: nn.Module, head: nn.Module, tokenizer: type[Tokenizer] = StepTokenizer
) -> StepModel:
    """Return a `StepModel` with the given trunk and head, and a tokenizer of the given class."""
    return StepModel(make_tokenizer(tokenizer, options, world), trunk, head, make_next_obs_head(options, world))


def step_method(name: str, label: str, model: StepModel, loss: Loss, world: World, **settings: Any) -> Method:
    """Return a method that is trained on AD batches, with the given `settings` as further fields of `Method`."""
    example = example_step(world)
    return Method(
        name=name, label=label, data="ad", model=model, example=(example, example.prev_action), loss=loss, **settings
    )


def example_step(world: World) -> StepInput:
    """Return a `StepInput` of zeros with shape (1, 1), for the initialization of parameters."""
    zero = jnp.zeros((1, 1), jnp.int32)
    return StepInput(jnp.zeros((1, 1, *world.obs_shape)), zero, jnp.zeros((1, 1)), zero)


def auxiliary_losses(output: StepOutput, steps: StepInput, batch: ADBatch, world: World) -> dict[str, Array]:
    """Return a dict with the loss of the predicted next observations; an empty dict for a model without +next_obs."""
    if output.next_obs is None:
        return {}
    # A prediction has a target only if the next step is in the same window and the same episode.
    errors = squared_error(output.next_obs[:, :-1], world.observations(steps.obs)[:, 1:])
    valid = jnp.asarray(batch.attention_mask)[:, 1:] & ~jnp.asarray(batch.dones)[:, :-1]
    return {"next_obs_loss": mean_of_rows(errors, valid)}


def action_method(
    name: str,
    label: str,
    options: ModelOptions,
    world: World,
    trunk: nn.Module,
    tokenizer: type[Tokenizer] = StepTokenizer,
) -> Method:
    """Return the method Algorithm Distillation with the given trunk and a tokenizer of the given class.

    The loss is the cross-entropy of the target actions over valid positions (paper, App. E.2). The target actions are
    the actions of the history, or its labels.
    """
    model = make_step_model(options, world, trunk, nn.Dense(world.actions), tokenizer)

    def loss(params: Any, slow: Any, batch: ADBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        steps, mask = batch_steps(batch, world.view), jnp.asarray(batch.attention_mask)
        targets = jnp.asarray(batch.target_actions)
        # A step's action is an input of the next step. The last step has no next step, so the loss ignores it.
        taken = jnp.roll(steps.prev_action, -1, axis=1)
        output: StepOutput = run_model(model, options, params, key, steps, taken)
        errors = cross_entropy(output.head, targets, options.label_smoothing)
        log = {
            "action_loss": mean_of_rows(errors, mask),
            "accuracy": mean_of_rows(1.0 * (output.head.argmax(axis=-1) == targets), mask),
            **(auxiliary := auxiliary_losses(output, steps, batch, world)),
        }
        total = sum(auxiliary.values(), start=log["action_loss"])
        return total, {"loss": total, **log, **encoding_metrics(steps.obs)}

    return step_method(name, label, model, loss, world, logits=lambda head: head)


def ad(options: ModelOptions, world: World) -> Method:
    """Return the method AD; with default options and C = 40 channels its model has 3,283,870 parameters."""
    return action_method("ad", "AD", options, world, make_transformer(options))
