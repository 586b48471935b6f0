"""Algorithm Distillation (paper, App. E.2): predict the source algorithm's next action from everything before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from baselines.methods.method import (
    Loss,
    Method,
    ModelOptions,
    World,
    cross_entropy,
    mean_of_rows,
    next_obs_head,
    run_model,
    squared_error,
)
from baselines.methods.tokens import RingBuffer, Step, StepTokens, empty_log, steps_of
from icrl4aht_data.sampling.ad import ADBatch


class StepOutput(NamedTuple):
    """What a model of steps gives."""

    head: Any  # float (B, L, ..)
    next_obs: Float[Array, "B L N"] | None  # with +next_obs: the observation after taking the action


class StepModel(nn.Module):
    """Steps -> tokens -> trunk -> head. AD's, Hybrid-AD's and AMAGO-Offline's: they differ in trunk and head.

    A trunk takes tokens (B, L, D) at once, and one token at a time by `start(context)` and `advance(token, memory)`.
    """

    tokens: StepTokens
    trunk: nn.Module
    head: nn.Module
    next_obs: nn.Module | None = None

    def __call__(
        self,
        steps: Step,
        actions: Int[Array, "B L"] | None = None,
        lengths: Int[Array, " B"] | None = None,
        deterministic: bool = True,
    ) -> StepOutput:
        """Windows of steps, `lengths` of them valid -> the head's output, and a prediction if actions are given."""
        trunk: Any = self.trunk
        tokens = self.tokens(steps, deterministic)
        features = trunk(tokens, lengths=lengths, deterministic=deterministic)
        predicted = None if self.next_obs is None or actions is None else self.next_obs(features, actions)
        return StepOutput(self.head(features), predicted)

    def start(self, context: int, cached: bool) -> Any:
        """The memory of an ego before its first step."""
        trunk: Any = self.trunk
        return trunk.start(context) if cached else empty_log(context, self.tokens.width)

    def act(self, step: Step, done: Bool[Array, ""], memory: Any) -> tuple[Any, Any]:
        """One step of an ego: the head's output, the memory with the step.

        The memory is the trunk's, or a log of tokens, from which all is computed anew.
        """
        trunk: Any = self.trunk
        token = self.tokens(step)
        if isinstance(memory, RingBuffer):
            memory = memory.add(token)
            window, held = memory.last(len(memory.tokens), memory.written)
            return self.head(trunk(window[None])[0, held - 1]), memory
        feature, memory = trunk.advance(token, memory)
        return self.head(feature), memory


def step_model(options: ModelOptions, world: World, trunk: nn.Module, head: nn.Module) -> StepModel:
    """The model with that trunk and head."""
    tokens = options.tokens(StepTokens, world)
    return StepModel(tokens, trunk, head, next_obs_head(options, world))


def example_step(world: World) -> Step:
    """Zeros (1, 1)."""
    none = jnp.zeros((1, 1), jnp.int32)
    return Step(jnp.zeros((1, 1, *world.obs_shape)), none, jnp.zeros((1, 1)), none)


def next_obs_error(predicted: Float[Array, "B L N"], obs: Array, batch: ADBatch) -> Float[Array, ""]:
    """The auxiliary loss: of what followed each step in its episode, where the window shows it."""
    errors = squared_error(predicted[:, :-1], obs[:, 1:])
    return mean_of_rows(errors, jnp.asarray(batch.attention_mask)[:, 1:] & ~jnp.asarray(batch.dones)[:, :-1])


def action_loss(model: StepModel, options: ModelOptions, world: World) -> Loss:
    """Cross-entropy of the actions taken, over valid positions (paper, App. E.2)."""

    def loss(params: Any, slow: Any, batch: ADBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        steps, mask = steps_of(batch, world.view), jnp.asarray(batch.attention_mask)
        actions = jnp.asarray(batch.target_actions)
        output: StepOutput = run_model(model, options, params, key, steps, actions, mask.sum(axis=1))
        total = mean_of_rows(cross_entropy(output.head, actions, options.label_smoothing), mask)
        log = {"action_loss": total, "accuracy": mean_of_rows(1.0 * (output.head.argmax(axis=-1) == actions), mask)}
        if output.next_obs is not None:
            log["next_obs_loss"] = next_obs_error(output.next_obs, steps.obs, batch)
            total += log["next_obs_loss"]
        return total, {"loss": total, **log}

    return loss


def action_method(
    name: str, label: str, trunk: Callable[[ModelOptions], nn.Module]
) -> Callable[[ModelOptions, World], Method]:
    """Algorithm Distillation on a trunk."""

    def make(options: ModelOptions, world: World) -> Method:
        model = step_model(options, world, trunk(options), nn.Dense(world.actions))
        example = example_step(world)
        return Method(
            name=name,
            label=label,
            data="ad",
            model=model,
            example=(example, example.prev_action),
            loss=action_loss(model, options, world),
            logits=lambda head: head,
        )

    return make


ad = action_method("ad", "AD", ModelOptions.transformer)
"""3,283,870 parameters at C = 40."""
