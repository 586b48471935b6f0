"""Test recording of rollouts, selection of streams (the histories of single environments), and their labels."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.collection import curate
from icrl4aht_generation.collection.task_folder import array_shapes, record_rollout
from icrl4aht_generation.learners.config import PPOConfig, Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.rollout import Rollout

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import record_size
from tests.helpers.states import random_records

LAYOUT = LAYOUTS["cramped_up"]
ENVS = 3
UNTOUCHED = 99  # a value that recorded arrays of these tests never contain


def empty_histories(config: PPOConfig) -> dict[str, np.ndarray]:
    shapes = array_shapes(LAYOUT, config.environments, config.episodes)
    return {name: np.full(shape, UNTOUCHED, dtype) for name, (shape, dtype) in shapes.items()}


def random_rollout(length: int, rng: np.random.Generator) -> Rollout:
    shape = (length, ENVS)
    fields: dict[str, Any] = {
        "record": rng.integers(0, UNTOUCHED, (*shape, record_size(LAYOUT)), np.uint8),
        "actions": rng.integers(0, 6, (*shape, 2), np.int32),
        "reward": rng.choice([-25, -20, -5, 0, 20], shape).astype(np.float32),
    }
    rest: dict[str, Any] = {name: rng.normal(size=shape) for name in Rollout._fields if name not in fields}
    return Rollout(**fields, **rest)


def record_by_loop(rollouts: list[Rollout], config: PPOConfig) -> dict[str, np.ndarray]:
    """Record the first 100 of each 400 steps, and the state after them, in a loop over steps."""
    kept = empty_histories(config)
    for update, rollout in enumerate(rollouts):
        for t in range(config.rollout):
            episode, clock = divmod(update * config.rollout + t, 400)
            for n in range(ENVS):
                if episode >= config.episodes:
                    continue
                if clock < 100:
                    row = episode * 100 + clock
                    kept["state"][n, row] = rollout.record[t, n]
                    kept["actions"][n, row] = rollout.actions[t, n, 0]
                    kept["teammate_actions"][n, row] = rollout.actions[t, n, 1]
                    kept["rewards"][n, row] = rollout.reward[t, n]
                elif clock == 100:
                    kept["episode_end_state"][n, episode] = rollout.record[t, n]
    return kept


@pytest.mark.parametrize(
    ("length", "updates"), [(256, 5), (256, 4), (96, 13), (7, 120), (900, 2), (400, 2), (100, 9), (100, 10)]
)
def test_recorded_arrays_equal_those_of_a_loop_over_steps(length, updates):
    config = PPOConfig(total_steps=ENVS * length * updates, environments=ENVS, rollout=length, minibatches=1)
    rng = np.random.default_rng(length)
    rollouts = [random_rollout(length, rng) for _ in range(updates)]
    expected = record_by_loop(rollouts, config)
    found = empty_histories(config)
    for number in (*reversed(range(updates)), *range(updates)):  # record in reverse order, then again in order
        record_rollout(found, number, rollouts[number])
    for name, array in expected.items():
        assert array.size and not (array == UNTOUCHED).any(), name  # every entry was written
        np.testing.assert_array_equal(found[name], array, err_msg=name)
        assert found[name].dtype == array.dtype


def rewards_with_returns(returns: list[list[int]]) -> np.ndarray:
    """Return rewards of 5, 0 or -5, int8 of shape (N, T), that add up to the given episode returns."""
    totals = np.array(returns)[..., None] // 5
    rewards = np.where(np.arange(100) < abs(totals), 5 * np.sign(totals), 0).astype(np.int8)
    assert rewards.sum(axis=-1).tolist() == returns
    return rewards.reshape(len(returns), -1)


def best_streams(returns: list[list[int]], keep: int, least_improvement: float | None = None) -> list[int]:
    found = curate.stream_returns(rewards_with_returns(returns))
    return curate.select_streams([found], keep, least_improvement)[0].tolist()


def reference_score(curve: list[int]) -> float:
    w = max(5, math.floor(0.1 * len(curve))) if len(curve) >= 10 else len(curve) // 2
    start, end = sum(curve[:w]) / w, sum(curve[-w:]) / w
    return end + (end - start)


@pytest.mark.parametrize("episodes", [5, 12, 40, 59, 60, 146])
def test_streams_are_ranked_by_end_return_plus_improvement(episodes):
    rng = np.random.default_rng(episodes)
    returns = (rng.integers(-20, 80, (30, episodes)) * 5).tolist()  # some returns exceed the range of int8
    scores = [reference_score(curve) for curve in returns]
    assert len(set(scores)) > 20
    expected = sorted(range(30), key=lambda n: -scores[n])
    assert best_streams(returns, 30) == expected
    assert best_streams(returns, 7) == expected[:7]


def test_streams_with_equal_scores_are_ordered_by_number():
    low, high, also_high = [0] * 10, [0] * 5 + [20] * 5, [10] * 5 + [25] * 5  # the scores are 0, 40 and 40
    curves = [low, high, low, also_high, high, low]
    assert best_streams(curves, 6) == [1, 3, 4, 0, 2, 5]
    assert best_streams(curves, 2) == [1, 3]
    assert best_streams([low] * 100 + [high] * 100, 200) == [*range(100, 200), *range(100)]


def improving_returns(*improvements: int) -> np.ndarray:
    """Return episode returns, of shape (N, 10), of N histories that start at 0 and improve by the given amounts."""
    return np.array([[0.0] * 5 + [float(improvement)] * 5 for improvement in improvements])


@pytest.mark.parametrize(
    ("learners", "keep", "expected"),
    [
        ([improving_returns(10, 50, 30, 20), improving_returns(15, 40, 25, 5)], 4, [[1, 2], [1, 2]]),
        (
            [improving_returns(10, 50, 30, 20), improving_returns(15, 40, 25, 5)],
            3,
            [[1, 2], [1]],
        ),  # in round 2, 30 is chosen before 25
        ([improving_returns(10, 20), improving_returns(90, 80, 70, 60)], 3, [[1], [0, 1]]),
        ([improving_returns(30, 20, 40, 50), improving_returns(0, 5, 4, 0)], 8, [[3, 2, 0, 1], [1]]),
        ([improving_returns(0), improving_returns(0)], 2, [[], []]),
        ([improving_returns(9), improving_returns(7), improving_returns(8)], 2, [[0], [], [0]]),
    ],
)
def test_selected_streams_are_divided_among_learners(learners, keep, expected):
    assert [streams.tolist() for streams in curate.select_streams(learners, keep, 5.0)] == expected


@pytest.fixture(scope="module")
def labels_and_logits():
    """Return labels of two histories of two episodes, and logits with memory reset per episode, per step, or never."""
    widths = Widths(pointwise=(8,), spatial=(8,), dense=32, gru=16, head=16)
    network = ActorCritic(widths)
    rng = np.random.default_rng(3)
    states = random_records(LAYOUT, 400, rng).reshape(2, 200, -1)
    obs = observe(LAYOUT, states, EGO)
    tree = jax.eval_shape(lambda key: network.untrained(key, LAYOUT.channels), jax.random.key(0))

    def random_weight(weight) -> np.ndarray:  # random weights make actions vary with states
        if len(weight.shape) == 1:
            return np.zeros(weight.shape, np.float32)
        return (rng.normal(size=weight.shape) * 2 / np.prod(weight.shape[:-1]) ** 0.5).astype(np.float32)

    params = jax.tree.map(random_weight, tree)
    params["params"]["encoder"]["LayerNorm_0"]["scale"] += 1
    step = jax.jit(network.apply)

    def logits_with_resets_at(starts) -> np.ndarray:
        hidden, rows = network.initial_hidden(2), []
        for t in range(200):
            if t in starts:
                hidden = jnp.zeros_like(hidden)
            out: Any = step(params, hidden, obs[None, :, t], jnp.zeros((1, 2), bool))
            hidden = out[0]
            rows.append(np.asarray(out[1][0]))
        return np.stack(rows, axis=1)

    labels = [curate.greedy_labels(LAYOUT, network, params, stream) for stream in states]
    ways = {"episode": {0, 100}, "step": set(range(200)), "never": {0}}
    return labels, {name: logits_with_resets_at(starts) for name, starts in ways.items()}


def test_labels_are_greedy_actions_with_memory_reset_at_each_episode(labels_and_logits):
    labels, logits = labels_and_logits
    assert [(label.shape, label.dtype) for label in labels] == [((200,), np.int8)] * 2
    chosen = np.take_along_axis(logits["episode"], np.stack(labels)[..., None].astype(int), axis=-1)[..., 0]
    # Another order of summation rounds differently, so an action counts as best if its logit is nearly the largest.
    np.testing.assert_allclose(chosen, logits["episode"].max(axis=-1), rtol=0, atol=1e-4)
    assert len(np.unique(labels)) > 2


def test_labels_depend_on_memory_within_an_episode(labels_and_logits):
    """Labels differ from the greedy actions of a policy whose memory is reset at every step, or never."""
    labels, logits = labels_and_logits
    without, across = (logits[way].argmax(axis=-1) for way in ("step", "never"))
    assert (np.stack(labels) != without).mean() > 0.1
    assert (np.stack(labels)[:, 100:] != across[:, 100:]).any()
    np.testing.assert_array_equal(across[:, :100], logits["episode"][:, :100].argmax(axis=-1))
