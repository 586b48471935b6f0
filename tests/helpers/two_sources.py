"""Write a release with PPO and noise histories, two splits, and expert and oracle labels."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, SOURCES, layout_track
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.format.provenance import ExpertLabels, NearestTestTeammate, Provenance, ReferenceEgos
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.random_releases import random_history

EPISODES, LENGTH = 6, 20
"""Number of episodes of every history, and number of steps of every episode."""

NOISE: dict[str, Any] = {
    "histories": 3,
    "episodes": EPISODES,
    "start": [1.0, 1.0],
    "end": [0.0, 0.0],
    "begin": [0.0, 0.0],
    "finish": [1.0, 1.0],
    "power": [1.0, 1.0],
}
"""Schedule of all noise histories: the share of random actions falls linearly from 1 to 0."""

PARTS = (("train", "ppo"), ("train", "noise"), ("validation", "noise"))
"""Split and source of each layout's tasks, in the order of the release's index."""


def two_source_release(
    root: Path, ppo_episodes: int = EPISODES, oracle: tuple[str, ...] = SOURCES
) -> dict[int, dict[str, np.ndarray]]:
    """Write a release with two tasks for each of two layouts and each pair in `PARTS`; return the arrays by history id.

    A PPO task has two learners with two histories of `ppo_episodes` episodes each; a noise task has three histories.
    All actions are random, so no learner improves. Histories of the sources in `oracle` have oracle actions.
    """
    rng = np.random.default_rng(0)
    written: dict[int, dict[str, np.ndarray]] = {}
    new = []
    for task, source in _tasks():
        names = itertools.product(range(2), range(2)) if source == "ppo" else ((0, number) for number in range(3))
        histories = []
        for learner, stream in names:
            episodes = ppo_episodes if source == "ppo" else EPISODES
            arrays = random_history(get_layout(task.layout_name), episodes, LENGTH, rng)
            arrays["oracle_actions"] = _oracle_actions(arrays["actions"], rng)
            if source == "noise":
                arrays["expert_actions"] = arrays["oracle_actions"]
            if source not in oracle:
                del arrays["oracle_actions"]
            written[len(written)] = arrays
            histories.append(NewHistory(stream, arrays, learner))
        made = _provenance(task, source, len(histories))
        new.append(NewTask(task, made, len(histories), lambda kept=histories: kept))
    write_release(root, "lite", new, data_version="0.0.1", card="# test\n", kept_steps=LENGTH)
    return written


def _tasks() -> Iterator[tuple[Task, str]]:
    """Yield each task and its source; teammates are from all heuristic families and differ between the splits."""
    for number, (layout, (split, source), _) in enumerate(
        itertools.product(("demo_wide", "coord_simple"), PARTS, range(2))
    ):
        teammate = {
            "kind": "heuristic",
            "family": list(HEURISTIC_KINDS)[number % 4],
            "theta_id": number,
            "base_seed": int(split == "validation"),
            "theta": {"idle_prob": number / 64},
        }
        yield make_task(layout_track(layout), split, layout, teammate, seed=number), source


def _oracle_actions(actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return labels: random actions with a probability that falls from 1 to 0 over the episodes, else `actions`."""
    chance = np.repeat(np.linspace(1.0, 0.0, len(actions) // LENGTH), LENGTH)
    return np.where(rng.random(len(actions)) < chance, rng.integers(0, 6, len(actions)), actions)


def _provenance(task: Task, source: str, histories: int) -> Provenance:
    script = source == "noise"
    labels = ExpertLabels(None, "greedy", return_greedy=5.0, return_sampled=5.0, episodes=200)
    family = HEURISTIC_KINDS[task.teammate["family"]]
    return Provenance(
        seed=task.seed,
        source=source,
        learners=None if script else 2,
        noise=NOISE if script else None,
        references=ReferenceEgos(stay=0.0, random=0.5, oracle=5.0, episodes=20),
        nearest_test=NearestTestTeammate(f"{family}/t1", 0.25, behaviour=task.teammate["theta_id"]),
        streams_recorded=histories,
        streams_kept=histories,
        expert=labels if script else None,
    )
