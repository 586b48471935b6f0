"""Policies that learn together: a fixed seating of policies at tables, one PPO for each, all at once by vmap.

An algorithm says who sits where, and how much each expected return counts: `fcp`, `brdiv`, `lbrdiv`, `comedi`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from generation.env import Environment, EnvState
from generation.learners.network import ActorCritic
from generation.learners.ppo import PPO, PPOConfig, sequences
from generation.learners.rollout import Player, Rollout, Seats, init_rollout, network_player, roll_out


class Seating(NamedTuple):
    """Who sits at which of N tables, for good; P policies, of which the first L learn.

    A *term* is an expected return that a learning policy raises or brings down; each place that counts for its policy
    is a sample of one term.
    """

    policy: np.ndarray  # int (2, N), the policy in each seat of each table
    term: np.ndarray  # int (2, N), which term a place is a sample of; -1 for none
    kin: np.ndarray  # int (P,), policies of one number are meant to play together: self-play
    learning: int  # L
    starts_from: np.ndarray  # int (N,), the table whose visited states a table's episodes start from; -1 for none

    def places(self, policy: int) -> tuple[np.ndarray, np.ndarray]:
        """A policy's places: those that it learns from, and the others."""
        mine = self.policy.ravel() == policy
        counts = self.term.ravel() >= 0
        return (mine & counts).nonzero()[0], (mine & ~counts).nonzero()[0]

    @property
    def tables(self) -> int:
        return self.policy.shape[1]

    @property
    def policies(self) -> int:
        return len(self.kin)

    @property
    def opposite(self) -> np.ndarray:
        """int (2 N,): the policy opposite each place."""
        return self.policy[::-1].ravel()

    @property
    def self_play(self) -> np.ndarray:
        """bool (N,): tables where kin play."""
        return self.kin[self.policy[0]] == self.kin[self.policy[1]]


class Algorithm(Protocol):
    """What tells the algorithms apart. `memory` is a pytree of its own: multipliers, say."""

    def seating(self, environments: int) -> Seating:
        """Who sits where, if each member has so many tables."""
        ...

    def begin(self) -> Any:
        """The memory before the first update."""
        ...

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        """The weight of each term in the objective that every policy maximises; negative to bring a return down."""
        ...

    def adapt(self, memory: Any, returns: Float[Array, "P P"], seen: Bool[Array, "P P"]) -> Any:
        """The memory after an update.

        Args:
            returns: [i, j] is the mean return of the episodes that ended in the update with i in seat 0, j in seat 1.
            seen: whether there was one.
        """
        ...


class Group(NamedTuple):
    """Successive policies with equally many places, so that one vmap serves them all."""

    first: int
    places: np.ndarray  # int (G, M), those that count first
    counting: int  # how many count

    def of(self, tree: Any) -> Any:
        """Its part of leaves (P, ...)."""
        return jax.tree.map(lambda leaf: leaf[self.first : self.first + len(self.places)], tree)


