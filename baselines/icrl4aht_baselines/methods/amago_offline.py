"""AMAGO-Offline (paper, Sec. 5.4): an offline actor-critic on the sequence encoder.

As in AMAGO (Grigsby et al. 2024), actor and critics share the encoder, and there is one policy and one value for each
of several discount factors; the ego acts with the last policy. Returns continue over episodes, so exploration that
helps in later episodes is rewarded. The actor imitates the actions with a positive estimated advantage (filtered
behaviour cloning), and maximizes the expected value of its policy (Q term). The critics learn by one-step bootstrapping
from a slow copy of the parameters. The model does not observe how far the source algorithm's training had progressed.

Shapes: `B` batch size, `L` length of a window, `G` discount factors, `A` actions, `D` width.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import encoding_metrics
from jaxtyping import Array, Float

from icrl4aht_baselines.methods.ad import StepOutput, auxiliary_losses, make_step_model, step_method
from icrl4aht_baselines.methods.method import Method, World, cross_entropy, make_transformer, mean_of_rows, run_model
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import batch_steps
from icrl4aht_data.sampling.ad import ADBatch

CRITICS = 2
"""Number of critics. The lowest of their estimates is used (clipped double Q-learning)."""

REWARD_SCALE = 0.05
"""Factor of the rewards: a delivery earns 20 points, so values count deliveries."""

Q_WEIGHT, CRITIC_WEIGHT, SLOW = 0.1, 1.0, 0.005
"""Weight of the Q term, weight of the critics' loss, and step size of the slow copy of the parameters."""


class ActorCriticOutput(NamedTuple):
    """Policy logits and action values for each of G discount factors.

    Attributes:
        logits: float32, of shape (*B, G, A).
        values: float32, of shape (CRITICS, *B, G, A).
    """

    logits: Float[Array, "*B G A"]
    values: Float[Array, "critics *B G A"]


class ActorCriticHead(nn.Module):
    """Actor and critics with one hidden layer each, on shared features."""

    width: int
    discounts: int
    actions: int

    @nn.compact
    def __call__(self, features: Float[Array, "*B D"]) -> ActorCriticOutput:
        def head(name: str) -> Array:
            hidden = nn.gelu(nn.Dense(self.width, name=f"{name}_hidden")(features))
            out = nn.Dense(self.discounts * self.actions, name=name)(hidden).astype(jnp.float32)
            return out.reshape(*features.shape[:-1], self.discounts, self.actions)

        return ActorCriticOutput(head("actor"), jnp.stack([head(f"critic_{number}") for number in range(CRITICS)]))


def amago_offline(options: ModelOptions, world: World) -> Method:
    """Return the method AMAGO-Offline, with AD's tokenizer and transformer."""
    head = ActorCriticHead(options.width, len(options.discounts), world.actions)
    model = make_step_model(options, world, make_transformer(options), head)
    discounts_G = jnp.asarray(options.discounts)

    def loss(params: Any, slow: Any, batch: ADBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        steps, mask = batch_steps(batch, world.view), jnp.asarray(batch.attention_mask)
        actions = jnp.asarray(batch.target_actions)
        output: StepOutput = run_model(model, options, params, key, steps, actions)
        online: ActorCriticOutput = output.head
        target: ActorCriticOutput = run_model(model, options, slow, None, steps).head
        policy_BxLxGxA = jax.nn.softmax(online.logits)
        taken_BxLx1xA = jax.nn.one_hot(actions, world.actions)[:, :, None]

        # Critics' target: r + discount * E[Q_slow(next)] under the policy. The next step's input contains the reward r.
        next_value = jnp.sum(jax.lax.stop_gradient(policy_BxLxGxA) * target.values.min(axis=0), axis=-1)[:, 1:]
        reward = REWARD_SCALE * jnp.asarray(batch.prev_rewards)[:, 1:, None]
        bootstrap = jax.lax.stop_gradient(reward + discounts_G * next_value)  # (B, L - 1, G)
        error = jnp.square(jnp.sum(online.values * taken_BxLx1xA, axis=-1)[:, :, :-1] - bootstrap)
        critic = mean_of_rows(error.mean(axis=(0, -1)), mask[:, 1:])

        # Actor: imitate actions with a value above the policy's expected value, and maximize that expected value.
        values_BxLxGxA = jax.lax.stop_gradient(online.values.min(axis=0))
        baseline_BxLxG = jnp.sum(policy_BxLxGxA * values_BxLxGxA, axis=-1)
        better = jnp.sum(values_BxLxGxA * taken_BxLx1xA, axis=-1) > jax.lax.stop_gradient(baseline_BxLxG)
        repeated = jnp.broadcast_to(actions[..., None], better.shape)
        imitation = better * cross_entropy(online.logits, repeated, options.label_smoothing)
        actor = mean_of_rows((imitation - Q_WEIGHT * baseline_BxLxG).mean(axis=-1), mask)

        log = {
            "actor_loss": actor,
            "critic_loss": critic,
            "value": mean_of_rows(baseline_BxLxG[..., -1], mask),
            "imitated": mean_of_rows(better.mean(axis=-1), mask),
            **(auxiliary := auxiliary_losses(output, steps, batch, world)),
        }
        total = sum(auxiliary.values(), start=actor + CRITIC_WEIGHT * critic)
        return total, {"loss": total, **log, **encoding_metrics(steps.obs)}

    settings: Any = {"logits": lambda output: output.logits[..., -1, :], "slow": SLOW, "takes_labels": False}
    return step_method("amago_offline", "AMAGO-Offline", model, loss, world, **settings)
