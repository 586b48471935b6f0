"""Populations of policies that learn together: a fixed assignment of policies to agents, and vmapped PPO updates.

Shapes: N environments, P policies (the first L learn), G policies of one group, M agent slots of a policy, T steps. An
algorithm (`fcp`, `brdiv`, `lbrdiv`, `comedi`) defines which policies play together, and the weight of each expected
return. Agent slots are numbered as in `learners.rollout`: a * N + e for agent a of environment e.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.ppo import PPO, ppo_optimizer, sequences, shaping_weight
from icrl4aht_generation.learners.rollout import Player, Rollout, RolloutCarry, init_rollout, network_player, roll_out


class Assignment(NamedTuple):
    """Fixed assignment of policies to both agents of N environments.

    The objective is a weighted sum of *terms*, which are expected returns. Each slot from which a policy
    learns provides samples of one term: the return that the policy maximizes or minimizes in this slot.

    Attributes:
        policy: int (2, N), the policy that plays each agent of each environment.
        term: int (2, N), number of the term that each slot samples; -1 for slots from which no policy learns.
        group: int (P,), group of each policy: a pair from one group is self-play, any other pair is cross-play.
        learning: number L of policies that learn.
        starts_from: int (N,), the environment that provides the start states of episodes, from the states visited
            there; -1 if episodes have the layout's own start.
    """

    policy: np.ndarray
    term: np.ndarray
    group: np.ndarray
    learning: int
    starts_from: np.ndarray

    def agent_slots(self, policy: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the slots from which a policy learns, and the other slots of the policy, as int arrays."""
        own = self.policy.ravel() == policy
        counts = self.term.ravel() >= 0
        return (own & counts).nonzero()[0], (own & ~counts).nonzero()[0]

    @property
    def envs(self) -> int:
        """Number N of environments."""
        return self.policy.shape[1]

    @property
    def policies(self) -> int:
        """Number P of policies."""
        return len(self.group)

    @property
    def partner(self) -> np.ndarray:
        """Number of the other agent's policy, for each agent of each environment; an int array of shape (2 N,)."""
        return self.policy[::-1].ravel()

    @property
    def self_play(self) -> np.ndarray:
        """Whether both policies in each environment have the same `group`, a bool array of shape (N,)."""
        return self.group[self.policy[0]] == self.group[self.policy[1]]


class Algorithm:
    """Base class of population algorithms. An algorithm keeps its state, such as multipliers, in a pytree `memory`.

    Register the name of a new algorithm in `icrl4aht_data.benchmark.facts.ALGORITHMS`, and the algorithm in the module
    `icrl4aht_generation.populations.train`.
    """

    def assignment(self, environments: int) -> Assignment:
        """Return the assignment of policies to agents, with a given number of environments for each member."""
        raise NotImplementedError

    def init(self) -> Any:
        """Return the algorithm's memory before the first update."""
        return ()

    def weights(self, memory: Any) -> Float[Array, " terms"]:
        """Return the weight of each term in the maximized objective; a negative weight minimizes the term."""
        raise NotImplementedError

    def adapt(self, memory: Any, returns: Float[Array, "P P"], seen: Bool[Array, "P P"]) -> Any:
        """Return the algorithm's memory after an update.

        Args:
            memory: memory before the update.
            returns: element [i, j] is the mean return of the episodes that ended in the update with ego policy i and
                teammate policy j.
            seen: whether any such episode ended in the update.
        """
        return memory


class PolicyGroup(NamedTuple):
    """Consecutive policies that one vmap can update, because each policy has the same number of slots.

    Attributes:
        first: index of the first policy.
        agent_slots: int (G, M), slots of each policy; slots from which the policy learns come first.
        counting: number of slots from which each policy learns, at most M.
    """

    first: int
    agent_slots: np.ndarray
    counting: int

    @property
    def _rows(self) -> slice:
        return slice(self.first, self.first + len(self.agent_slots))

    def take(self, tree: Any) -> Any:
        """Return the group's rows of a pytree with leaves of shape (P, ...)."""
        return jax.tree.map(lambda leaf: leaf[self._rows], tree)

    def put(self, tree: Any, rows: Any) -> Any:
        """Return a pytree with leaves of shape (P, ...) after replacing the group's rows."""
        return jax.tree.map(lambda leaf, new: leaf.at[self._rows].set(new), tree, rows)


