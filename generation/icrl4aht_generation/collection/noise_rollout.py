"""Roll-outs of the source `noise`: the scripted oracle acts, and the chance of a random action falls over a history.

Noise distillation (Zisman et al. 2024, "Emergence of In-Context Reinforcement Learning from Noise Distillation") makes
learning histories without learning. All episodes of a task are environments of their own: an episode is a pure function
of the task's seed, its history's number, its own number and its chance, whatever else is in the batch.

Shapes: `N` histories, `E` episodes of each, `M` episodes of one batch, `S` bytes of a state record.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int8, Key, UInt8

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Tables
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.experts.oracle import SITUATION_ORACLE
from icrl4aht_generation.experts.padded import own_layout, padded_layout
from icrl4aht_generation.learners.rollout import Player, init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy, sometimes_random
from icrl4aht_generation.profiles.noise_config import NoiseConfig

EPISODES_AT_ONCE = 256
"""Episodes of one batch. A constant, since a matrix product of another size may round the logits of a learned teammate
differently."""

_NOISE = 2
"""Number that an episode's key is folded with for the draws of the noise; see `Environment.episode_key`."""


def noise_schedules(config: NoiseConfig, seed: int) -> np.ndarray:
    """Return the chance of a random action in every episode, float32 (N, E); see `NoiseConfig`.

    Args:
        config: ranges that each history's schedule is drawn from.
        seed: the task's seed.
    """
    keys = jax.vmap(jax.random.fold_in, (None, 0))(_keys(seed)[0], jnp.arange(config.histories))
    drawn = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, (5,)))(keys), np.float64)[..., None]
    ranges = (config.start, config.end, config.begin, config.finish, config.power)
    start, end, begin, finish, power = (low + (high - low) * drawn[:, k] for k, (low, high) in enumerate(ranges))
    share = np.linspace(0, 1, config.episodes)
    length = finish - begin
    fallen = np.where(length > 0, (share - begin) / np.where(length > 0, length, 1), share >= finish).clip(0, 1)
    # Rounded, so that the last bits of a platform's `power` do not matter.
    return np.round(end + (start - end) * (1 - fallen) ** power, 6).astype(np.float32)


class NoisyEpisodes(NamedTuple):
    """M episodes of 100 steps.

    Attributes:
        state: uint8 (M, 100, S), state records before each step.
        actions: int8 (M, 100), the ego's actions, clean or random.
        teammate_actions: int8 (M, 100).
        rewards: int8 (M, 100), the team's, unshaped.
        episode_end_state: uint8 (M, S), state records after the last step.
        oracle_actions: int8 (M, 100), the oracle's actions.
    """

    state: UInt8[Array, "M 100 S"]
    actions: Int8[Array, "M 100"]
    teammate_actions: Int8[Array, "M 100"]
    rewards: Int8[Array, "M 100"]
    episode_end_state: UInt8[Array, "M S"]
    oracle_actions: Int8[Array, "M 100"]


class NoisyChoice(NamedTuple):
    """Actions of the noisy ego in one step of M environments.

    Attributes:
        action: int32 (M,), the action taken.
        clean: int32 (M,), the oracle's action.
    """

    action: Int[Array, " M"]
    clean: Int[Array, " M"]


def play_noisy_episodes(
    layout: Layout, teammate: Policy, seed: int, history: np.ndarray, episode: np.ndarray, chance: np.ndarray
) -> NoisyEpisodes:
    """Play some episodes of a task; compiled once for all heuristics of one family on all layouts of a process.

    Args:
        layout: the layout.
        teammate: the teammate: a heuristic that sees a `Situation`, or a learned one of this layout.
        seed: the task's seed.
        history: int (M,), number of each episode's history.
        episode: int (M,), its number in the history.
        chance: float32 (M,), its chance of a random action.
    """
    tables, expert, own = (padded_layout if teammate.sees == "situation" else own_layout)(layout)
    play, where = _program(teammate._replace(params=())), (history.astype(np.int32), episode.astype(np.int32))
    played = play(tables, expert, teammate.params, _keys(seed)[1], *where, chance)
    return played._replace(state=played.state[..., own], episode_end_state=played.episode_end_state[..., own])


def noisy_episode_keys(seed: int, history: np.ndarray, episode: np.ndarray) -> Key[Array, " M"]:
    """Return the keys of the environments in which some episodes of a task are played, each its first episode.

    Args:
        seed: the task's seed.
        history: int (M,), number of each episode's history.
        episode: int (M,), its number in the history.
    """
    return _episode_keys(_keys(seed)[1], history.astype(np.int32), episode.astype(np.int32))


def _keys(seed: int) -> Key[Array, " 2"]:
    """Return two keys of a task: of its schedules, and of its episodes."""
    return jax.random.split(jax.random.key(seed))


def _episode_keys(key: Key[Array, ""], history: Any, episode: Any) -> Key[Array, " M"]:
    fold = jax.vmap(jax.random.fold_in)
    return fold(fold(jnp.broadcast_to(key, len(history)), history), episode)


@lru_cache(maxsize=64)
def _program(teammate: Policy) -> Callable[..., NoisyEpisodes]:
    """Return a compiled function of tables, parameters of the oracle and of the teammate, a key, and the episodes."""

    @jax.jit
    def play(tables: Tables, expert: Any, params: Any, key: Key[Array, ""], history, episode, chance) -> NoisyEpisodes:
        env, m = Environment(tables), len(history)
        keys = _episode_keys(key, history, episode)
        players = [_noisy_oracle(env, expert, chance), policy_player(env, teammate, params, TEAMMATE, m)]
        # The roll-out's own key is not used: heuristics have keys of their own, and learned teammates act greedily.
        carry, rollout = roll_out(env, players, init_rollout(env, players, keys), KEPT_STEPS, key)
        choice: Any = rollout.choices[EGO]

        def by_episode(values: Array) -> Array:
            return values.swapaxes(0, 1).astype(jnp.int8)

        return NoisyEpisodes(
            state=rollout.record.swapaxes(0, 1),
            actions=by_episode(choice.action),
            teammate_actions=by_episode(rollout.actions[..., TEAMMATE]),
            rewards=by_episode(rollout.reward),
            episode_end_state=carry.env.record,  # training episodes have more steps, so none has been reset
            oracle_actions=by_episode(choice.clean),
        )

    return play


def _noisy_oracle(env: Environment, expert: Any, chance: Float[Array, " M"]) -> Player:
    """Return the oracle as agent 0 of M environments, each with its own chance of a random action.

    It remembers the action that was taken, as an observer of the episode would; so the recorded states and actions
    determine what it would do at every state.
    """
    script = policy_player(env, SITUATION_ORACLE, expert, EGO, chance.shape[0])
    fold = jax.vmap(jax.random.fold_in)

    def act(memory: Any, state: EnvState, key: Key[Array, ""]) -> Any:
        choice, memory = script.act(memory, state, key)
        own = fold(env.episode_key(state), jnp.full_like(state.clock, _NOISE))
        action = jax.vmap(sometimes_random)(fold(own, state.clock), chance, choice.action)
        return NoisyChoice(action, choice.action), memory._replace(action=action)

    return script._replace(act=act)
