"""AMAGO-Offline (paper, Sec. 4.5): an actor-critic on the sequence encoder that maximises return, offline.

As in AMAGO (Grigsby et al. 2024): actor and critics share the encoder and exist once for each of several discount
factors; the ego acts by the longest. Returns go on over episodes, as an in-context learner's do: what an episode
shows is worth what later ones gain by it. The actor's loss imitates the actions whose estimated advantage is positive
(filtered behaviour cloning) and raises the expected value of its own (the Q term); the critics learn by one-step
bootstrapping from a slow copy of themselves. No input tells how far training had come.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from baselines.methods.ad import StepOutput, example_step, next_obs_error, step_model
from baselines.methods.method import Method, ModelOptions, World, cross_entropy, mean_of_rows, run_model
from baselines.methods.tokens import steps_of
from icrl4aht_data.sampling.ad import ADBatch

CRITICS = 2
"""The lower estimate counts (clipped double Q)."""

REWARD_SCALE = 0.05
"""Values are learned in deliveries, 20 points each."""

Q_WEIGHT, CRITIC_WEIGHT, SLOW = 0.1, 1.0, 0.005


class Judgement(NamedTuple):
    """Policies and action values, one for each of G discounts."""

    logits: Float[Array, "*B G A"]
    values: Float[Array, "critics *B G A"]


class ActorCriticHead(nn.Module):
    """Features -> judgement."""

    width: int
    discounts: int
    actions: int

    @nn.compact
    def __call__(self, features: Float[Array, "*B D"]) -> Judgement:
        def head(name: str) -> Array:
            hidden = nn.gelu(nn.Dense(self.width, name=f"{name}_hidden")(features))
            out = nn.Dense(self.discounts * self.actions, name=name)(hidden).astype(jnp.float32)
            return out.reshape(*features.shape[:-1], self.discounts, self.actions)

        return Judgement(head("actor"), jnp.stack([head(f"critic_{number}") for number in range(CRITICS)]))


def amago_offline(options: ModelOptions, world: World) -> Method:
    """An offline actor-critic on AD's tokens and transformer."""
    head = ActorCriticHead(options.width, len(options.discounts), world.actions)
    model = step_model(options, world, options.transformer(), head)
    discounts = jnp.asarray(options.discounts)

    def loss(params: Any, slow: Any, batch: ADBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        steps, mask = steps_of(batch, world.view), jnp.asarray(batch.attention_mask)
        actions, lengths = jnp.asarray(batch.target_actions), mask.sum(axis=1)
        output: StepOutput = run_model(model, options, params, key, steps, actions, lengths)
        now: Judgement = output.head
        later: Judgement = run_model(model, options, slow, None, steps, None, lengths).head
        policy = jax.nn.softmax(now.logits)
        taken = jax.nn.one_hot(actions, world.actions)[:, :, None]

        coming = jnp.sum(jax.lax.stop_gradient(policy) * later.values.min(axis=0), axis=-1)[:, 1:]
        reward = REWARD_SCALE * jnp.asarray(batch.prev_rewards)[:, 1:, None]
        target = jax.lax.stop_gradient(reward + discounts * coming)  # (B, L - 1, G)
        error = jnp.square(jnp.sum(now.values * taken, axis=-1)[:, :, :-1] - target)
        critic = mean_of_rows(error.mean(axis=(0, -1)), mask[:, 1:])

        values = jax.lax.stop_gradient(now.values.min(axis=0))
        baseline = jnp.sum(policy * values, axis=-1)
        better = jnp.sum(values * taken, axis=-1) > jax.lax.stop_gradient(baseline)
        repeated = jnp.broadcast_to(actions[..., None], better.shape)
        imitation = better * cross_entropy(now.logits, repeated, options.label_smoothing)
        actor = mean_of_rows((imitation - Q_WEIGHT * baseline).mean(axis=-1), mask)

        total = actor + CRITIC_WEIGHT * critic
        log = {
            "actor_loss": actor,
            "critic_loss": critic,
            "value": mean_of_rows(baseline[..., -1], mask),
            "imitated": mean_of_rows(better.mean(axis=-1), mask),
        }
        if output.next_obs is not None:
            log["next_obs_loss"] = next_obs_error(output.next_obs, steps.obs, batch)
            total += log["next_obs_loss"]
        return total, {"loss": total, **log}

    example = example_step(world)
    return Method(
        name="amago_offline",
        label="AMAGO-Offline",
        data="ad",
        model=model,
        example=(example, example.prev_action),
        loss=loss,
        logits=lambda judgement: judgement.logits[..., -1, :],
        slow=SLOW,
    )
