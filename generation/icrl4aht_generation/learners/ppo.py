"""Recurrent PPO for egos and populations (paper, App. B.1 and C.2).

T denotes the steps of a rollout, M the agent slots of one policy. An agent slot is one agent of one environment. A
sequence is the T steps of one slot. Minibatches consist of complete sequences, because the recurrent states are
computed again from the state before the first step. The network's inputs are computed once per rollout. The algorithms
for egos and populations differ only in the partner and in the weight of each advantage.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.rules import PRESS_REWARD
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.encoder import CompactView, Seen
from icrl4aht_generation.learners.rollout import Rollout, slot_records


def ppo_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam with linear warm-up, cosine decay (paper, App. C.2.3) and gradients clipped by global norm."""
    steps = config.updates * config.epochs * config.minibatches
    warmup = max(1, round(config.warmup * steps))
    schedule = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, max(steps, warmup + 1))
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule, eps=1e-5))


def shaping_weight(config: PPOConfig, update: Int[Array, ""]) -> Float[Array, ""]:
    """Return the weight of shaped rewards in an update, which decreases linearly from 1 to 0 (paper, App. B.1)."""
    return jnp.maximum(0.0, 1.0 - update * config.steps_per_update / config.shaping_horizon)


class Sequences(NamedTuple):
    """Sequences of T steps in the M agent slots of one policy; slots are on axis 1 of every array.

    Attributes:
        seen: the network's input, leaves (T, M, ..).
        reset: bool (T, M), whether the record starts an episode.
        action: int32 (T, M), the actions taken, 0..5.
        log_prob: float32 (T, M), log-probability of the action in the rollout.
        value: float32 (T, M), the critic's estimate in the rollout.
        reward: float32 (T, M), the team's reward plus the agent's shaped reward times its weight.
        done: bool (T, M), whether the step ended an episode.
        hidden: float32 (1, M, H), recurrent state before the first step.
        partner: int32 (1, M), number of the other agent's policy, an input of the critic.
        weight: float32 (1, M), factor of the advantage; negative to minimize the return.
        last_value: float32 (1, M), the critic's estimate for the observation after the last step.
        expert: int32 (T, M), an expert's actions in the same states, which are also imitated; None without an expert.
        imitation: float32 (1, M), weight of the cross-entropy of the expert's actions; None without an expert.
    """

    seen: Seen
    reset: Bool[Array, "T M"]
    action: Int[Array, "T M"]
    log_prob: Float[Array, "T M"]
    value: Float[Array, "T M"]
    reward: Float[Array, "T M"]
    done: Bool[Array, "T M"]
    hidden: Float[Array, "1 M H"]
    partner: Int[Array, "1 M"]
    weight: Float[Array, "1 M"]
    last_value: Float[Array, "1 M"]
    expert: Int[Array, "T M"] | None = None
    imitation: Float[Array, "1 M"] | None = None


def sequences(
    view: CompactView,
    rollout: Rollout,
    player: int,
    agent_slots: np.ndarray,
    hidden: Array,
    last_value: Array,
    shaping: Array,
    forgiveness: float = 0.0,
) -> Sequences:
    """Return the sequences in one player's agent slots, all with partner 0 and weight 1.

    Args:
        view: view that converts state records to inputs of the network.
        rollout: the rollout.
        player: number of the player in the rollout.
        agent_slots: int (M,), the player's slots; slot a * N + n is agent a of environment n.
        hidden: float32 (M, H), the player's recurrent state before the rollout.
        last_value: float32 (M,), the critic's estimates for the observations after the rollout.
        shaping: float32 scalar or (M,), weight of shaped rewards.
        forgiveness: shaped reward of a wrong delivery, see `PPOConfig`.
    """
    agent, env = np.divmod(agent_slots, rollout.done.shape[1])
    choice = rollout.choices[player]
    # Two button presses, one by each agent, give a negative reward; a lower reward means a wrong delivery.
    shaped = rollout.shaped[:, env, agent] + forgiveness * (rollout.reward[:, env] < 2 * PRESS_REWARD)
    return Sequences(
        seen=view(slot_records(rollout.record, agent_slots)),
        reset=rollout.reset[:, env],
        action=choice.action,
        log_prob=choice.log_prob,
        value=choice.value,
        reward=rollout.reward[:, env] + shaping * shaped,
        done=rollout.done[:, env],
        hidden=hidden[None],
        partner=jnp.zeros((1, agent_slots.size), jnp.int32),
        weight=jnp.ones((1, agent_slots.size)),
        last_value=last_value[None],
    )


