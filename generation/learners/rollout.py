"""The one roll-out that learners learn from: N tables, and players who share their 2 N places.

Place p is seat p // N of table p % N. A player has a fixed set of places, so every table may seat another pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from generation.env import Environment, EnvState
from generation.learners.network import ActorCritic
from generation.policy import Policy
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import swapped


class Choice(NamedTuple):
    """What a player does in one step at its M places; zeros where there is no such thing."""

    action: Int[Array, " M"]
    log_prob: Float[Array, " M"]
    value: Float[Array, " M"]


class Player(NamedTuple):
    """Who sits at some of the places; memories start anew with each episode."""

    places: np.ndarray  # int (M,)
    begin: Callable[[EnvState], Any]  # fresh memories, leaves (M, ...)
    act: Callable[[Any, EnvState, Key[Array, ""]], tuple[Choice, Any]]


class Seats(NamedTuple):
    """Everything a roll-out carries. N tables."""

    env: EnvState
    ended: Bool[Array, " N"]  # the last step ended an episode
    memories: tuple[Any, ...]  # the players'
    returns: Float[Array, " N"]  # of the running episodes so far, the team's unshaped reward


class Rollout(NamedTuple):
    """T steps of N tables."""

    record: UInt8[Array, "T N S"]  # before the step
    reset: Bool[Array, "T N"]  # `record` starts an episode
    actions: Int[Array, "T N 2"]
    reward: Float[Array, "T N"]  # the team's, unshaped
    shaped: Float[Array, "T N 2"]  # each agent's own
    done: Bool[Array, "T N"]
    returns: Float[Array, "T N"]  # of the episode that ended here, where `done`
    choices: tuple[Choice, ...]  # the players', leaves (T, M)


def init_rollout(env: Environment, players: Sequence[Player], keys: Key[Array, " N"]) -> Seats:
    """The tables before the first step; one key a table."""
    state = env.init(keys)
    n = state.clock.shape[0]
    memories = tuple(player.begin(state) for player in players)
    return Seats(state, jnp.ones(n, bool), memories, jnp.zeros(n))


def roll_out(
    env: Environment,
    players: Sequence[Player],
    seats: Seats,
    steps: int,
    key: Key[Array, ""],
    restart: Callable[[EnvState, Bool[Array, " N"]], EnvState] = lambda state, done: state,
) -> tuple[Seats, Rollout]:
    """`steps` steps of every table.

    Args:
        restart: changes the first states of new episodes, where `done`.
    """
    n = seats.ended.shape[0]
    order = np.argsort(np.concatenate([player.places for player in players]))

    def step(seats: Seats, key: Key[Array, ""]) -> tuple[Seats, Rollout]:
        keys = jax.random.split(key, len(players))
        acts = [
            player.act(memory, seats.env, key)
            for player, memory, key in zip(players, seats.memories, keys, strict=True)
        ]
        actions = jnp.concatenate([choice.action for choice, _ in acts])[order].reshape(2, n).T
        outcome = env.step(seats.env, actions)
        state = restart(outcome.state, outcome.done)
        returns = seats.returns + outcome.reward
        memories = tuple(
            _begin_anew(player, memory, state, outcome.done) for player, (_, memory) in zip(players, acts, strict=True)
        )
        played = Rollout(
            record=seats.env.record,
            reset=seats.ended,
            actions=actions,
            reward=outcome.reward,
            shaped=outcome.shaped,
            done=outcome.done,
            returns=returns,
            choices=tuple(choice for choice, _ in acts),
        )
        return Seats(state, outcome.done, memories, jnp.where(outcome.done, 0.0, returns)), played

    return jax.lax.scan(step, seats, jax.random.split(key, steps))


def _begin_anew(player: Player, memory: Any, state: EnvState, done: Bool[Array, " N"]) -> Any:
    ended = done[player.places % done.shape[0]]
    return jax.tree.map(lambda new, old: _where(ended, new, old), player.begin(state), memory)


def network_player(
    env: Environment, network: ActorCritic, params: Any, places: np.ndarray, partner: Any, greedy: bool = False
) -> Player:
    """A policy of the one network, or several.

    Args:
        params: of one policy for places (M,); stacked on a leading axis G of as many policies for places (G, M).
        partner: integers of the shape of `places`, who sits opposite, for the critic.
        greedy: take the likeliest action instead of drawing one.
    """
    flat, shape = places.reshape(-1), places.shape

    def forward(params, hidden, obs, partner) -> tuple[Array, Array, Array]:
        result: Any = network.apply(params, hidden, obs[None], jnp.zeros((1, obs.shape[0]), bool), partner)
        return result[0], result[1][0], result[2][0]

    def begin(state: EnvState) -> Array:
        return jnp.zeros((flat.size, network.widths.gru), jnp.float32)

    def act(hidden, state: EnvState, key):
        obs = observe(env.layout, seen_from(state.record, flat), EGO)
        hidden, obs = (x.reshape(*shape, *x.shape[1:]) for x in (hidden, obs))
        apply: Any = jax.vmap(forward) if places.ndim == 2 else forward
        results = apply(params, hidden, obs, partner)
        hidden, logits, value = (x.reshape(flat.size, *x.shape[places.ndim :]) for x in results)
        action = jnp.argmax(logits, axis=-1) if greedy else jax.random.categorical(key, logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=-1)[:, 0]
        return Choice(action, log_prob, value), hidden

    return Player(flat, begin, act)


def policy_player(
    env: Environment, policy: Policy, params: Any, seat: int, tables: int, *, own_params: bool = False
) -> Player:
    """A policy that does not learn, in one seat of every table. Its memory is a function of the episode's own key.

    Args:
        params: of one instance for all tables; with `own_params`, stacked on a leading axis, one instance a table.
    """
    axis = 0 if own_params else None

    def begin(state: EnvState) -> Any:
        keys = jax.vmap(jax.random.fold_in)(env.episode_key(state), jnp.full(tables, seat))
        return jax.vmap(policy.init, in_axes=(axis, 0))(params, keys)

    def act(memory, state: EnvState, key):
        view = state.record if policy.sees == "state" else env.observe_one(state, seat)
        step = jax.vmap(policy.act, in_axes=(axis, 0, 0, 0))
        action, memory = step(params, memory, view, jax.random.split(key, tables))
        return Choice(action, jnp.zeros(tables), jnp.zeros(tables)), memory

    return Player(seat * tables + np.arange(tables), begin, act)


def random_player(seat: int, tables: int) -> Player:
    """Uniform over the six actions, in one seat of every table."""

    def act(memory, state: EnvState, key):
        return Choice(jax.random.randint(key, (tables,), 0, len(ACTIONS)), jnp.zeros(tables), jnp.zeros(tables)), memory

    return Player(seat * tables + np.arange(tables), lambda state: (), act)


def seen_from(record: UInt8[Array, "*B N S"], places: np.ndarray) -> UInt8[Array, "*B M S"]:
    """The records of the tables at these places, in each the agent that sits there first."""
    seat, table = np.divmod(places, record.shape[-2])
    if not seat.any():
        return record if np.array_equal(table, np.arange(record.shape[-2])) else record[..., table, :]
    at_table = record[..., table, :]
    return jnp.where((seat == 1)[:, None], swapped(at_table), at_table)


def _where(mask: Bool[Array, " M"], new: Array, old: Array) -> Array:
    """`jnp.where` with the mask on the leading axis; also for typed keys."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 1)), new, old)