class PopulationState(NamedTuple):
    """Complete state of a `Population`; an update maps a state to the next state.

    Attributes:
        params: parameters of all policies, leaves (P, ...).
        optimizer: optimizer states of the learning policies, leaves (L, ...).
        carry: environments and memories before the next rollout.
        memory: the algorithm's memory.
        visited: uint8 (N, S), a random state from the last rollout of each environment.
        key: typed JAX key, scalar, constant; every update folds its number into this key.
        update: int32 scalar, number of updates so far.
    """

    params: Any
    optimizer: optax.OptState
    carry: RolloutCarry
    memory: Any
    visited: UInt8[Array, "N S"]
    key: Key[Array, ""]
    update: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Population:
    """Trains policies together on one layout; the PPO updates, which take most of the time, use all devices.

    Args:
        env: environment of the layout.
        algorithm: algorithm that defines the assignment and the weights, see `Algorithm`.
        config: hyper-parameters of every policy; `environments` is the number for one member.
        partners: number of partner policies that the critics distinguish. By default all policies if some policy plays
            with different partners, else 0.
    """

    env: Environment
    algorithm: Algorithm
    config: PPOConfig
    partners: int | None = None

    @cached_property
    def assignment(self) -> Assignment:
        """Assignment of policies to the agents of all environments."""
        return self.algorithm.assignment(self.config.environments)

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps of an update, over all environments."""
        return self.assignment.envs * self.config.rollout

    @cached_property
    def network(self) -> ActorCritic:
        """The network that all policies use, each with its own parameters."""
        policies = self.assignment.policies
        # The partner's number is useless to a policy that always has the same partner.
        pairs = set(zip(self.assignment.policy.ravel(), self.assignment.partner, strict=True))
        partners = policies if len(pairs) > policies else 0
        partners = partners if self.partners is None else self.partners
        return ActorCritic(self.config.widths, partners, view=self.view)

    @cached_property
    def view(self) -> CompactView:
        """View that converts state records to inputs of the network."""
        return CompactView(self.config.widths.encoder, (self.env.only_layout,), agents=(EGO, TEAMMATE))

    @cached_property
    def ppo(self) -> PPO:
        """PPO algorithm that updates each policy."""
        return PPO(self.network, self.config)

    @cached_property
    def groups(self) -> list[PolicyGroup]:
        """Groups of all policies; one vmap can update all policies of a group."""
        # Policies of a group must be adjacent, because a group is a slice of the stacked parameters.
        slots = [self.assignment.agent_slots(policy) for policy in range(self.assignment.policies)]
        shapes = [(p < self.assignment.learning, len(own), len(others)) for p, (own, others) in enumerate(slots)]
        groups = []
        for (_, counting, _), members in groupby(range(len(slots)), key=shapes.__getitem__):
            numbers = list(members)
            groups.append(PolicyGroup(numbers[0], np.stack([np.concatenate(slots[p]) for p in numbers]), counting))
        return groups

    def init(self, key: Key[Array, ""]) -> PopulationState:
        """Return the state of untrained policies with different seeds before the first step."""
        params_key, env_key, running_key = jax.random.split(key, 3)
        # `map` and not `vmap`, because the orthogonal initializers deadlock on a CPU under `vmap`.
        channels = self.env.only_layout.channels
        seeds = jax.random.split(params_key, self.assignment.policies)
        params = jax.lax.map(lambda seed: self.network.untrained(seed, channels), seeds)
        carry = init_rollout(self.env, self._players(params), jax.random.split(env_key, self.assignment.envs))
        learning = jax.tree.map(lambda leaf: leaf[: self.assignment.learning], params)
        return PopulationState(
            params=params,
            optimizer=jax.vmap(ppo_optimizer(self.config).init)(learning),
            carry=carry,
            memory=self.algorithm.init(),
            visited=carry.env.record,
            key=running_key,
            update=jnp.int32(0),
        )

    def update(self, state: PopulationState) -> tuple[PopulationState, dict[str, Array]]:
        """Play a rollout, train every policy on its slots, and adapt the algorithm's memory, as a pure function.

        Returns:
            The next state, and scalar metrics.
        """
        # Keys depend only on the number of the update, so a resumed run needs no other state.
        play_key, learn_key, visit_key = jax.random.split(jax.random.fold_in(state.key, state.update), 3)
        players = self._players(state.params)
        restart = self._restart(state.visited)
        carry, rollout = roll_out(self.env, players, state.carry, self.config.rollout, play_key, restart)
        params, optimizer, losses = self._learn(state, players, carry, rollout, learn_key)
        returns, seen = self._returns(rollout)
        # Keep the state at one random step of each environment as a start of later episodes.
        steps = jax.random.randint(visit_key, (self.assignment.envs,), 0, self.config.rollout)
        after = PopulationState(
            params=params,
            optimizer=optimizer,
            carry=carry,
            memory=self.algorithm.adapt(state.memory, returns, seen),
            visited=jnp.take_along_axis(rollout.record, steps[None, :, None], axis=0)[0],
            key=state.key,
            update=state.update + 1,
        )
        metrics = self._metrics(rollout) | {"shaping": shaping_weight(self.config, state.update)}
        return after, losses | metrics

    @cached_property
    def compiled_update(self) -> Callable[[PopulationState], tuple[PopulationState, dict[str, Array]]]:
        """Compiled function `update`, which reuses the memory of its argument."""
        return jax.jit(self.update, donate_argnums=0)

    def _players(self, params: Any) -> list[Player]:
        """Return one player for each group of policies."""
        return [
            network_player(
                self.env,
                self.network,
                group.take(params),
                group.agent_slots,
                jnp.asarray(self.assignment.partner[group.agent_slots]),
            )
            for group in self.groups
        ]

    def _restart(self, visited: UInt8[Array, "N S"]) -> Callable[[EnvState, Array], EnvState]:
        """Return the argument `restart` of `roll_out`, which starts some episodes from visited states."""
        source = self.assignment.starts_from

        def restart(state: EnvState, done: Bool[Array, " N"]) -> EnvState:
            replaced = (done & (source >= 0))[:, None]
            return state._replace(record=jnp.where(replaced, visited[source], state.record))

        return restart if (source >= 0).any() else lambda state, done: state

    def _learn(self, state: PopulationState, players: list[Player], carry: RolloutCarry, rollout: Rollout, key: Array):
        """Return all policies' parameters and optimizer states after learning from the rollout, and mean losses."""
        weight = self._slot_weights(state.memory)
        shaping = shaping_weight(self.config, state.update)
        params, optimizer, losses = state.params, state.optimizer, []
        for number, (group, player) in enumerate(zip(self.groups, players, strict=True)):
            if group.first >= self.assignment.learning:  # frozen policies do not learn
                continue
            slots = player.agent_slots
            last, _ = player.act(carry.memories[number], carry.env, key)
            # Shaped rewards do not count for a policy that minimizes a return.
            own_shaping = shaping * (weight[slots] >= 0)
            memory, forgiveness = state.carry.memories[number], self.config.forgiveness
            played = sequences(self.view, rollout, number, slots, memory, last.value, own_shaping, forgiveness)
            partner = jnp.asarray(self.assignment.partner[slots])[None]
            played = played._replace(partner=partner, weight=weight[slots][None])

            def by_policy(leaf, shape=group.agent_slots.shape, counting=group.counting):
                """Reshape from (T, G * M, ...) to (G, T, counting, ...), and keep only the slots for learning."""
                return jnp.moveaxis(leaf.reshape(leaf.shape[0], *shape, *leaf.shape[2:]), 1, 0)[:, :, :counting]

            # Every policy starts from its old parameters, so the order of the groups does not matter.
            keys = jax.random.split(jax.random.fold_in(key, number), len(group.agent_slots))
            own = (group.take(state.params), group.take(state.optimizer), jax.tree.map(by_policy, played), keys)
            new_params, new_optimizer, loss = self._learn_by_policy(group)(*own)
            params, optimizer = group.put(params, new_params), group.put(optimizer, new_optimizer)
            losses.append(loss)
        return params, optimizer, jax.tree.map(lambda *parts: jnp.concatenate(parts).mean(), *losses)

    def _learn_by_policy(self, group: PolicyGroup) -> Callable[..., Any]:
        """Return `PPO.learn` for each policy of a group, sharded over devices in equal parts."""
        learn, devices = jax.vmap(self.ppo.learn), jax.devices()
        # `shard_map` needs equal parts, so three policies use only one of two devices.
        count = max(n for n in range(1, len(devices) + 1) if len(group.agent_slots) % n == 0)
        if count == 1:
            return learn
        mesh = Mesh(np.array(devices[:count]), ("policy",))
        each = PartitionSpec("policy")
        return jax.shard_map(learn, mesh=mesh, in_specs=each, out_specs=each, check_vma=False)

    def _slot_weights(self, memory: Any) -> Float[Array, " 2N"]:
        """Return the weight of each slot's advantage; 0 for slots from which no policy learns."""
        policies = self.assignment.policies
        term, policy = self.assignment.term.ravel(), self.assignment.policy.ravel()  # int (2N,) each
        learned = term >= 0  # bool (2N,)
        # Slots with the same term are samples of one expected return, and share the weight of this return.
        weights = self.algorithm.weights(memory)  # float32 (terms,)
        samples = np.bincount(term[learned], minlength=len(weights))  # int (terms,)
        shared = weights / np.maximum(samples, 1)  # float32 (terms,)
        raw = jnp.where(learned, shared[term], 0.0)  # float32 (2N,)
        # Scale the mean absolute weight of each policy to 1, so learning rates are comparable between algorithms.
        total = jnp.zeros(policies).at[policy].add(jnp.abs(raw))  # float32 (P,)
        slots = np.bincount(policy[learned], minlength=policies)  # int (P,)
        scale = slots / jnp.maximum(total, 1e-8)  # float32 (P,)
        return raw * scale[policy]

    def _returns(self, rollout: Rollout) -> tuple[Float[Array, "P P"], Bool[Array, "P P"]]:
        """Return the mean return of ended episodes for each pair of policies, and whether any episode ended."""
        size = (self.assignment.policies,) * 2
        pairs = tuple(self.assignment.policy)
        # Several environments have the same pair of policies, so `at[].add` sums over these environments.
        ended = jnp.zeros(size).at[pairs].add(rollout.done.sum(axis=0))
        total = jnp.zeros(size).at[pairs].add(jnp.where(rollout.done, rollout.returns, 0.0).sum(axis=0))
        return total / jnp.maximum(ended, 1), ended > 0

    def _metrics(self, rollout: Rollout) -> dict[str, Array]:
        """Return metrics by name, with mean returns of ended episodes in self-play and cross-play; 0 if none ended."""

        def mean_return(envs: np.ndarray) -> Array:
            done = rollout.done & envs
            return jnp.sum(jnp.where(done, rollout.returns, 0.0)) / jnp.maximum(jnp.sum(done), 1)

        # Episodes that start from visited states are left out, because their returns are not comparable.
        usual_start = self.assignment.starts_from < 0
        self_play = self.assignment.self_play
        return {
            "episodes": jnp.sum(rollout.done),
            "self_play": mean_return(self_play & usual_start),
            "cross_play": mean_return(~self_play),
            "shaped_per_step": jnp.mean(rollout.shaped),
        }
