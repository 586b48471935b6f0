"""Select streams (the histories of single environments) and label them with expert actions (paper, App. F.1, D.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.provenance import MeanStreamReturns, StreamFilter
from icrl4aht_data.format.schema import curve_ends, stream_score
from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.experts.search import searcher, with_taken_action
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.policy import Policy


def stream_returns(rewards: np.ndarray) -> np.ndarray:
    """Return the episode returns in N environments, summed over the stored steps of each episode.

    Args:
        rewards: rewards in N environments, int8 of shape (N, T).

    Returns:
        float64 array of shape (N, E).
    """
    return rewards.reshape(len(rewards), -1, KEPT_STEPS).sum(axis=-1, dtype=np.float64)


def select_streams(
    returns: Sequence[np.ndarray], keep: int, least_improvement: float | None = None
) -> list[np.ndarray]:
    """Select up to `keep` streams of the learners of a task, by the highest sum of final return and improvement.

    Each stream is the history of one environment. Learners take turns: in each round every learner adds its next best
    stream, and the learner with the best stream of the round comes first.

    Args:
        returns: episode returns of each learner's streams, arrays of shape (N, E).
        keep: maximum number of streams of all learners together.
        least_improvement: minimum improvement from a stream's initial to its final return; None for no minimum.

    Returns:
        Indices of each learner's selected streams, int (n,), best first; the sum of all n is at most `keep`.
    """
    candidates, turns = [], []
    for learner, own in enumerate(returns):
        (start, end), score = curve_ends(own), stream_score(own)
        order = np.argsort(-score, kind="stable")
        if least_improvement is not None:
            order = order[(end - start)[order] >= least_improvement]
        candidates.append(order)
        turns += [(turn, -score[stream], learner) for turn, stream in enumerate(order)]
    chosen = [learner for _, _, learner in sorted(turns)[:keep]]
    return [streams[: chosen.count(learner)] for learner, streams in enumerate(candidates)]


def filter_report(before: np.ndarray, after: np.ndarray, least_improvement: float | None = None) -> StreamFilter:
    """Return the mean initial and final return of all streams, and of the selected streams.

    Args:
        before: episode returns of all streams, of shape (N, E).
        after: episode returns of the selected streams, of shape (n, E).
        least_improvement: minimum improvement of the selected streams.
    """
    sides = []
    for part in (before, after):
        start, end = (round(float(values.mean()), 3) for values in curve_ends(part))
        sides.append(MeanStreamReturns(len(part), start, end))
    return StreamFilter(before=sides[0], after=sides[1], least_improvement=least_improvement)


def greedy_labels(layout: Layout, network: ActorCritic, params: Any, states: np.ndarray) -> np.ndarray:
    """Return a policy's most probable action at every step of a history, int8 of shape (T,).

    The recurrent state is zero at the start of each episode, as in training.

    Args:
        layout: layout of the history.
        network: the ego's network.
        params: parameters of the checkpoint that chooses the actions.
        states: state records of the history, uint8 (T, S).
    """
    return _by_step(_compiled_greedy_labels(layout, network.widths)(params, _by_episode(states)))


def oracle_labels(layout: Layout, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return the scripted oracle's action at every step of a history, int8 of shape (T,).

    The oracle follows every episode from its first step: it remembers the recorded states and the actions that the ego
    took, and chooses its own action at each state.

    Args:
        layout: layout of the history.
        states: state records of the history, uint8 (T, S).
        actions: the ego's actions, int8 (T,).
    """
    return _by_step(_compiled_oracle_labels(layout)(_by_episode(states), _by_episode(actions)))


