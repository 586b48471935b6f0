"""Rollouts of the sources `noise` and `search`, in which a script plays the ego and some actions are random.

Source `noise`: the scripted oracle plays, and the chance of a random action falls over a history. Noise distillation
(Zisman et al. 2024, "Emergence of In-Context Reinforcement Learning from Noise Distillation") makes learning histories
without learning. An episode depends only on the task's seed, the numbers of history and episode, and its chance.

Source `search`: a script finds out which dish the teammate wants, and remembers it. An episode also depends on the
earlier episodes of its history. For both sources, the other episodes of a batch make no difference.

Shapes: `N` histories, `E` episodes of each, `M` episodes of one batch, `S` bytes of a state record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Tables
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.experts.oracle import SITUATION_ORACLE
from icrl4aht_generation.experts.padded import padded_layout, unpadded_layout
from icrl4aht_generation.experts.search import SITUATION_SEARCHER, padded_dishes, with_taken_action
from icrl4aht_generation.learners.rollout import Player, init_rollout, policy_player, roll_out, select_rows
from icrl4aht_generation.policy import Policy, randomize_action
from icrl4aht_generation.profiles.noise_config import NoiseConfig

EPISODES_AT_ONCE = 256
"""Number of episodes in a batch of the source `noise`; with another size, a learned teammate's logits may round
differently."""

_NOISE = 2
"""Number folded into an episode's key to draw random actions; see `Environment.episode_key`."""

_NOT_RANDOM = -1
"""Marks steps in which the script's action is taken."""


def noise_schedules(config: NoiseConfig, seed: int) -> np.ndarray:
    """Return the chance of a random action in every episode, float32 of shape (N, E); see `NoiseConfig`.

    Args:
        config: ranges from which the schedule of each history is drawn.
        seed: the task's seed.
    """
    keys = jax.vmap(jax.random.fold_in, (None, 0))(_task_keys(seed)[0], jnp.arange(config.histories))
    drawn = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, (5,)))(keys), np.float64)[..., None]
    ranges = (config.start, config.end, config.begin, config.finish, config.power)
    start, end, begin, finish, power = (low + (high - low) * drawn[:, k] for k, (low, high) in enumerate(ranges))
    share = np.linspace(0, 1, config.episodes)
    length = finish - begin
    fallen = np.where(length > 0, (share - begin) / np.where(length > 0, length, 1), share > finish).clip(0, 1)
    # Rounding removes the last bits of a power, which differ between platforms.
    return np.round(end + (start - end) * (1 - fallen) ** power, 6).astype(np.float32)


class NoisyChoice(NamedTuple):
    """Actions of a scripted ego in one step of M environments, some replaced by random actions.

    Attributes:
        action: int32 (M,), the action taken.
        clean: int32 (M,), the script's action.
    """

    action: Int[Array, " M"]
    clean: Int[Array, " M"]


ScriptedBatch = tuple[np.ndarray, np.ndarray]
"""Episodes that are played at once: history numbers and episode numbers, int (M,) each."""


def scripted_batches(source: str, config: NoiseConfig) -> list[ScriptedBatch]:
    """Return the batches of episodes of a task, in the order of play."""
    if source == "search":  # a batch has one episode per history, because the script remembers earlier episodes
        histories = np.arange(config.histories)
        return [(histories, np.full_like(histories, episode)) for episode in range(config.episodes)]
    count, each = config.histories * config.episodes, np.arange(EPISODES_AT_ONCE)
    # Copies of the last episode fill up the last batch, because batches of equal size share one compilation.
    numbers = [np.minimum(first + each, count - 1) for first in range(0, count, EPISODES_AT_ONCE)]
    return [np.divmod(batch, config.episodes) for batch in numbers]


def play_scripted_histories(
    layout: Layout, teammate: Policy, seed: int, source: str, batches: Sequence[ScriptedBatch], schedules: np.ndarray
) -> Iterator[tuple[ScriptedBatch, dict[str, Array]]]:
    """Play batches of a task's episodes, with one compilation per teammate family and size class of layouts.

    The device plays the next batch while the caller uses the yielded batch.

    Args:
        layout: layout of the task, with the task's recipes.
        teammate: a heuristic that sees a `Situation`, or a learned teammate of this layout.
        seed: the task's seed.
        source: "noise" or "search".
        batches: batches of episodes, see `scripted_batches`.
        schedules: float32 (N, E), the chance of a random action in every episode.

    Yields:
        Each batch of M episodes with its `task_folder.HISTORY_ARRAYS`, with axes (M, 100) instead of (N, T) and M
        instead of (N, E), and `script_actions`, int8 (M, 100), the script's actions.
    """
    padded = padded_layout(layout, by_size=True) if teammate.sees == "situation" else unpadded_layout(layout)
    tables, expert, own = padded
    searches = source == "search"
    params = {"oracle": expert, "dishes": padded_dishes([layout])} if searches else expert
    play, last = _compiled_play(teammate._replace(params=()), searches), None
    memory = _blank_memories(params, len(batches[0][0])) if searches else None
    for history, episode in batches:
        where = history.astype(np.int32), episode.astype(np.int32)
        chance = schedules[history, episode]
        played, memory = play(tables, params, teammate.params, _task_keys(seed)[1], *where, chance, memory)
        records = {name: played[name][..., own] for name in ("state", "episode_end_state")}
        if last is not None:
            yield last
        last = (history, episode), played | records
    if last is not None:
        yield last


