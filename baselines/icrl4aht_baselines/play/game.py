"""Episodes that people and policies play step by step, with the NumPy implementation of the rules.

Initial states, recipes and the random keys of policies are those of an evaluation of the same task with seed 0, see
`icrl4aht_baselines.evaluate.rollout`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.policy import Policy, on_layout
from icrl4aht_generation.teammates.instances import INSTANCE_NAMES, published_task
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_baselines.agents.egos import agent_names, find_agent
from icrl4aht_baselines.agents.host import EgoInput
from icrl4aht_baselines.evaluate.rollout import EGO_STEPS, TEAMMATE_STEPS
from icrl4aht_data.benchmark.facts import LAYOUT_NAMES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError, unknown_name
from icrl4aht_data.format.schema import episode_ends
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import EGO, STAY
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS, Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import swap_agents

HUMAN = "human"
"""Name of the partner if it is a second person."""


class _SwappedLayout(Layout):
    """Layout with the start cells of its two agents exchanged, for an ego that plays agent 1."""

    @cached_property
    def agent_cells(self) -> tuple[int, ...]:
        return super().agent_cells[::-1]


class PolicyPlayer:
    """Policy that plays one agent of a game.

    Args:
        policy: the policy.
        layout: layout of the game; the agents' start cells are exchanged if an ego plays agent 1.
        slot: 0 or 1, number of the agent that the policy plays.
        is_ego: whether the policy is an ego, which always sees itself as agent 0 and keeps its memory between episodes.
            A test teammate sees the unchanged state, and starts each episode with a new memory.
    """

    def __init__(self, policy: Policy, layout: Layout, slot: int, *, is_ego: bool) -> None:
        policy = on_layout(policy, layout) if policy.sees == "situation" else policy
        self.policy = policy._replace(params=jax.device_put(policy.params))  # transferred once, not at every step
        self.layout, self.slot, self.is_ego, self._memory = layout, slot, is_ego, None
        act = self.policy.act
        self._act = jax.jit(lambda params, memory, view, key, t: act(params, memory, view, jax.random.fold_in(key, t)))

    def begin(self, task_key: jax.Array, episode_key: jax.Array, episode: int) -> None:
        """Prepare for an episode. The memory is reset, except that an ego keeps it from one episode to the next."""
        self._key = jax.random.fold_in(episode_key, (EGO_STEPS, TEAMMATE_STEPS)[self.slot])
        if episode == 0 or not self.is_ego:
            key = jax.random.fold_in(task_key if self.is_ego else episode_key, self.slot)
            self._memory = self.policy.init(self.policy.params, key)

    def act(self, record: np.ndarray, before: EgoInput, t: int) -> int:
        """Return the action in step `t` of the episode, 0..5.

        Args:
            record: uint8 (S,), state record before the step.
            before: outcome of the previous step for this agent; the field `obs` is not used.
            t: number of the step in the episode, from 0.
        """
        view: Any = swap_agents(record) if self.is_ego and self.slot != EGO else record
        if self.policy.sees != "state":
            obs = observe(self.layout, view[None], EGO, self.policy.sees == "canonical_input")[0]
            view = before._replace(obs=obs)
        action, self._memory = self._act(self.policy.params, self._memory, view, self._key, np.int32(t))
        return int(action)


class Partner(NamedTuple):
    """Partner of a person: a policy or a second person.

    Attributes:
        player: policy of the partner; None for a second person.
        task: published test task of the partner, if it is a test teammate; otherwise None.
    """

    player: PolicyPlayer | None
    task: Task | None = None


def find_partner(name: str, layout: Layout, slot: int) -> Partner:
    """Return a partner by its name: an ego of `evaluate`, a test teammate such as "H1/t0", or "human".

    Args:
        name: name of the partner.
        layout: layout of the game.
        slot: 0 or 1, number of the agent that the partner plays.

    Raises:
        UnknownNameError: if the name is unknown.
        OptionError: if the partner cannot play on the layout.
    """
    if name == HUMAN:
        return Partner(None)
    if name in INSTANCE_NAMES:
        if layout.name not in (*LAYOUT_NAMES, *LAYOUT_PLUGINS.names):
            raise OptionError(
                f"--with {name}: test teammates play only published and registered layouts, found {layout.name}; "
                f"give another --layout, or a partner that plays this one: {', '.join((HUMAN, *agent_names()))}"
            )
        task = published_task(layout.name, name)
        policy = build_teammate(layout, task.teammate, slot)
        return Partner(PolicyPlayer(policy, layout, slot, is_ego=False), task)
    if name not in agent_names() and not Path(name).is_dir():
        raise unknown_name("partner", name, (HUMAN, *agent_names(), *INSTANCE_NAMES))
    if slot != EGO:
        layout = _SwappedLayout(**{one.name: getattr(layout, one.name) for one in fields(Layout)})
    return Partner(PolicyPlayer(find_agent(name).make(layout), layout, slot, is_ego=True))


class Game:
    """Game of several episodes that two agents play on one layout.

    Args:
        layout: layout of the game.
        players: policies of agents 0 and 1; None for people.
        key: random key of the task, see `icrl4aht_baselines.evaluate.rollout.task_key`.
        episodes: number of episodes.
        steps: steps of an episode.

    Attributes:
        record: uint8 (S,), state record of the current state.
        returns: returns of the finished episodes.
        clock: number of steps taken in the running episode.
        earned: return of the running episode so far.
    """

    def __init__(
        self, layout: Layout, players: Sequence[PolicyPlayer | None], key: jax.Array, episodes: int, steps: int
    ) -> None:
        self.layout, self.key, self.episodes, self.steps = layout, key, episodes, steps
        env = Environment(layout, steps)

        def begin_episode(episode: jax.Array) -> Any:
            state = env.init(key[None])._replace(episode=episode[None])
            return env.first_record(state.key, state.episode)[0], env.episode_key(state)[0]

        def draw_recipe(episode: jax.Array, clock: jax.Array) -> Any:
            empty = jnp.zeros((1, 0), jnp.uint8)
            return env.next_recipe(EnvState(key[None], episode[None], clock[None], empty))

        self._begin_episode, self._draw_recipe = jax.jit(begin_episode), jax.jit(draw_recipe)
        self._restart(players)

    def with_players(self, players: Sequence[PolicyPlayer | None]) -> Game:
        """Return a copy of this game at its first step, with the given players."""
        other = copy(self)
        other._restart([copy(player) for player in players])
        return other

    def _restart(self, players: Sequence[PolicyPlayer | None]) -> None:
        self.players, self.returns = list(players), list[float]()
        self._rows, self._ends = list[tuple[np.ndarray, list[int], int]](), list[np.ndarray]()
        self._before = (np.int32(0), np.int32(0), np.float32(0), np.bool_(False))
        self._begin()

    def _begin(self) -> None:
        self.clock, self.earned = 0, 0
        record, key = self._begin_episode(np.int32(len(self.returns)))
        self.record = np.asarray(record)
        for player in filter(None, self.players):
            player.begin(self.key, key, len(self.returns))

    @property
    def people(self) -> list[int]:
        """Numbers of the agents that people play."""
        return [slot for slot, player in enumerate(self.players) if player is None]

    @property
    def is_over(self) -> bool:
        """Whether all episodes are finished."""
        return len(self.returns) == self.episodes

    def step(self, chosen: Mapping[int, int]) -> int:
        """Take one step, and return its reward. After the last step of an episode, the next episode begins.

        Args:
            chosen: number of an agent that a person plays -> action, 0..5; agents without an action stay.
        """
        *last, reward, done = self._before
        actions = [
            chosen.get(slot, STAY)
            if player is None
            else player.act(self.record, EgoInput(None, last[slot], reward, last[1 - slot], done), self.clock)
            for slot, player in enumerate(self.players)
        ]
        recipe = np.asarray(self._draw_recipe(np.int32(len(self.returns)), np.int32(self.clock)))
        outcome = rules.step(self.layout, self.record[None], np.array([actions]), recipe)
        earned = int(outcome.reward[0])
        self._rows.append((self.record, actions, earned))
        self.record, self.clock, self.earned = outcome.state[0], self.clock + 1, self.earned + earned
        done = self.clock == self.steps
        self._before = (*np.array(actions, np.int32), np.float32(earned), np.bool_(done))
        if done:
            self._ends.append(self.record)
            self.returns.append(float(self.earned))
            if not self.is_over:
                self._begin()
        return earned

    def play(self) -> list[float]:
        """Play all remaining episodes without people. Return the returns of all episodes."""
        while not self.is_over:
            self.step({})
        return self.returns

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the finished episodes as the arrays of a history, see `icrl4aht_data.format.schema.FIELDS`."""
        rows = self._rows[: len(self.returns) * self.steps]
        state, actions, rewards = (np.array(part) for part in zip(*rows, strict=True))
        return {
            "state": state,
            "actions": actions[:, 0],
            "teammate_actions": actions[:, 1],
            "rewards": rewards,
            "dones": episode_ends(len(rows), self.steps),
            "episode_end_state": np.stack(self._ends),
        }
