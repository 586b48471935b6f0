"""Selects streams of a task and labels them with expert actions (paper, App. F.1 and App. D.1)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from generation.learners.network import ActorCritic
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.provenance import StreamFilter, StreamReturns
from icrl4aht_data.format.schema import curve_ends, stream_score
from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.plotting import plot_curves


def stream_returns(rewards: np.ndarray) -> np.ndarray:
    """float64 (N, E): returns of every episode's kept steps.

    Args:
        rewards: int8 (N, T).
    """
    return rewards.reshape(len(rewards), -1, KEPT_STEPS).sum(axis=-1, dtype=np.float64)


def best_streams(rewards: np.ndarray, keep: int) -> np.ndarray:
    """int (keep,): numbers of the streams with the highest end + improvement, best first, ties by number.

    Args:
        rewards: int8 (N, T).
        keep: how many.
    """
    return np.argsort(-stream_score(stream_returns(rewards)), kind="stable")[:keep]


def filter_report(rewards: np.ndarray, streams: np.ndarray) -> StreamFilter:
    """Mean returns at the start and at the end of learning, before the filter and after it."""
    returns = stream_returns(rewards)
    sides = []
    for part in (returns, returns[streams]):
        start, end = (round(float(values.mean()), 3) for values in curve_ends(part))
        sides.append(StreamReturns(len(part), start, end))
    return StreamFilter(before=sides[0], after=sides[1])


def plot_filter(path: Path, title: str, rewards: np.ndarray, streams: np.ndarray) -> None:
    """Draw the learning curves of all streams and of the selected ones into a PNG."""
    returns = stream_returns(rewards)
    curves = {f"before: {len(returns)} streams": returns, f"after: {len(streams)} streams": returns[streams]}
    plot_curves(path, [(title, curves)])


def relabel(layout: Layout, network: ActorCritic, params: Any, states: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yields a policy's most probable action at every step of each stream.

    The recurrent state is zero at the start of each episode, as in training.

    Args:
        layout: the layout.
        network: the ego's network.
        params: parameters of the checkpoint that labels.
        states: uint8 (T, S) for each stream.

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