def search_labels(layout: Layout, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return the actions that the script `search` advises at every step of B histories of another ego, int8 (B, T).

    The script remembers all earlier episodes of a history, and prefers to believe in a dish that the ego has begun.

    Args:
        layout: layout of the histories; its recipes have no effect.
        states: state records of the histories, uint8 (B, T, S).
        actions: the ego's actions, int8 (B, T).
    """
    of_episodes = (x.reshape(len(x), -1, KEPT_STEPS, *x.shape[2:]) for x in (states, actions))
    labels = _compiled_search_labels(layout)(*(np.moveaxis(x, 0, 2) for x in of_episodes))
    return np.moveaxis(np.asarray(labels), 2, 0).reshape(actions.shape)


def _by_episode(history: np.ndarray) -> jax.Array:
    """Reshape a history's array of shape (T, ...) to (100, E, ...), with the step within the episode as first axis."""
    return jnp.asarray(history.reshape(-1, KEPT_STEPS, *history.shape[1:]).swapaxes(0, 1))


def _by_step(labels: jax.Array) -> np.ndarray:
    """Reshape an array of shape (100, E) to (T,), the inverse of `_by_episode`."""
    return np.asarray(labels).swapaxes(0, 1).reshape(-1)


@lru_cache(maxsize=8)
def _compiled_greedy_labels(layout: Layout, widths: Widths) -> Callable[[Any, jax.Array], jax.Array]:
    """Return a compiled function that computes a network's greedy actions in E episodes of 100 steps.

    Its arguments are parameters and state records of shape (100, E, S); the actions have the shape (100, E).
    """
    network = ActorCritic(widths)

    @jax.jit
    def greedy(params: Any, records: jax.Array) -> jax.Array:
        steps, episodes, _ = records.shape
        reset = jnp.zeros((steps, episodes), bool)
        result: Any = network.apply(params, network.initial_hidden(episodes), observe(layout, records, EGO), reset)
        return jnp.argmax(result[1], axis=-1).astype(jnp.int8)

    return greedy


@lru_cache(maxsize=8)
def _compiled_oracle_labels(layout: Layout) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return a compiled function that computes the oracle's actions in E episodes of 100 steps.

    Its arguments are state records of shape (100, E, S) and the actions that the ego took, of shape (100, E).
    """
    return jax.jit(lambda records, taken: follow_script(oracle(layout), layout, records, taken)[0].astype(jnp.int8))


@lru_cache(maxsize=8)
def _compiled_search_labels(layout: Layout) -> Callable[[np.ndarray, np.ndarray], jax.Array]:
    """Return a compiled function that computes the labels by `search` of B histories with E episodes of 100 steps.

    Its arguments are state records of shape (E, 100, B, S) and the actions that the ego took, of shape (E, 100, B).
    """
    script = searcher(layout, advises=True)

    @jax.jit
    def advice(records: jax.Array, taken: jax.Array) -> jax.Array:
        def episode(memory: Any, now: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
            wanted, memory = follow_script(script, layout, *now, None, memory)
            return memory, wanted.astype(jnp.int8)

        keys = jax.random.split(jax.random.key(0), taken.shape[-1])
        start = jax.vmap(script.init, in_axes=(None, 0))(script.params, keys)
        return jax.lax.scan(episode, start, (records, taken))[1]

    return advice


def follow_script(
    script: Policy,
    layout: Layout | Sequence[Layout],
    records: jax.Array,
    taken: jax.Array,
    numbers: jax.Array | None = None,
    memory: Any = None,
) -> tuple[jax.Array, Any]:
    """Return the actions that a script chooses in the states of another ego's episodes, and the script's memory.

    Args:
        script: policy from `oracle` or `searcher`.
        layout: one layout or several.
        records: uint8 (T, E, S), state records of E episodes.
        taken: int (T, E), the actions that the ego took.
        numbers: int (E,), index of each episode's layout; None for one layout.
        memory: memory of the script before the episodes, leaves (E, ...); by default the initial memory.

    Returns:
        The script's actions, int32 (T, E), and the script's memory after the episodes.
    """
    env = Environment(layout)
    keys = jax.random.split(jax.random.key(0), records.shape[1])  # the scripts only draw their initial memory at random
    zero = jnp.zeros(len(keys), jnp.int32)

    def step(memory: Any, now: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        record, action = now
        state = EnvState(keys, zero, zero, record, numbers)
        wanted, memory = env.act(script, script.params, memory, state, EGO, keys, own=False)
        return with_taken_action(memory, action.astype(jnp.int32)), wanted

    if memory is None:
        memory = jax.vmap(script.init, in_axes=(None, 0))(script.params, keys)
    memory, wanted = jax.lax.scan(step, memory, (records, taken))
    return wanted, memory
