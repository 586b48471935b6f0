"""Independent PPO of both agents with shared parameters, on any environment with JaxMARL's interface.

The losses and updates are those of `icrl4aht_generation.learners.ppo`; the network is a small one without memory, so that the
environment is a large part of the work. T denotes the steps of a roll-out, N the environments, M = 2 N the agents in
them, those of the first agent first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.ppo import PPO, Sequences, ppo_optimizer, shaping_weight
from jaxtyping import Array, Float, Key, Num

if TYPE_CHECKING:
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv

WIDTH = 64
"""Width of both hidden layers."""


class IndependentNetwork(nn.Module):
    """Actor and critic of one observation, with the interface of `ppo.RecurrentNetwork` and no memory.

    Args:
        actions: number of actions.
    """

    actions: int

    @nn.compact
    def __call__(self, hidden: Array, seen: Num[Array, "*B H W C"], *ignored: Any) -> tuple[Array, Array, Array]:
        """Returns the memory as it came, logits (*B, actions) and values (*B)."""
        features = seen.reshape(*seen.shape[:-3], -1).astype(jnp.float32)
        for _ in range(2):
            features = nn.relu(nn.Dense(WIDTH)(features))
        return hidden, nn.Dense(self.actions)(features), nn.Dense(1)(features)[..., 0]


class UpdateLog(NamedTuple):
    """Metrics of updates, leaves (updates,).

    Attributes:
        loss: mean clipped surrogate.
        entropy: mean entropy of the policy.
        reward: mean reward of a step.
        shaped: mean shaped reward of an agent in a step.
        episodes: number of episodes that ended.
    """

    loss: Float[Array, " updates"]
    entropy: Float[Array, " updates"]
    reward: Float[Array, " updates"]
    shaped: Float[Array, " updates"]
    episodes: Float[Array, " updates"]


def train_ippo(env: MultiAgentEnv, config: PPOConfig) -> Callable[[Key[Array, ""]], tuple[Any, UpdateLog]]:
    """Returns a function that trains from a key, to be compiled by its caller: parameters, and metrics by update.

    Args:
        env: the environment; its `info` has `shaped_reward`.
        config: hyper-parameters; its `widths` are not used.
    """
    space: Any = env.action_space(env.agents[0])
    network = IndependentNetwork(space.n)
    ppo, agents, n = PPO(network, config), env.agents, config.environments
    memory = jnp.zeros((len(agents) * n, 1))

    def by_slot(named: dict[str, Array]) -> Array:
        """{agent: (N, ...)} -> (M, ...)."""
        return jnp.concatenate([named[agent] for agent in agents])

    def play(params: Any, carry: Any, key: Key[Array, ""]) -> tuple[Any, Any]:
        """One step of all environments; returns the next carry and what was seen, done and earned, leaves (M, ...)."""
        state, seen, reset = carry
        act_key, step_key = jax.random.split(key)
        result: Any = network.apply(params, memory, seen)
        action = jax.random.categorical(act_key, result[1])
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(result[1]), action[:, None], axis=-1)[:, 0]
        named = dict(zip(agents, action.reshape(len(agents), n), strict=True))
        obs, state, reward, done, info = jax.vmap(env.step)(jax.random.split(step_key, n), state, named)
        ended, shaped = jnp.tile(done["__all__"], len(agents)), by_slot(info["shaped_reward"])
        played = seen, reset, action, log_prob, result[2], by_slot(reward), shaped, ended
        return (state, by_slot(obs), ended), played

    def update(state: Any, number: Array) -> tuple[Any, UpdateLog]:
        params, optimizer, carry, key = state
        key, play_key, learn_key = jax.random.split(key, 3)
        keys = jax.random.split(play_key, config.rollout)
        carry, played = jax.lax.scan(lambda carry, key: play(params, carry, key), carry, keys)
        seen, reset, action, log_prob, value, reward, shaped, ended = played
        last: Any = network.apply(params, memory, carry[1])
        params, optimizer, losses = ppo.learn(
            params,
            optimizer,
            Sequences(
                seen=seen,
                reset=reset,
                action=action,
                log_prob=log_prob,
                value=value,
                reward=reward + shaping_weight(config, number) * shaped,
                done=ended,
                hidden=memory[None],
                partner=jnp.zeros((1, len(memory)), jnp.int32),
                weight=jnp.ones((1, len(memory))),
                last_value=last[2][None],
            ),
            learn_key,
        )
        episodes = ended.sum() / len(agents)
        log = UpdateLog(losses["policy_loss"], losses["entropy"], reward.mean(), shaped.mean(), episodes)
        return (params, optimizer, carry, key), log

    def train(key: Key[Array, ""]) -> tuple[Any, UpdateLog]:
        params_key, env_key, running_key = jax.random.split(key, 3)
        obs, state = jax.vmap(env.reset)(jax.random.split(env_key, n))
        first = by_slot(obs)
        params = network.init(params_key, memory, first)
        carry = state, first, jnp.ones(len(memory), bool)
        start = params, ppo_optimizer(config).init(params), carry, running_key
        after, log = jax.lax.scan(update, start, jnp.arange(config.updates))
        return after[0], log

    return train