def scripted_episode_keys(seed: int, history: np.ndarray, episode: np.ndarray) -> Key[Array, " M"]:
    """Return the environment keys of the given episodes of a task; every episode starts in a new environment.

    Args:
        seed: the task's seed.
        history: int (M,), number of each episode's history.
        episode: int (M,), number of each episode in its history.
    """
    return _episode_keys(_task_keys(seed)[1], history.astype(np.int32), episode.astype(np.int32))


def _task_keys(seed: int) -> Key[Array, " 2"]:
    """Return two keys of a task: one for the noise schedules, one for the episodes."""
    return jax.random.split(jax.random.key(seed))


def _episode_keys(key: Key[Array, ""], history: Any, episode: Any) -> Key[Array, " M"]:
    fold = jax.vmap(jax.random.fold_in)
    return fold(fold(jnp.broadcast_to(key, len(history)), history), episode)


@lru_cache(maxsize=64)
def _compiled_play(teammate: Policy, searches: bool) -> Callable[..., tuple[dict[str, Array], Any]]:
    """Return a compiled function that plays a batch of episodes.

    The function returns the arrays of the episodes, and the script's memories if `searches` is true, else None.
    It ignores the given memories in the first episode of a history.
    """
    script = SITUATION_SEARCHER if searches else SITUATION_ORACLE

    @jax.jit
    def play(tables: Tables, expert: Any, params: Any, key: Key[Array, ""], history, episode, chance, memory):
        env, m = Environment(tables), len(history)
        keys = _episode_keys(key, history, episode)
        players = [_noisy_script(env, script, expert, keys, chance), policy_player(env, teammate, params, TEAMMATE, m)]
        start = init_rollout(env, players, keys)
        if searches:
            own = select_rows(episode == 0, start.memories[EGO], memory)
            start = start._replace(memories=(own, start.memories[TEAMMATE]))
        # The rollout's key has no effect: heuristics use their own keys, and learned teammates act greedily.
        carry, rollout = roll_out(env, players, start, KEPT_STEPS, key)
        choice: Any = rollout.choices[EGO]

        def by_episode(values: Array) -> Array:
            return values.swapaxes(0, 1).astype(jnp.int8)

        episodes = {
            "state": rollout.record.swapaxes(0, 1),
            "actions": by_episode(choice.action),
            "teammate_actions": by_episode(rollout.actions[..., TEAMMATE]),
            "rewards": by_episode(rollout.reward),
            "episode_end_state": carry.env.record,  # no reset yet: the environment's episodes have 400 steps
            "script_actions": by_episode(choice.clean),
        }
        return episodes, carry.memories[EGO] if searches else None

    return play


def _blank_memories(params: Any, count: int) -> Any:
    """Return `count` memories of the policy `SITUATION_SEARCHER`, filled with zeros."""
    shape = jax.eval_shape(SITUATION_SEARCHER.init, params, jax.random.key(0))
    return jax.tree.map(lambda leaf: np.zeros((count, *leaf.shape), leaf.dtype), shape)


def _noisy_script(
    env: Environment, script: Policy, params: Any, keys: Key[Array, " M"], chance: Float[Array, " M"]
) -> Player:
    """Return a player of agent 0 in M environments that follows a script, or acts at random with a given chance.

    The script remembers the action that was taken, so the recorded states and actions determine the script's action in
    every state.
    """
    player = policy_player(env, script, params, EGO, len(chance))
    fold = jax.vmap(jax.random.fold_in)
    own = fold(env.episode_key(env.init(keys)), jnp.full(len(chance), _NOISE))

    def draw(step: Int[Array, ""]) -> Int[Array, " M"]:
        keys = fold(own, jnp.broadcast_to(step, len(chance)))
        return jax.vmap(randomize_action)(keys, chance, jnp.full(len(chance), _NOT_RANDOM))

    # On CPUs, one draw for all steps is many times as fast as one draw in each step.
    drawn = jax.vmap(draw)(jnp.arange(KEPT_STEPS))

    def act(memory: Any, state: EnvState, key: Key[Array, ""]) -> Any:
        choice, memory = player.act(memory, state, key)
        random = drawn[state.clock, jnp.arange(len(chance))]
        action = jnp.where(random == _NOT_RANDOM, choice.action, random)
        return NoisyChoice(action, choice.action), with_taken_action(memory, action)

    return player._replace(act=act)
