"""Choosing streams and labelling them (paper, App. F.1 and App. D.1)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from generation.learners.network import ActorCritic
from icrl4aht_data.benchmark import EGO, KEPT_STEPS
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.schema import stream_score


def best_streams(rewards: np.ndarray, keep: int) -> np.ndarray:
    """The `keep` streams with the highest end + improvement, best first, ties by number.

    Args:
        rewards: (N, T).
    """
    returns = rewards.reshape(len(rewards), -1, KEPT_STEPS).sum(axis=-1, dtype=np.float64)
    return np.argsort(-stream_score(returns), kind="stable")[:keep]


def relabel(layout: Layout, network: ActorCritic, params: Any, states: np.ndarray) -> Iterator[np.ndarray]:
    """What the final checkpoint would do, greedily, at every step of each stream.

    Its recurrent state starts from zero at each episode and is carried through it.

    Args:
        states: uint8 (N, T, S).

    Yields:
        int8 (T,) for each stream.
    """

    @jax.jit
    def greedy(records):  # (100, E, S)
        steps, episodes, _ = records.shape
        reset = jnp.zeros((steps, episodes), bool)
        result: Any = network.apply(params, network.initial_hidden(episodes), observe(layout, records, EGO), reset)
        return jnp.argmax(result[1], axis=-1).astype(jnp.int8)

    for stream in states:
        episodes = stream.reshape(-1, KEPT_STEPS, stream.shape[-1]).swapaxes(0, 1)
        yield np.asarray(greedy(jnp.asarray(episodes))).swapaxes(0, 1).reshape(-1)