class PopulationState(NamedTuple):
    """What an update maps to the next one; all that a resume needs."""

    params: Any  # leaves (P, ...)
    optimizer: optax.OptState  # leaves (L, ...)
    seats: Seats
    memory: Any  # the algorithm's
    visited: UInt8[Array, "N S"]  # one of the states that each table went through in its last roll-out
    key: Key[Array, ""]
    update: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Population:
    """Policies that learn together in one layout; their learning, nearly all of the work, uses every device.

    Args:
        env: the layout's environment.
        algorithm: see `Algorithm`.
        config: of every policy; `environments` are the tables of one member.
        partners: how many policies the critics are told apart; as many as there are, if they meet different ones.
    """

    env: Environment
    algorithm: Algorithm
    config: PPOConfig
    partners: int | None = None

    @cached_property
    def seating(self) -> Seating:
        return self.algorithm.seating(self.config.environments)

    @property
    def steps_per_update(self) -> int:
        """Environment steps, over all tables."""
        return self.seating.tables * self.config.rollout

    @cached_property
    def network(self) -> ActorCritic:
        """With a critic that is told who sits opposite, if that varies."""
        if self.partners is not None:
            return ActorCritic(self.config.widths, self.partners)
        pairs = {(p, q) for p, q in zip(self.seating.policy.ravel(), self.seating.opposite, strict=True)}
        return ActorCritic(self.config.widths, self.seating.policies if len(pairs) > self.seating.policies else 0)

    @cached_property
    def ppo(self) -> PPO:
        return PPO(self.env.layout, self.network, self.config)

    @cached_property
    def groups(self) -> list[Group]:
        seating, found = self.seating, []
        places = [seating.places(policy) for policy in range(seating.policies)]
        shape = [(policy < seating.learning, len(a), len(b)) for policy, (a, b) in enumerate(places)]
        for (_, counting, _), members in groupby(range(seating.policies), key=shape.__getitem__):
            group = list(members)
            found.append(Group(group[0], np.stack([np.concatenate(places[p]) for p in group]), counting))
        return found

    def init(self, key: Key[Array, ""]) -> PopulationState:
        """Untrained policies, each from a seed of its own, at fresh tables."""
        weights, tables, running = jax.random.split(key, 3)
        # Not by vmap: orthogonal initialisers deadlock under it on a CPU.
        channels = self.env.layout.channels
        seeds = jax.random.split(weights, self.seating.policies)
        params = jax.lax.map(lambda seed: self.network.untrained(seed, channels), seeds)
        seats = init_rollout(self.env, self._players(params), jax.random.split(tables, self.seating.tables))
        learning = jax.tree.map(lambda leaf: leaf[: self.seating.learning], params)
        return PopulationState(
            params=params,
            optimizer=jax.vmap(self.config.optimizer.init)(learning),
            seats=seats,
            memory=self.algorithm.begin(),
            visited=seats.env.record,
            key=running,
            update=jnp.int32(0),
        )

    def _learn_apart(self, group: Group) -> Callable[..., Any]:
        """The PPO of each policy of a group, the policies shared out over as many devices as divide them evenly."""
        learn, devices = jax.vmap(self.ppo.learn), jax.devices()
        count = max(n for n in range(1, len(devices) + 1) if len(group.places) % n == 0)
        if count == 1:
            return learn
        mesh = Mesh(np.array(devices[:count]), ("policy",))
        each = PartitionSpec("policy")
        return jax.shard_map(learn, mesh=mesh, in_specs=each, out_specs=each, check_vma=False)

    def update(self, state: PopulationState) -> tuple[PopulationState, dict[str, Array]]:
        """One roll-out, the epochs of every learning policy over its part of it, the algorithm's own step.

        A pure function of the state.
        """
        rolling, learning, visiting = jax.random.split(jax.random.fold_in(state.key, state.update), 3)
        players = self._players(state.params)
        restart = self._restart(state.visited)
        seats, rollout = roll_out(self.env, players, state.seats, self.config.rollout, rolling, restart)
        params, optimizer, losses = self._learn(state, players, seats, rollout, learning)
        returns, seen = self._returns(rollout)
        steps = jax.random.randint(visiting, (self.seating.tables,), 0, self.config.rollout)
        after = PopulationState(
            params=params,
            optimizer=optimizer,
            seats=seats,
            memory=self.algorithm.adapt(state.memory, returns, seen),
            visited=jnp.take_along_axis(rollout.record, steps[None, :, None], axis=0)[0],
            key=state.key,
            update=state.update + 1,
        )
        return after, losses | self._metrics(rollout) | {"shaping": self.config.shaping(state.update)}

    def _players(self, params: Any) -> list[Player]:
        return [
            network_player(
                self.env, self.network, group.of(params), group.places, jnp.asarray(self.seating.opposite[group.places])
            )
            for group in self.groups
        ]

    def _restart(self, visited: Array) -> Callable[[EnvState, Array], EnvState]:
        source = self.seating.starts_from

        def restart(state: EnvState, done: Bool[Array, " N"]) -> EnvState:
            moved = (done & (source >= 0))[:, None]
            return state._replace(record=jnp.where(moved, visited[source], state.record))

        return restart if (source >= 0).any() else lambda state, done: state

    def _learn(self, state: PopulationState, players: list[Player], seats: Seats, rollout: Rollout, key: Array):
        weight = self._place_weights(state.memory)
        shaping = self.config.shaping(state.update)
        params, optimizer, losses = state.params, state.optimizer, []
        for number, (group, player) in enumerate(zip(self.groups, players, strict=True)):
            if group.first >= self.seating.learning:
                continue
            last, _ = player.act(seats.memories[number], seats.env, key)
            raised = shaping * (weight[player.places] >= 0)  # shaping shows the way up, and nothing else
            played = sequences(rollout, number, player.places, state.seats.memories[number], last.value, raised)
            played = played._replace(
                partner=jnp.asarray(self.seating.opposite[player.places])[None], weight=weight[player.places][None]
            )

            def by_policy(leaf, shape=group.places.shape, counting=group.counting):
                return jnp.moveaxis(leaf.reshape(leaf.shape[0], *shape, *leaf.shape[2:]), 1, 0)[:, :, :counting]

            keys = jax.random.split(jax.random.fold_in(key, number), len(group.places))
            own = (group.of(state.params), group.of(state.optimizer), jax.tree.map(by_policy, played), keys)
            new_params, new_optimizer, loss = self._learn_apart(group)(*own)
            params, optimizer = _put(params, new_params, group), _put(optimizer, new_optimizer, group)
            losses.append(loss)
        return params, optimizer, jax.tree.map(lambda *parts: jnp.concatenate(parts).mean(), *losses)

    def _place_weights(self, memory: Any) -> Float[Array, " 2N"]:
        """The weight of each place's advantage: its term's, shared among the term's places, 1 on a policy's average."""
        term, policy = self.seating.term.ravel(), self.seating.policy.ravel()
        counts = np.bincount(term[term >= 0])
        raw = jnp.where(term >= 0, self.algorithm.weights(memory)[term] / np.maximum(counts, 1)[term], 0.0)
        total = jnp.zeros(self.seating.policies).at[policy].add(jnp.abs(raw))
        samples = np.bincount(policy[term >= 0], minlength=self.seating.policies)
        return raw * (samples / jnp.maximum(total, 1e-8))[policy]

    def _returns(self, rollout: Rollout) -> tuple[Float[Array, "P P"], Bool[Array, "P P"]]:
        size = (self.seating.policies,) * 2
        pairs = tuple(self.seating.policy)
        ended = jnp.zeros(size).at[pairs].add(rollout.done.sum(axis=0))
        total = jnp.zeros(size).at[pairs].add(jnp.where(rollout.done, rollout.returns, 0.0).sum(axis=0))
        return total / jnp.maximum(ended, 1), ended > 0

    def _metrics(self, rollout: Rollout) -> dict[str, Array]:
        """Mean returns of the episodes that ended, in self-play and in cross-play; 0 where none did."""

        def mean(tables: np.ndarray) -> Array:
            done = rollout.done & tables
            return jnp.sum(jnp.where(done, rollout.returns, 0.0)) / jnp.maximum(jnp.sum(done), 1)

        fresh = self.seating.starts_from < 0
        kin = self.seating.self_play
        return {
            "episodes": jnp.sum(rollout.done),
            "self_play": mean(kin & fresh),
            "cross_play": mean(~kin),
            "shaped_per_step": jnp.mean(rollout.shaped),
        }


def _put(whole: Any, part: Any, group: Group) -> Any:
    return jax.tree.map(lambda a, b: a.at[group.first : group.first + len(group.places)].set(b), whole, part)
