"""The one recurrent PPO (paper, App. B.1 and C.2): how a policy learns from actor sequences, wherever they were played.

Epochs over minibatches of whole sequences, by scan; the recurrent state is replayed from the one stored at the first
step. Sequences hold state records; observations are rendered where they are used. What tells the algorithms apart is
who sat opposite and the weight of each sequence's advantage.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from generation.learners.network import ActorCritic, Widths
from generation.learners.rollout import Rollout, seen_from
from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, PAPER_EGO_STEPS
from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters; the defaults are the paper's ego table (App. C.2.2)."""

    total_steps: int = PAPER_EGO_STEPS  # environment steps, over all environments
    environments: int = 1024
    rollout: int = 256  # steps of each environment between updates
    epochs: int = 4
    minibatches: int = 64  # each of sequences // minibatches whole sequences
    learning_rate: float = 2.5e-4
    warmup: float = 0.1  # share of the updates
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2  # of the probability ratio and of the value change
    entropy: float = 0.01
    value: float = 0.5
    max_grad_norm: float = 0.25
    shaping_horizon: int = PAPER_EGO_STEPS  # environment steps until shaped rewards count nothing
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        if self.environments % self.minibatches:
            raise ValueError(f"environments = {self.environments}: not a multiple of minibatches = {self.minibatches}")

    @property
    def steps_per_update(self) -> int:
        return self.environments * self.rollout

    @property
    def updates(self) -> int:
        """Whole updates within `total_steps`."""
        return self.total_steps // self.steps_per_update

    @property
    def episodes(self) -> int:
        """Episodes of each environment whose kept steps, and the state after them, are within the updates."""
        return max(0, (self.updates * self.rollout - KEPT_STEPS - 1) // EPISODE_STEPS + 1)

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam under a linear warm-up and a cosine decay (paper, App. C.2.3), gradients clipped by global norm."""
        steps = self.updates * self.epochs * self.minibatches
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, self.learning_rate, max(1, round(self.warmup * steps)), steps
        )
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), optax.adam(schedule, eps=1e-5))

    def shaping(self, update: Int[Array, ""]) -> Float[Array, ""]:
        """The weight of shaped rewards in an update: linearly from 1 to 0 (paper, App. B.1)."""
        return jnp.maximum(0.0, 1.0 - update * self.steps_per_update / self.shaping_horizon)


class Sequences(NamedTuple):
    """T steps at the M places of one policy; every array has the places on axis 1."""

    record: UInt8[Array, "T M S"]  # the actor's own columns first
    reset: Bool[Array, "T M"]
    action: Int[Array, "T M"]
    log_prob: Float[Array, "T M"]
    value: Float[Array, "T M"]
    reward: Float[Array, "T M"]  # the team's, and the actor's own shaped one by its weight
    done: Bool[Array, "T M"]
    hidden: Float[Array, "1 M H"]  # before the first step
    partner: Int[Array, "1 M"]  # who sits opposite, for the critic
    weight: Float[Array, "1 M"]  # of the advantage; negative to bring the return down
    last_value: Float[Array, "1 M"]  # of the observation after the last step


def sequences(
    rollout: Rollout, player: int, places: np.ndarray, hidden: Array, last_value: Array, shaping: Array
) -> Sequences:
    """What one player's roll-out is to its learning; all partners 0, all weights 1. `shaping` is the weight of shaped
    rewards, one or (M,)."""
    seat, table = np.divmod(places, rollout.done.shape[1])
    choice = rollout.choices[player]
    return Sequences(
        record=seen_from(rollout.record, places),
        reset=rollout.reset[:, table],
        action=choice.action,
        log_prob=choice.log_prob,
        value=choice.value,
        reward=rollout.reward[:, table] + shaping * rollout.shaped[:, table, seat],
        done=rollout.done[:, table],
        hidden=hidden[None],
        partner=jnp.zeros((1, places.size), jnp.int32),
        weight=jnp.ones((1, places.size)),
        last_value=last_value[None],
    )


@dataclass(frozen=True)
class PPO:
    """Learning from sequences."""

    layout: Layout
    network: ActorCritic
    config: PPOConfig

    def learn(
        self, params: Any, optimizer: optax.OptState, played: Sequences, key: Key[Array, ""]
    ) -> tuple[Any, optax.OptState, dict[str, Array]]:
        """The epochs over one roll-out: parameters, optimiser state, mean losses.

        Minibatches are of one size; an epoch leaves out the sequences that fill none, others each time.
        """
        config = self.config
        count = played.done.shape[1] - played.done.shape[1] % config.minibatches
        advantage = generalised_advantage(played.reward, played.value, played.done, played.last_value[0], config)
        batch = Batch(played, advantage, advantage + played.value)

        def epoch(carry, key):
            order = jax.random.permutation(key, played.done.shape[1])[:count]

            def minibatch(carry, chosen):
                params, optimizer = carry
                part = jax.tree.map(lambda x: x[:, chosen], batch)
                losses, gradient = jax.value_and_grad(self.loss, has_aux=True)(params, part)
                change, optimizer = config.optimizer.update(gradient, optimizer, params)
                return (optax.apply_updates(params, change), optimizer), losses[1]

            return jax.lax.scan(minibatch, carry, order.reshape(config.minibatches, -1))

        (params, optimizer), losses = jax.lax.scan(epoch, (params, optimizer), jax.random.split(key, config.epochs))
        return params, optimizer, jax.tree.map(jnp.mean, losses)

    def loss(self, params: Any, batch: Batch) -> tuple[Array, dict[str, Array]]:
        """Clipped surrogate, clipped value error, entropy (paper, App. B.1 table of PPO hyper-parameters)."""
        config, played = self.config, batch.played
        obs = observe(self.layout, played.record, EGO)
        result: Any = self.network.apply(params, played.hidden[0], obs, played.reset, played.partner[0])
        _, logits, value = result
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, played.action[..., None], axis=-1)[..., 0]
        ratio = jnp.exp(log_prob - played.log_prob)
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8) * played.weight
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        policy = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        near = played.value + jnp.clip(value - played.value, -config.clip, config.clip)
        error = jnp.maximum((value - batch.target) ** 2, (near - batch.target) ** 2)
        value_loss = 0.5 * error.mean()
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1).mean()
        total = policy + config.value * value_loss - config.entropy * entropy
        return total, {"policy_loss": policy, "value_loss": value_loss, "entropy": entropy}


class Batch(NamedTuple):
    """Sequences ready to learn from; every array has the places on axis 1."""

    played: Sequences
    advantage: Float[Array, "T M"]
    target: Float[Array, "T M"]  # of the value


def generalised_advantage(
    reward: Float[Array, "T M"],
    value: Float[Array, "T M"],
    done: Bool[Array, "T M"],
    last_value: Float[Array, " M"],
    config: PPOConfig,
) -> Float[Array, "T M"]:
    """GAE (Schulman et al. 2016, eq. 16); an episode's end cuts both the bootstrap and the trace."""
    following = jnp.concatenate([value[1:], last_value[None]])
    going_on = 1.0 - done
    delta = reward + config.discount * following * going_on - value

    def back(trace, inputs):
        delta, going_on = inputs
        trace = delta + config.discount * config.gae_lambda * going_on * trace
        return trace, trace

    return jax.lax.scan(back, jnp.zeros_like(last_value), (delta, going_on), reverse=True)[1]


def episode_metrics(rollout: Rollout) -> dict[str, Array]:
    """What a roll-out says of its episodes and of the ego's shaped rewards; `return` is 0 where none ended."""
    ended = jnp.sum(rollout.done)
    return {
        "episodes": ended,
        "return": jnp.sum(jnp.where(rollout.done, rollout.returns, 0.0)) / jnp.maximum(ended, 1),
        "reward_per_step": jnp.mean(rollout.reward),
        "shaped_per_step": jnp.mean(rollout.shaped[..., EGO]),
    }
