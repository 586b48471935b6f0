"""Recover the random keys of recorded episodes from the task's seed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_data.benchmark.facts import SCRIPTED_SOURCES
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import NotStoredError
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_generation.collection.scripted_rollout import scripted_episode_keys
from icrl4aht_generation.collection.task import learner_key
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.ego import stream_keys
from icrl4aht_generation.profiles import WorkUnit


def recorded_draws(dataset: Dataset, history_id: int, episode: int = 0) -> dict[str, Any]:
    """Return options of `TaskEnv.reset` that repeat all random draws of a recorded episode.

    Unlike the options of `Dataset.reset_options`, the returned options do not replay the teammate's actions: the
    teammate's policy acts with the recorded random draws, and reacts if the ego acts differently. A learned teammate's
    network may round differently on another machine; heuristics play exactly as recorded.

    Args:
        dataset: a release that this version of the code generated.
        history_id: a history of the release.
        episode: number of the episode in the history, from 0.

    Returns:
        `key`, uint32 (2,), data of a JAX key, and `episode`, the number of the episode with this key.

    Raises:
        OptionError: if the history does not have the episode.
        NotStoredError: if the release does not record the history's keys, or if the keys give another first state.
    """
    recorded = dataset.reset_options(history_id, episode)["state"]
    entry = dataset.index.entry(history_id)
    task, number = dataset.history_task(history_id), episode
    ego = dataset.provenance.get(task.task_id, Provenance()).ego
    if entry.source in SCRIPTED_SOURCES:  # every scripted episode is episode 0 of a new environment
        key, number = scripted_episode_keys(task.seed, np.array([entry.env_idx]), np.array([episode]))[0], 0
    elif entry.source == "ppo" and ego is not None:
        key = stream_keys(learner_key(WorkUnit(task, learner=entry.learner)), ego["environments"])[entry.env_idx]
    else:
        raise NotStoredError(
            f"{dataset.root}: history {history_id}, source {entry.source}: the release does not record the history's "
            f"random keys; use dataset.reset_options, which needs no keys"
        )
    env = Environment(task.layout)
    drawn = np.asarray(env.first_record(key[None], jnp.array([number])))[0]
    if not np.array_equal(drawn, recorded):
        raise NotStoredError(
            f"{dataset.root}: history {history_id}: the keys of seed {entry.seed} do not give the recorded start of "
            f"episode {episode}, because another version of the code generated the history; use "
            f"dataset.reset_options, which needs no keys"
        )
    return {"key": np.asarray(jax.random.key_data(key)), "episode": number}
