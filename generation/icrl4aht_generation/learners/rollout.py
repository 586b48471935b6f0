"""The one rollout that learners learn from: N environments, whose 2 N agents are shared out among players.

N denotes the number of environments, M the number of agent slots of one player, T the number of steps. An *agent slot*
is one agent of one environment: slot a * N + e is agent a (0 the ego, 1 the teammate) of environment e. A player acts
in a fixed set of slots, so every environment may pair other players, and a policy may play either agent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.overcooked.state import swapped
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
    """A policy, or several of one shape, in a fixed set of agent slots.

    Attributes:
        agent_slots: int (M,), NumPy, so that the pairing is known when the rollout is compiled.
        init: environment states -> memories at the start of an episode, leaves (M, ...).
        act: memories, environment states and a key -> choices and the memories after the step.
    """

    agent_slots: np.ndarray
    init: Callable[[EnvState], Any]
    act: Callable[[Any, EnvState, Key[Array, ""]], tuple[Choice, Any]]


class RolloutCarry(NamedTuple):
    """State between two rollouts.

    Attributes:
        env: states of the N environments.
        ended: bool (N,), whether the last step ended an episode.
        memories: one pytree per player, leaves (M, ...).
        returns: float32 (N,), the team's unshaped reward of the running episode so far.
    """

    env: EnvState
    ended: Bool[Array, " N"]
    memories: tuple[Any, ...]
    returns: Float[Array, " N"]


class Rollout(NamedTuple):
    """T steps of N environments.

    Attributes:
        record: uint8 (T, N, S), state records before each step.
        reset: bool (T, N), whether `record` starts an episode.
        actions: int32 (T, N, 2), ids 0..5 of ego and teammate.
        reward: float32 (T, N), the team's, unshaped.
        shaped: float32 (T, N, 2), each agent's own shaped reward.
        done: bool (T, N), whether the step ended an episode.
        returns: float32 (T, N), return of the episode so far; of the complete episode where `done`.
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
    """Return the carry before the first step; one key per environment."""
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
        players: players whose agent slots are 0..2N-1, each once.
        carry: from `init_rollout` or the rollout before.
        steps: T.
        key: for the players' draws; those of the environment come from the environments' own keys.
        restart: changes the states of environments whose next episode starts, those with `done`.
    """
    n = carry.ended.shape[0]
    # Players' actions are concatenated; this permutation puts them into the order of the slots.
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
        # The memory of a new episode, in the slots whose environment is done.
        memories = tuple(
            select_rows(outcome.done[player.agent_slots % n], player.init(state), memory)
            for player, (_, memory) in zip(players, acted, strict=True)
        )
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
    """Return a pytree with the rows of `one` where `which`, and those of `other` elsewhere; rows are on axis 0."""

    def select(a: Array, b: Array) -> Array:  # leaves may be typed keys
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
    """Return a player that acts by one policy of the network, or by several at once.

    Args:
        env: the environment.
        network: the actor-critic of all its policies.
        params: parameters of one policy for slots (M,); stacked on a leading axis of G policies for slots (G, M).
        agent_slots: int (M,) or (G, M).
        partner: int of the shape of `agent_slots`, number of the policy of the other agent, for the critic.
        greedy: take the most probable action instead of drawing one; bool (), if compiled code decides it.
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
        # Where `greedy` is a constant, the compiler drops the other way.
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
    """Return a player that does not learn, as one agent of every environment, or of some.

    Its memory is a function of the episode's own key, so that an episode does not depend on the others of the batch.

    Args:
        env: the environment.
        policy: the policy's functions.
        params: parameters for all its environments; with `own_params`, stacked on a leading axis, one for each.
        agent: 0 or 1.
        envs: N.
        own_params: whether every environment has parameters of its own.
        only: int (M,), numbers of its environments; all by default.
    """
    axis, played = 0 if own_params else None, np.arange(envs) if only is None else only

    def own_states(state: EnvState) -> EnvState:
        return state if only is None else jax.tree.map(lambda leaf: leaf[only], state)

    def init(state: EnvState) -> Any:
        keys = jax.vmap(jax.random.fold_in)(env.episode_key(own_states(state)), jnp.full(len(played), agent))
        return jax.vmap(policy.init, in_axes=(axis, 0))(params, keys)

    def act(memory, state: EnvState, key):
        keys = jax.random.split(key, len(played))
        action, memory = env.act(policy, params, memory, own_states(state), agent, keys, own=own_params)
        return Choice(action, jnp.zeros(len(played)), jnp.zeros(len(played))), memory

    return Player(agent * envs + played, init, act)


def slot_records(record: UInt8[Array, "*B N S"], agent_slots: np.ndarray) -> UInt8[Array, "*B M S"]:
    """Return the state record of each slot's environment, with the slot's agent as the first agent.

    The network always observes as the first agent; the columns of the two agents are swapped for slots of agent 1.
    """
    n = record.shape[-2]
    agent, env = np.divmod(agent_slots, n)
    if not agent.any():  # the ego's slots in order need no gather
        return record if np.array_equal(env, np.arange(n)) else record[..., env, :]
    own = record[..., env, :]
    return jnp.where((agent == 1)[:, None], swapped(own), own)