class RecurrentNetwork(Protocol):
    """Interface of the actor-critics that PPO trains, such as `ActorCritic`."""

    def apply(self, variables: Any, /, *inputs: Any) -> Any:
        """Return the recurrent state after T steps of M sequences, logits (T, M, A), and values (T, M).

        Args:
            variables: parameters of the network.
            inputs: recurrent state of shape (M, H) before the first step, then `seen` and `reset` as in `Sequences`,
                and `partner` of shape (M,).
        """
        ...


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimization (Schulman et al. 2017) of a recurrent actor-critic.

    Attributes:
        network: the actor-critic.
        config: hyper-parameters.
    """

    network: RecurrentNetwork
    config: PPOConfig

    def learn(
        self, params: Any, optimizer: optax.OptState, played: Sequences, key: Key[Array, ""]
    ) -> tuple[Any, optax.OptState, dict[str, Array]]:
        """Update a policy with `config.epochs` passes over the sequences of one rollout.

        Minibatches have equal size; if the sequences do not divide evenly, every epoch skips a few random ones.

        Args:
            params: parameters of the network.
            optimizer: state of `ppo_optimizer`.
            played: sequences of the rollout.
            key: JAX key that shuffles the sequences.

        Returns:
            New parameters, new optimizer state, and the mean of each loss over all minibatches by name, float32 ().
        """
        config, adam = self.config, ppo_optimizer(self.config)
        count = played.done.shape[1] - played.done.shape[1] % config.minibatches
        # Advantages and critic targets use the values from the rollout, so they do not change between epochs.
        advantage = generalized_advantage(played.reward, played.value, played.done, played.last_value[0], config)
        batch = Batch(played, advantage, advantage + played.value)

        def epoch(carry, key):
            order = jax.random.permutation(key, played.done.shape[1])[:count]

            def minibatch(carry, chosen):
                params, optimizer = carry
                part = jax.tree.map(lambda x: x[:, chosen], batch)
                losses, gradient = jax.value_and_grad(self.loss, has_aux=True)(params, part)
                change, optimizer = adam.update(gradient, optimizer, params)
                return (optax.apply_updates(params, change), optimizer), losses[1]

            return jax.lax.scan(minibatch, carry, order.reshape(config.minibatches, -1))

        (params, optimizer), losses = jax.lax.scan(epoch, (params, optimizer), jax.random.split(key, config.epochs))
        return params, optimizer, jax.tree.map(jnp.mean, losses)

    def loss(self, params: Any, batch: Batch) -> tuple[Array, dict[str, Array]]:
        """Return the loss of a minibatch, and its parts by name: clipped surrogate, clipped value error, entropy.

        If an expert's actions are given, the loss includes their cross-entropy (kickstarting, Schmitt et al. 2018).
        Source: paper, App. B.1, table of PPO hyper-parameters; Schulman et al. 2017, eq. 7.
        """
        config, played = self.config, batch.played
        result: Any = self.network.apply(params, played.hidden[0], played.seen, played.reset, played.partner[0])
        _, logits, value = result
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, played.action[..., None], axis=-1)[..., 0]
        ratio = jnp.exp(log_prob - played.log_prob)
        # Apply the weights after the advantages are normalized, because normalization would cancel earlier weights.
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8) * played.weight
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        policy = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        # Use the larger error, because clipping alone would hide a value that moved in the wrong direction.
        near = played.value + jnp.clip(value - played.value, -config.clip, config.clip)
        error = jnp.maximum((value - batch.target) ** 2, (near - batch.target) ** 2)
        value_loss = 0.5 * error.mean()
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1).mean()
        total = policy + config.value * value_loss - config.entropy * entropy
        log = {"policy_loss": policy, "value_loss": value_loss, "entropy": entropy}
        if played.expert is not None and played.imitation is not None:
            errors = -jnp.take_along_axis(log_probs, played.expert[..., None], axis=-1)[..., 0]
            log["imitation_loss"] = errors.mean()
            total += (played.imitation * errors).mean()
        return total, log


class Batch(NamedTuple):
    """Sequences with advantages and targets; agent slots are on axis 1 of every array.

    Attributes:
        played: sequences of a rollout.
        advantage: float32 (T, M), generalized advantage estimates.
        target: float32 (T, M), targets of the critic.
    """

    played: Sequences
    advantage: Float[Array, "T M"]
    target: Float[Array, "T M"]


def generalized_advantage(
    reward: Float[Array, "T M"],
    value: Float[Array, "T M"],
    done: Bool[Array, "T M"],
    last_value: Float[Array, " M"],
    config: PPOConfig,
) -> Float[Array, "T M"]:
    """Return generalized advantage estimates (Schulman et al. 2016, eq. 16).

    Neither the bootstrapped value nor the trace continues over the end of an episode.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    continues = 1.0 - done
    delta = reward + config.discount * following * continues - value

    def accumulate_trace(trace, inputs):
        delta, continues = inputs
        trace = delta + config.discount * config.gae_lambda * continues * trace
        return trace, trace

    return jax.lax.scan(accumulate_trace, jnp.zeros_like(last_value), (delta, continues), reverse=True)[1]


def episode_metrics(rollout: Rollout) -> dict[str, Array]:
    """Return scalar metrics of a rollout by name; `return` is the mean over ended episodes, 0 if none ended."""
    ended = jnp.sum(rollout.done)
    return {
        "episodes": ended,
        "return": jnp.sum(jnp.where(rollout.done, rollout.returns, 0.0)) / jnp.maximum(ended, 1),
        "reward_per_step": jnp.mean(rollout.reward),
        "shaped_per_step": jnp.mean(rollout.shaped[..., EGO]),
    }
