"""An ego in seat 0 that learns from scratch beside a fixed teammate in seat 1 (paper, App. C.2)."""

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

from generation.env import Environment
from generation.learners.network import ActorCritic
from generation.learners.ppo import PPO, PPOConfig, episode_metrics, sequences
from generation.learners.rollout import Player, Rollout, Seats, init_rollout, network_player, policy_player, roll_out
from generation.policy import Policy
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE


class LearnerState(NamedTuple):
    """What an update maps to the next one; all that a resume needs."""

    params: Any
    optimizer: optax.OptState
    seats: Seats
    teammate: Any  # the teammate's parameters
    key: Key[Array, ""]
    update: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Learner:
    """An ego beside one teammate."""

    env: Environment
    teammate: Policy
    config: PPOConfig

    @property
    def steps_per_update(self) -> int:
        """Environment steps, over all tables."""
        return self.config.steps_per_update

    @property
    def network(self) -> ActorCritic:
        return ActorCritic(self.config.widths)

    @cached_property
    def ppo(self) -> PPO:
        return PPO(self.env.layout, self.network, self.config)

    def init(self, key: Key[Array, ""]) -> LearnerState:
        """An untrained ego at fresh tables."""
        weights, tables, running = jax.random.split(key, 3)
        n = self.config.environments
        params = self.network.untrained(weights, self.env.layout.channels)
        seats = init_rollout(self.env, self.players(params, self.teammate.params), jax.random.split(tables, n))
        return LearnerState(
            params, self.config.optimizer.init(params), seats, self.teammate.params, running, jnp.int32(0)
        )

    def update(self, state: LearnerState) -> tuple[LearnerState, Rollout, dict[str, Array]]:
        """One roll-out and the epochs over it: a pure function of the state, see `compiled_update`."""
        rolling, learning = jax.random.split(jax.random.fold_in(state.key, state.update))
        players = self.players(state.params, state.teammate)
        seats, rollout = roll_out(self.env, players, state.seats, self.config.rollout, rolling)
        ego = players[EGO]
        after, _ = ego.act(seats.memories[EGO], seats.env, rolling)
        shaping = self.config.shaping(state.update)
        played = sequences(rollout, EGO, ego.places, state.seats.memories[EGO], after.value, shaping)
        params, optimizer, losses = self.ppo.learn(state.params, state.optimizer, played, learning)
        metrics = losses | episode_metrics(rollout) | {"shaping": shaping}
        return (
            state._replace(params=params, optimizer=optimizer, seats=seats, update=state.update + 1),
            rollout,
            metrics,
        )

    def players(self, params: Any, teammate_params: Any) -> tuple[Player, Player]:
        n = self.config.environments
        ego = network_player(self.env, self.network, params, np.arange(n), jnp.zeros(n, jnp.int32))
        return ego, policy_player(self.env, self.teammate, teammate_params, TEAMMATE, n)


def compiled_update(learner: Learner) -> Callable[[LearnerState], tuple[LearnerState, Rollout, dict[str, Array]]]:
    """The learner's update, compiled once for all teammates of one family on one layout; it takes its argument's
    memory."""
    teammate = learner.teammate
    return _compiled(learner.env.layout, learner.env.max_steps, teammate._replace(params=()), learner.config)


@lru_cache(maxsize=8)
def _compiled(layout, max_steps: int, teammate: Policy, config: PPOConfig):
    return jax.jit(Learner(Environment(layout, max_steps), teammate, config).update, donate_argnums=0)
