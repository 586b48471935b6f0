"""The one recurrent PPO (paper, App. B.1 and C.2): an ego in seat 0 learns beside a fixed teammate in seat 1.

One update is one jitted function: a roll-out by scan, then epochs over minibatches of whole actor sequences by scan.
Roll-outs keep state records; observations are rendered where they are used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from generation.env import Environment, EnvState, EnvStep
from generation.learners.network import ActorCritic, Widths
from generation.teammates.base import Policy
from icrl4aht_data.benchmark import EGO, EPISODE_STEPS, KEPT_STEPS, TEAMMATE
from icrl4aht_data.overcooked.observe import observe


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters; the defaults are the paper's ego table (App. C.2.2)."""

    total_steps: int = 60_000_000  # environment steps, over all environments
    environments: int = 1024
    rollout: int = 256  # steps of each environment between updates
    epochs: int = 4
    minibatches: int = 64  # each of environments / minibatches whole sequences
    learning_rate: float = 2.5e-4
    warmup: float = 0.1  # share of the updates
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2  # of the probability ratio and of the value change
    entropy: float = 0.01
    value: float = 0.5
    max_grad_norm: float = 0.25
    shaping_horizon: int = 60_000_000  # environment steps until shaped rewards count nothing
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


class Seats(NamedTuple):
    """Everything a roll-out carries: the tables, and what the players remember. N environments."""

    env: EnvState
    ended: Bool[Array, " N"]  # the last step ended an episode
    hidden: Float[Array, "N H"]  # the ego's
    teammate: Any  # the teammates' memories, batched
    returns: Float[Array, " N"]  # of the running episodes so far, the team's unshaped reward


class LearnerState(NamedTuple):
    """What an update maps to the next one; all that a resume needs."""

    params: Any
    optimizer: optax.OptState
    seats: Seats
    key: Key[Array, ""]
    update: Int[Array, ""]


class Rollout(NamedTuple):
    """T steps of N environments."""

    record: UInt8[Array, "T N S"]  # before the step
    reset: Bool[Array, "T N"]  # `record` starts an episode
    actions: Int[Array, "T N 2"]
    log_prob: Float[Array, "T N"]
    value: Float[Array, "T N"]
    reward: Float[Array, "T N"]  # the team's, unshaped
    shaped: Float[Array, "T N"]  # the ego's own
    done: Bool[Array, "T N"]
    returns: Float[Array, "T N"]  # of the episode that ended here, where `done`


