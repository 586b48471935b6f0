"""An ego that learns from scratch with a fixed teammate (paper, App. C.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int, Key

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.ppo import PPO, episode_metrics, ppo_optimizer, sequences, shaping_weight
from icrl4aht_generation.learners.rollout import (
    Player,
    Rollout,
    RolloutCarry,
    init_rollout,
    network_player,
    policy_player,
    roll_out,
)
from icrl4aht_generation.policy import Policy


class LearnerState(NamedTuple):
    """Complete state of a `Learner`; an update maps a state to the next state.

    Attributes:
        params: the ego's parameters, a pytree of float32.
        optimizer: state of the optimizer.
        carry: environments and memories before the next rollout.
        teammate: the teammate's parameters; the compiled update takes them as an argument, so all teammates of one
            family share one compilation.
        key: typed JAX key, scalar, constant; every update folds its number into this key.
        update: int32 scalar, number of updates so far.
    """

    params: Any
    optimizer: optax.OptState
    carry: RolloutCarry
    teammate: Any
    key: Key[Array, ""]
    update: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Learner:
    """Trains an ego, agent 0, with one teammate, agent 1.

    Attributes:
        env: environment with one layout.
        teammate: the teammate's policy.
        config: hyper-parameters of PPO.
    """

    env: Environment
    teammate: Policy
    config: PPOConfig

    @property
    def network(self) -> ActorCritic:
        """The ego's network."""
        return ActorCritic(self.config.widths, view=self.view)

    @cached_property
    def view(self) -> CompactView:
        """View that converts state records to inputs of the network."""
        return CompactView(self.config.widths.encoder, (self.env.only_layout,))

    @cached_property
    def ppo(self) -> PPO:
        """PPO algorithm that computes the updates."""
        return PPO(self.network, self.config)

    def init(self, key: Key[Array, ""]) -> LearnerState:
        """Return the state of an untrained ego before the first step."""
        params_key, _, running_key = jax.random.split(key, 3)
        params = self.network.untrained(params_key, self.env.only_layout.channels)
        env_keys = stream_keys(key, self.config.environments)
        carry = init_rollout(self.env, self.players(params, self.teammate.params), env_keys)
        optimizer = ppo_optimizer(self.config).init(params)
        return LearnerState(params, optimizer, carry, self.teammate.params, running_key, jnp.int32(0))

    def update(self, state: LearnerState) -> tuple[LearnerState, Rollout, dict[str, Array]]:
        """Play one rollout and learn from it, as a pure function of the state.

        Returns:
            The next state, the rollout, and scalar metrics.
        """
        play_key, learn_key = jax.random.split(jax.random.fold_in(state.key, state.update))
        players = self.players(state.params, state.teammate)
        carry, rollout = roll_out(self.env, players, state.carry, self.config.rollout, play_key)
        ego = players[EGO]
        # Only the critic's value of the last state is used; the next rollout draws a new action in this state.
        after, _ = ego.act(carry.memories[EGO], carry.env, play_key)
        shaping = shaping_weight(self.config, state.update)
        memory, forgiveness = state.carry.memories[EGO], self.config.forgiveness
        played = sequences(self.view, rollout, EGO, ego.agent_slots, memory, after.value, shaping, forgiveness)
        params, optimizer, losses = self.ppo.learn(state.params, state.optimizer, played, learn_key)
        metrics = losses | episode_metrics(rollout) | {"shaping": shaping}
        return (
            state._replace(params=params, optimizer=optimizer, carry=carry, update=state.update + 1),
            rollout,
            metrics,
        )

    def players(self, params: Any, teammate_params: Any) -> tuple[Player, Player]:
        """Return the ego and the teammate as players of all environments."""
        n = self.config.environments
        ego = network_player(self.env, self.network, params, np.arange(n), jnp.zeros(n, jnp.int32))
        return ego, policy_player(self.env, self.teammate, teammate_params, TEAMMATE, n)


def stream_keys(key: Key[Array, ""], environments: int) -> Key[Array, " N"]:
    """Return the keys of a learner's N environments, given the key that is passed to `Learner.init`."""
    return jax.random.split(jax.random.split(key, 3)[1], environments)


def compiled_update(learner: Learner) -> Callable[[LearnerState], tuple[LearnerState, Rollout, dict[str, Array]]]:
    """Return the learner's compiled update, which reuses the memory of its argument.

    All teammates of one family on one layout share the compilation.
    """
    teammate = learner.teammate
    return _jitted_update(learner.env.layout, learner.env.max_steps, teammate._replace(params=()), learner.config)


@lru_cache(maxsize=8)
def _jitted_update(layout, max_steps: int, teammate: Policy, config: PPOConfig):
    return jax.jit(Learner(Environment(layout, max_steps), teammate, config).update, donate_argnums=0)
