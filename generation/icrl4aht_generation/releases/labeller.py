"""Choose the ego checkpoint that labels a task's histories, by its return with the task's teammate.

The labels are greedy actions. The labeller is the last checkpoint, as in the paper, unless an earlier checkpoint earns
clearly more with greedy actions. A policy that was trained with random actions can get stuck in "stay" when it acts
greedily, and a model would learn this from the labels. If a task has several independent learners, the learner with the
best labeller labels the histories of all learners.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS, LABEL_EPISODES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.provenance import ExpertLabels
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.files import read_text, short_hash
from icrl4aht_generation.collection.task import TEAMMATE_NOISE
from icrl4aht_generation.collection.task_folder import LABELLER_RETURNS, METADATA, checkpoint_path
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS, load_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.resume import software_versions
from icrl4aht_generation.learners.rollout import init_rollout, network_player, policy_player, roll_out
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.releases.measures import cached_measurement
from icrl4aht_generation.teammates.registry import build_teammate

_LEAST_GAIN = 2.0  # minimum gain of an earlier checkpoint: a tenth of a delivery per episode
_STANDARD_ERRORS = 2.0  # minimum gain in standard errors of the difference


_Returns = Annotated[list[float], msgspec.Meta(min_length=LABEL_EPISODES, max_length=LABEL_EPISODES)]


class CheckpointReturns(msgspec.Struct):
    """Returns of an ego's checkpoints with the task's teammate, one row for each checkpoint.

    Attributes:
        greedy: returns with the most probable actions.
        sampled: returns with randomly sampled actions in the same episodes.
    """

    greedy: list[_Returns]
    sampled: list[_Returns]


def choose_labeller(folders: Sequence[Path], task: Task, suite: Path) -> tuple[Path, ExpertLabels]:
    """Choose the checkpoint that labels the histories of a task: the best labeller of all learners.

    Args:
        folders: finished artefacts of the task's learners.
        task: task of the histories.
        suite: folder of the learned teammates.

    Returns:
        Folder of the checkpoint, and its record in the provenance of the task.
    """
    found = [choose_artefact_labeller(folder, task, suite) for folder in folders]
    return max(found, key=lambda one: one[1].return_greedy or 0.0)


def choose_artefact_labeller(folder: Path, task: Task, suite: Path) -> tuple[Path, ExpertLabels]:
    """Measure the checkpoints of a finished artefact, and choose the checkpoint that labels the histories.

    The measurements are stored in the artefact's file `LABELLER_RETURNS`, and reused.

    Args:
        folder: folder of the artefact.
        task: task of the artefact.
        suite: folder of the learned teammates.
    """
    metadata = json.loads(read_text(folder / METADATA))
    checkpoints = [checkpoint_path(folder, number) for number in range(len(metadata["checkpoint_updates"]))]
    hashes = [metadata["files"][(path / POLICY_WEIGHTS).relative_to(folder).as_posix()] for path in checkpoints]
    settings = software_versions() | {
        "checkpoints": hashes,
        "episodes": LABEL_EPISODES,
        "steps": KEPT_STEPS,
        "noise": TEAMMATE_NOISE,
    }
    path = folder / LABELLER_RETURNS
    measured = cached_measurement(path, settings, CheckpointReturns, lambda: _measure(checkpoints, task, suite))
    greedy, sampled = (np.mean(returns, axis=1) for returns in (measured.greedy, measured.sampled))
    chosen = choose_checkpoint(np.array(measured.greedy))
    step = metadata["checkpoint_updates"][chosen] * metadata["ego"]["environments"] * metadata["ego"]["rollout"]
    return checkpoints[chosen], ExpertLabels(
        policy_sha256=hashes[chosen],
        action="greedy, recurrent",
        step=step,
        return_greedy=float(greedy[chosen]),
        return_sampled=float(sampled[chosen]),
        episodes=LABEL_EPISODES,
        last_return_greedy=float(greedy[-1]),
        view="ego",  # a learner's network only receives observations
    )


def choose_checkpoint(returns: np.ndarray) -> int:
    """Return the number of the labelling checkpoint: the last checkpoint, or the best that earns clearly more.

    An earlier checkpoint earns clearly more if its mean difference to the last checkpoint in the same episodes is at
    least 2 (a delivery is worth 20) and above two standard errors of this mean.

    Args:
        returns: (C, E), greedy returns of C checkpoints in the same E episodes.
    """
    differences = returns - returns[-1]  # paired, because all checkpoints play episodes with the same seeds
    means = differences.mean(axis=1)
    errors = differences.std(axis=1, ddof=1) / np.sqrt(returns.shape[1])
    clearly = (means >= _LEAST_GAIN) & (means > _STANDARD_ERRORS * errors)
    best = np.where(clearly, means, -np.inf)
    # Ties go to the later checkpoint, so the last checkpoint is chosen if no other is clearly better.
    return len(best) - 1 - int(np.argmax(best[::-1]))


def _measure(checkpoints: list[Path], task: Task, suite: Path) -> CheckpointReturns:
    teammate = build_teammate(task.layout, task.teammate, TEAMMATE, TEAMMATE_NOISE, suite)
    key = jax.random.key(int(short_hash(task.task_id.encode(), 8), 16))
    measured = CheckpointReturns([], [])
    for path in checkpoints:
        network, params, _ = load_policy(path)
        play = _compiled_returns(task.layout, network.widths, teammate._replace(params=()))
        for greedy, returns in ((True, measured.greedy), (False, measured.sampled)):
            returns.append(np.asarray(play(params, greedy, teammate.params, key), np.float64).tolist())
    return measured


@lru_cache(maxsize=8)
def _compiled_returns(layout: Layout, widths: Widths, teammate: Policy) -> Callable[..., jax.Array]:
    """Return a compiled function that measures the returns of an ego with a teammate, one for each episode.

    The arguments of the function are the ego's parameters, whether the ego acts greedily, the teammate's parameters and
    a key. The result is float32 of shape (LABEL_EPISODES,). A return is the sum of rewards over the first `KEPT_STEPS`
    steps of an episode; all egos play the same episodes. All teammates of one family on one layout share a compilation.
    """
    env, network, n = Environment(layout, KEPT_STEPS), ActorCritic(widths), LABEL_EPISODES

    @jax.jit
    def play(params: Any, greedy: Any, teammate_params: Any, key: jax.Array) -> jax.Array:
        ego = network_player(env, network, params, np.arange(n), jnp.zeros(n, jnp.int32), greedy)
        players = [ego, policy_player(env, teammate, teammate_params, TEAMMATE, n)]
        episodes, actions = jax.random.split(key)
        carry = init_rollout(env, players, jax.random.split(episodes, n))
        _, rollout = roll_out(env, players, carry, KEPT_STEPS, actions)
        return rollout.reward.sum(axis=0)

    return play
