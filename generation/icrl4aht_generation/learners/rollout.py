"""Rollouts of N environments for all learners, with the 2 N agents divided among players.

N denotes the number of environments, M the number of agent slots of one player, T the number of steps. An *agent slot*
is one agent of one environment: slot a * N + e is agent a (0 the ego, 1 the teammate) of environment e. A player acts
in a fixed set of slots, so environments may have different pairs of players, and a policy may play either agent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.overcooked.state import swap_agents
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.policy import Policy


class Choice(NamedTuple):
    """Actions of a player in one step in its M agent slots.

    Attributes:
        action: int32 (M,), action ids 0..5.
        log_prob: float32 (M,), log-probability of the action; 0 for players that do not learn.
        value: float32 (M,), the critic's estimate; 0 for players that do not learn.
    """

    action: Int[Array, " M"]
    log_prob: Float[Array, " M"]
    value: Float[Array, " M"]


class Player(NamedTuple):
    """One policy, or several policies with parameters of equal shapes, for a fixed set of agent slots.

    Attributes:
        agent_slots: int (M,), a NumPy array, since a compiled rollout needs constant slots.
        init: function of environment states that returns memories at the start of an episode, leaves (M, ...).
        act: function of memories, environment states and a key that returns choices and the next memories.
    """

    agent_slots: np.ndarray
    init: Callable[[EnvState], Any]
    act: Callable[[Any, EnvState, Key[Array, ""]], tuple[Choice, Any]]


class RolloutCarry(NamedTuple):
    """State of environments and players between two rollouts.

    Attributes:
        env: states of the N environments.
        ended: bool (N,), whether the last step ended an episode.
        memories: memories of each player, a pytree with leaves of shape (M, ...).
        returns: float32 (N,), return of the running episode so far, without shaping.
    """

    env: EnvState
    ended: Bool[Array, " N"]
    memories: tuple[Any, ...]
    returns: Float[Array, " N"]


class Rollout(NamedTuple):
    """T recorded steps of N environments.

    Attributes:
        record: uint8 (T, N, S), state records before each step.
        reset: bool (T, N), whether `record` starts an episode.
        actions: int32 (T, N, 2), ids 0..5 of ego and teammate.
        reward: float32 (T, N), the team's reward without shaping.
        shaped: float32 (T, N, 2), shaped reward of each agent.
        done: bool (T, N), whether the step ended an episode.
        returns: float32 (T, N), return of the episode up to this step.
        choices: one `Choice` per player, leaves (T, M).
    """

    record: UInt8[Array, "T N S"]
    reset: Bool[Array, "T N"]
    actions: Int[Array, "T N 2"]
    reward: Float[Array, "T N"]
    shaped: Float[Array, "T N 2"]
    done: Bool[Array, "T N"]
    returns: Float[Array, "T N"]
    choices: tuple[Choice, ...]


def init_rollout(env: Environment, players: Sequence[Player], keys: Key[Array, " N"]) -> RolloutCarry:
    """Return the carry before the first step, given one key for each environment."""
    state = env.init(keys)
    n = state.clock.shape[0]
    memories = tuple(player.init(state) for player in players)
    return RolloutCarry(state, jnp.ones(n, bool), memories, jnp.zeros(n))


def roll_out(
    env: Environment,
    players: Sequence[Player],
    carry: RolloutCarry,
    steps: int,
    key: Key[Array, ""],
    restart: Callable[[EnvState, Bool[Array, " N"]], EnvState] = lambda state, done: state,
) -> tuple[RolloutCarry, Rollout]:
    """Step every environment `steps` times.

    Args:
        env: the environment.
        players: the players of N environments; together they play all agent slots 0..2N-1, each slot once.
        carry: carry from `init_rollout` or the previous rollout.
        steps: number T of steps.
        key: JAX key for the players' random draws; environments use their own keys.
        restart: function of states and `done` that may replace the start states of episodes after a `done` step.
    """
    n = carry.ended.shape[0]
    # This permutation sorts the concatenated actions of all players by slot.
    order = np.argsort(np.concatenate([player.agent_slots for player in players]))

    def step(carry: RolloutCarry, key: Key[Array, ""]) -> tuple[RolloutCarry, Rollout]:
        keys = jax.random.split(key, len(players))
        acted = [
            player.act(memory, carry.env, key)
            for player, memory, key in zip(players, carry.memories, keys, strict=True)
        ]
        actions = jnp.concatenate([choice.action for choice, _ in acted])[order].reshape(2, n).T
        outcome = env.step(carry.env, actions)
        state = restart(outcome.state, outcome.done)
        returns = carry.returns + outcome.reward
        kept = tuple(memory for _, memory in acted)

        def restart_ended() -> tuple[Any, ...]:
            return tuple(
                select_rows(outcome.done[player.agent_slots % n], player.init(state), memory)
                for player, memory in zip(players, kept, strict=True)
            )

        # Slots of environments that are done get the memory of a new episode, with draws that most steps do not need.
        memories = jax.lax.cond(jnp.any(outcome.done), restart_ended, lambda: kept)
        played = Rollout(
            record=carry.env.record,
            reset=carry.ended,
            actions=actions,
            reward=outcome.reward,
            shaped=outcome.shaped,
            done=outcome.done,
            returns=returns,
            choices=tuple(choice for choice, _ in acted),
        )
        return RolloutCarry(state, outcome.done, memories, jnp.where(outcome.done, 0.0, returns)), played

    return jax.lax.scan(step, carry, jax.random.split(key, steps))


def select_rows(which: Bool[Array, " N"], one: Any, other: Any) -> Any:
    """Return a pytree with rows (axis 0) of `one` where `which` is true, and rows of `other` elsewhere."""

    def select(a: Array, b: Array) -> Array:  # `a` and `b` may be typed JAX keys
        return jnp.where(which.reshape(which.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(select, one, other)


def network_player(
    env: Environment,
    network: ActorCritic,
    params: Any,
    agent_slots: np.ndarray,
    partner: Any,
    greedy: bool | Array = False,
) -> Player:
    """Return a player that follows one policy, or several policies with the same network.

    Args:
        env: the environment.
        network: actor-critic of all policies of the player.
        params: parameters of one policy for slots of shape (M,), or of G policies, stacked, for slots of shape (G, M).
        agent_slots: slots of the player, int (M,) or (G, M).
        partner: number of the other agent's policy in each slot, an int array like `agent_slots`, for the critic.
        greedy: whether to take the most probable action instead of a random action; may be a traced bool ().
    """
    flat, shape = agent_slots.reshape(-1), agent_slots.shape
    view = network.view or CompactView("paper", (env.only_layout,))

    def forward(params, hidden, seen, partner) -> tuple[Array, Array, Array]:
        one_step = jax.tree.map(lambda leaf: leaf[None], seen)
        result: Any = network.apply(params, hidden, one_step, jnp.zeros((1, hidden.shape[0]), bool), partner)
        return result[0], result[1][0], result[2][0]

    def init(state: EnvState) -> Array:
        return jnp.zeros((flat.size, network.widths.gru), jnp.float32)

    def act(hidden, state: EnvState, key):
        seen = view(slot_records(state.record, flat))
        hidden, seen = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), (hidden, seen))
        apply: Any = jax.vmap(forward) if agent_slots.ndim == 2 else forward
        results = apply(params, hidden, seen, partner)
        hidden, logits, value = (x.reshape(flat.size, *x.shape[agent_slots.ndim :]) for x in results)
        # If `greedy` is a constant, the compiler removes the unused branch.
        action = jnp.where(greedy, jnp.argmax(logits, axis=-1), jax.random.categorical(key, logits))
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=-1)[:, 0]
        return Choice(action, log_prob, value), hidden

    return Player(flat, init, act)


def policy_player(
    env: Environment,
    policy: Policy,
    params: Any,
    agent: int,
    envs: int,
    *,
    own_params: bool = False,
    only: np.ndarray | None = None,
) -> Player:
    """Return a player that follows a fixed policy as one agent of all or some environments.

    The initial memory depends only on the episode's key, so an episode does not depend on other episodes of the batch.

    Args:
        env: the environment.
        policy: policy with the functions of the player.
        params: parameters for all environments; with `own_params`, stacked on a leading axis of environments.
        agent: 0 for the ego, 1 for the teammate.
        envs: number N of environments.
        own_params: whether every environment has separate parameters.
        only: int (M,), numbers of the player's environments; all by default.
    """
    axis, played = 0 if own_params else None, np.arange(envs) if only is None else only

    def selected_states(state: EnvState) -> EnvState:
        return state if only is None else jax.tree.map(lambda leaf: leaf[only], state)

    def init(state: EnvState) -> Any:
        keys = jax.vmap(jax.random.fold_in)(env.episode_key(selected_states(state)), jnp.full(len(played), agent))
        return jax.vmap(policy.init, in_axes=(axis, 0))(params, keys)

    def act(memory, state: EnvState, key):
        keys = jax.random.split(key, len(played))
        action, memory = env.act(policy, params, memory, selected_states(state), agent, keys, own=own_params)
        return Choice(action, jnp.zeros(len(played)), jnp.zeros(len(played))), memory

    return Player(agent * envs + played, init, act)


def slot_records(record: UInt8[Array, "*B N S"], agent_slots: np.ndarray) -> UInt8[Array, "*B M S"]:
    """Return the state record of each slot's environment, with the slot's agent as the first agent.

    The network always observes as the first agent, so the columns of the two agents are swapped for slots of agent 1.
    """
    n = record.shape[-2]
    agent, env = np.divmod(agent_slots, n)
    if not agent.any():  # no indexing if the slots are the egos of all environments in order
        return record if np.array_equal(env, np.arange(n)) else record[..., env, :]
    own = record[..., env, :]
    return jnp.where((agent == 1)[:, None], swap_agents(own), own)