@dataclass(frozen=True, eq=False)
class Learner:
    """An ego that learns from scratch beside one teammate."""

    env: Environment
    teammate: Policy
    config: PPOConfig

    @property
    def network(self) -> ActorCritic:
        return ActorCritic(self.config.widths)

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam under a linear warm-up and a cosine decay (paper, App. C.2.3), gradients clipped by global norm."""
        config = self.config
        steps = config.updates * config.epochs * config.minibatches
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, config.learning_rate, max(1, round(config.warmup * steps)), steps
        )
        return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule, eps=1e-5))

    def init(self, key: Key[Array, ""]) -> LearnerState:
        """An untrained ego at fresh tables."""
        weights, tables, running = jax.random.split(key, 3)
        n = self.config.environments
        env = self.env.init(jax.random.split(tables, n))
        hidden = self.network.initial_hidden(n)
        obs = self.env.observe_one(env, EGO)[None]
        params = self.network.init(weights, hidden, obs, jnp.ones((1, n), bool))
        seats = Seats(env, jnp.ones(n, bool), hidden, self._teammate_memory(env), jnp.zeros(n))
        return LearnerState(params, self.optimizer.init(params), seats, running, jnp.int32(0))

    def update(self, state: LearnerState) -> tuple[LearnerState, Rollout, dict[str, Array]]:
        """One roll-out and the epochs over it. Jit it once; it is a pure function of the state."""
        rolling, learning = jax.random.split(jax.random.fold_in(state.key, state.update))
        seats, rollout, last_value = self.roll_out(state.params, state.seats, rolling)
        steps_so_far = state.update * self.config.steps_per_update
        shaping = jnp.maximum(0.0, 1.0 - steps_so_far / self.config.shaping_horizon)
        advantage = generalised_advantage(
            rollout.reward + shaping * rollout.shaped, rollout.value, rollout.done, last_value, self.config
        )
        batch = Batch(rollout, state.seats.hidden[None], advantage, advantage + rollout.value)
        params, optimizer, losses = self._epochs(state.params, state.optimizer, batch, learning)
        ended = jnp.sum(rollout.done)
        metrics = losses | {
            "episodes": ended,
            "return": jnp.sum(jnp.where(rollout.done, rollout.returns, 0.0)) / jnp.maximum(ended, 1),
            "reward_per_step": jnp.mean(rollout.reward),
            "shaped_per_step": jnp.mean(rollout.shaped),
            "shaping": shaping,
        }
        return LearnerState(params, optimizer, seats, state.key, state.update + 1), rollout, metrics

    def roll_out(self, params, seats: Seats, key: Key[Array, ""]) -> tuple[Seats, Rollout, Float[Array, " N"]]:
        """`rollout` steps of every environment, and the value of the observation after the last."""

        def step(seats: Seats, key: Key[Array, ""]):
            return self._step(params, seats, key)

        seats, rollout = jax.lax.scan(step, seats, jax.random.split(key, self.config.rollout))
        _, _, value = self._forward(params, seats)
        return seats, rollout, value

    def _forward(self, params, seats: Seats):
        obs = self.env.observe_one(seats.env, EGO)
        hidden, logits, value = self._apply(params, seats.hidden, obs[None], seats.ended[None])
        return hidden, logits[0], value[0]

    def _apply(self, params, hidden, obs, reset) -> tuple[Array, Array, Array]:
        result: Any = self.network.apply(params, hidden, obs, reset)
        return result

    def _step(self, params, seats: Seats, key: Key[Array, ""]) -> tuple[Seats, Rollout]:
        mine, theirs = jax.random.split(key)
        hidden, logits, value = self._forward(params, seats)
        ego = jax.random.categorical(mine, logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), ego[:, None], axis=-1)[:, 0]
        after, actions, step = self.take_turn(seats, ego, hidden, theirs)
        transition = Rollout(
            record=seats.env.record,
            reset=seats.ended,
            actions=actions,
            log_prob=log_prob,
            value=value,
            reward=step.reward,
            shaped=step.shaped[:, EGO],
            done=step.done,
            returns=seats.returns + step.reward,
        )
        return after, transition

    def take_turn(
        self, seats: Seats, ego: Int[Array, " N"], hidden: Float[Array, "N H"], key: Key[Array, ""]
    ) -> tuple[Seats, Int[Array, "N 2"], EnvStep]:
        """The teammate answers the ego's actions and the tables move on; memories start anew with each episode."""
        mate, memory = self._teammate_acts(seats, key)
        actions = jnp.stack([ego, mate], axis=-1)
        step = self.env.step(seats.env, actions)
        fresh = self._teammate_memory(step.state)
        memory = jax.tree.map(lambda new, old: _where(step.done, new, old), fresh, memory)
        returns = jnp.where(step.done, 0.0, seats.returns + step.reward)
        return Seats(step.state, step.done, hidden, memory, returns), actions, step

    def _teammate_memory(self, env: EnvState):
        """Fresh memories for the running episodes: a function of each episode's own key."""
        keys = jax.vmap(jax.random.fold_in)(self.env.episode_key(env), jnp.full(env.clock.shape, TEAMMATE))
        return jax.vmap(self.teammate.init, in_axes=(None, 0))(self.teammate.params, keys)

    def _teammate_acts(self, seats: Seats, key: Key[Array, ""]):
        view = seats.env.record
        if self.teammate.sees == "observation":
            view = self.env.observe_one(seats.env, TEAMMATE)
        keys = jax.random.split(key, view.shape[0])
        act = jax.vmap(self.teammate.act, in_axes=(None, 0, 0, 0))
        return act(self.teammate.params, seats.teammate, view, keys)

    def _epochs(self, params, optimizer, batch: Batch, key: Key[Array, ""]):
        config = self.config

        def epoch(carry, key):
            order = jax.random.permutation(key, config.environments)

            def minibatch(carry, chosen):
                params, optimizer = carry
                part = jax.tree.map(lambda x: x[:, chosen], batch)
                losses, gradient = jax.value_and_grad(self._loss, has_aux=True)(params, part)
                change, optimizer = self.optimizer.update(gradient, optimizer, params)
                return (optax.apply_updates(params, change), optimizer), losses[1]

            return jax.lax.scan(minibatch, carry, order.reshape(config.minibatches, -1))

        (params, optimizer), losses = jax.lax.scan(epoch, (params, optimizer), jax.random.split(key, config.epochs))
        return params, optimizer, jax.tree.map(jnp.mean, losses)

    def _loss(self, params, batch: Batch):
        """Clipped surrogate, clipped value error, entropy (paper, App. B.1 table of PPO hyper-parameters)."""
        config, rollout = self.config, batch.rollout
        obs = observe(self.env.layout, rollout.record, EGO)
        _, logits, value = self._apply(params, batch.hidden[0], obs, rollout.reset)
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, rollout.actions[..., EGO, None], axis=-1)[..., 0]
        ratio = jnp.exp(log_prob - rollout.log_prob)
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        policy = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        near = rollout.value + jnp.clip(value - rollout.value, -config.clip, config.clip)
        error = jnp.maximum((value - batch.target) ** 2, (near - batch.target) ** 2)
        value_loss = 0.5 * error.mean()
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1).mean()
        total = policy + config.value * value_loss - config.entropy * entropy
        return total, {"policy_loss": policy, "value_loss": value_loss, "entropy": entropy}


class Batch(NamedTuple):
    """A roll-out ready to learn from; every array has the environments on axis 1."""

    rollout: Rollout
    hidden: Float[Array, "1 N H"]  # the ego's before the first step
    advantage: Float[Array, "T N"]
    target: Float[Array, "T N"]  # of the value


def generalised_advantage(
    reward: Float[Array, "T N"],
    value: Float[Array, "T N"],
    done: Bool[Array, "T N"],
    last_value: Float[Array, " N"],
    config: PPOConfig,
) -> Float[Array, "T N"]:
    """GAE (Schulman et al. 2016, eq. 16); an episode's end cuts both the bootstrap and the trace."""
    following = jnp.concatenate([value[1:], last_value[None]])
    going_on = 1.0 - done
    delta = reward + config.discount * following * going_on - value

    def back(trace, inputs):
        delta, going_on = inputs
        trace = delta + config.discount * config.gae_lambda * going_on * trace
        return trace, trace

    return jax.lax.scan(back, jnp.zeros_like(last_value), (delta, going_on), reverse=True)[1]


def _where(mask: Bool[Array, " N"], new: Array, old: Array) -> Array:
    """`jnp.where` with the mask on the leading axis; also for typed keys."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)
