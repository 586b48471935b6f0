"""RL^2 (Duan et al. 2016): a recurrent policy trained by PPO, with a state that lasts for all episodes of a task.

The model has AD's tokenizer and the interface of the other models. `icrl4aht_baselines.online.rl2` trains it.

Shapes: `B` batch size, `T` steps, `A` actions, `D` width, `S` size of the recurrent state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import orthogonal_dense
from jaxtyping import Array, Bool, Float

from icrl4aht_baselines.methods.ad import example_step
from icrl4aht_baselines.methods.hybrid_ad import RecurrentTrunk
from icrl4aht_baselines.methods.method import Method, World, make_tokenizer
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import StepInput, StepTokenizer


class PolicyValue(NamedTuple):
    """Output of the RL^2 model.

    Attributes:
        logits: float32 (*B, A), logits of the policy.
        value: float32 (*B,), estimated discounted sum of future rewards, which are scaled as in training.
    """

    logits: Float[Array, "*B A"]
    value: Float[Array, "*B"]


class PolicyValueHead(nn.Module):
    """Actor and critic with one hidden layer each, on shared features."""

    width: int
    actions: int

    @nn.compact
    def __call__(self, features: Float[Array, "*B D"]) -> PolicyValue:
        actor = nn.relu(orthogonal_dense(self.width, name="actor_hidden")(features))
        critic = nn.relu(orthogonal_dense(self.width, name="critic_hidden")(features))
        logits = orthogonal_dense(self.actions, 0.01, "actor")(actor).astype(jnp.float32)
        return PolicyValue(logits, orthogonal_dense(1, 1.0, "critic")(critic)[..., 0].astype(jnp.float32))


class RL2Model(nn.Module):
    """Model of RL^2: tokenizer of steps, GRU layers, and head. The recurrent state has S = layers x D numbers."""

    tokens: StepTokenizer
    trunk: RecurrentTrunk
    head: PolicyValueHead

    def __call__(self, steps: StepInput, state: Float[Array, "B S"]) -> tuple[PolicyValue, Float[Array, "B S"]]:
        """Return the output for T steps of B tasks, and the last state. `steps` has the axes (T, B, ..)."""
        features, state = self.trunk.run_sequences(self.tokens(steps), state)
        return self.head(features), state

    def start(self, context: int, cached: bool) -> Float[Array, " S"]:
        """Return the state before a task. The arguments have no effect, since a recurrent state has no window."""
        return self.trunk.start(context)

    def act(
        self, step: StepInput, done: Bool[Array, ""], state: Float[Array, " S"]
    ) -> tuple[PolicyValue, Float[Array, " S"]]:
        """Return the output for one step of one task, and the state after this step."""
        feature, state = self.trunk.advance(self.tokens(step), state)
        return self.head(feature), state


def _raise_no_batch_loss(params: Any, slow: Any, batch: Any, key: Any) -> tuple[Array, dict[str, Array]]:
    raise TypeError("rl2 has no loss on batches: it is trained by playing, see icrl4aht_baselines.online.rl2")


def rl2(options: ModelOptions, world: World) -> Method:
    """Return the method RL^2."""
    trunk = RecurrentTrunk(options.recurrent_layers, options.width, options.dropout)
    tokens = make_tokenizer(StepTokenizer, options, world, partners=world.partners)
    model = RL2Model(tokens, trunk, PolicyValueHead(options.width, world.actions))
    step = example_step(world)
    step = step._replace(partner=step.prev_action if world.partners else None)
    example = (step, jnp.zeros((1, options.recurrent_layers * options.width)))
    return Method(
        name="rl2",
        label="RL2",
        data="tasks",
        model=model,
        example=example,
        loss=_raise_no_batch_loss,
        logits=lambda output: output.logits,
        takes_labels=False,
    )
