"""Test PPO: advantages, loss, replay of the recurrent state, schedules, and learning.

All tests use one tiny learner. Its ego stands between two buttons, a pile and a pot, so it often presses a button
(reward -5) or fills the pot (shaped reward 3). Rollouts have 8 steps and episodes have 12 steps, so the first episode
ends inside the second rollout, and the second episode ends with the third rollout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.config import PPOConfig, Widths
from icrl4aht_generation.learners.ego import Learner, LearnerState
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.ppo import (
    Batch,
    Sequences,
    generalized_advantage,
    ppo_optimizer,
    sequences,
)
from icrl4aht_generation.learners.rollout import Choice, Rollout
from icrl4aht_generation.policy import Policy

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe

CLOSET = Layout("closet", "test_closet", ("WLWW01BW", "LA0WA  W", "WPWWPXWW"))
EPISODE = 12

CONFIG = PPOConfig(
    total_steps=4800,
    environments=4,
    rollout=8,
    minibatches=2,
    learning_rate=0.01,
    shaping_horizon=960,
    widths=Widths(pointwise=(4,), spatial=(4,), dense=8, gru=8, head=8),
)

UpdateFunction = Callable[[LearnerState], tuple[LearnerState, Rollout, dict[str, jax.Array]]]


PARAMS = {"turn": np.uint32(0)}
"""Parameters of the scripted teammate: a number of directions by which its moves are rotated."""


class TeammateMemory(NamedTuple):
    """Memory of the scripted teammate."""

    offset: jax.Array  # drawn with the episode's key
    steps: jax.Array  # number of steps taken in the episode


def begin(params, key) -> TeammateMemory:
    return TeammateMemory(jax.random.key_data(key)[1] % 4, jnp.uint32(0))


def scripted_act(params, memory: TeammateMemory, view, key):
    """Move in a direction that depends on the memory, the observation and the parameters."""
    action = (memory.offset + memory.steps + view.sum(dtype=jnp.uint32) + params["turn"]) % 4
    return action.astype(jnp.int32), memory._replace(steps=memory.steps + 1)


@pytest.fixture(scope="module")
def learner() -> Learner:
    return Learner(Environment(CLOSET, max_steps=EPISODE), Policy(PARAMS, begin, scripted_act, "observation"), CONFIG)


@pytest.fixture(scope="module")
def update(learner) -> UpdateFunction:
    return jax.jit(learner.update)


@pytest.fixture(scope="module")
def initial_state(learner) -> LearnerState:
    return jax.jit(learner.init)(jax.random.key(3))


@pytest.fixture(scope="module")
def frozen_state(initial_state) -> LearnerState:
    """Return a state at the end of the learning-rate schedule, where updates change no parameters. Random parameters
    make logits and values vary with the hidden state."""
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda w: w + rng.normal(size=w.shape).astype(np.float32) * 0.3, initial_state.params)
    steps = CONFIG.updates * CONFIG.epochs * CONFIG.minibatches
    optimizer = jax.tree.map(
        lambda x: jnp.full_like(x, steps) if jnp.issubdtype(x.dtype, jnp.integer) else x, initial_state.optimizer
    )
    return initial_state._replace(params=params, optimizer=optimizer)


class UpdateSequence(NamedTuple):
    before: list[LearnerState]
    rollouts: list[Rollout]  # the leaves are NumPy arrays
    metrics: list[dict[str, float]]


def run_updates(update: UpdateFunction, state: LearnerState, updates: int) -> UpdateSequence:
    before, rollouts, metrics = [], [], []
    for _ in range(updates):
        before.append(state)
        state, rollout, values = update(state)
        rollouts.append(jax.tree.map(np.asarray, rollout))
        metrics.append({name: float(value) for name, value in values.items()})
    return UpdateSequence(before, rollouts, metrics)


@pytest.fixture(scope="module")
def played(update, frozen_state) -> UpdateSequence:
    """Return 40 updates that start at `frozen_state` and never change the policy."""
    return run_updates(update, frozen_state, 40)


@pytest.fixture(scope="module")
def trained(update, initial_state) -> UpdateSequence:
    return run_updates(update, initial_state, CONFIG.updates)


def ego_choices(rollout: Rollout) -> Choice:
    """Return the ego's actions, log-probabilities and values in a rollout."""
    return rollout.choices[EGO]


def ego_sequences(state: LearnerState, rollout: Rollout) -> Sequences:
    """Return the training sequences of the ego in the rollout that starts in the given state."""
    slots, hidden = np.arange(CONFIG.environments), state.carry.memories[EGO]
    view = CompactView("paper", (CLOSET,))
    return sequences(view, rollout, EGO, slots, hidden, jnp.zeros(slots.size), jnp.float32(0))


def plain_advantage(reward, value, done, last_value, gamma: float, lam: float) -> np.ndarray:
    """Return generalized advantage estimates by a loop over environments and steps."""
    out = np.zeros(reward.shape)
    for n in range(reward.shape[1]):
        trace, following = 0.0, last_value[n]
        for t in reversed(range(reward.shape[0])):
            if done[t, n]:
                trace, following = 0.0, 0.0
            trace = reward[t, n] + gamma * following - value[t, n] + gamma * lam * trace
            following = value[t, n]
            out[t, n] = trace
    return out


@pytest.mark.parametrize(("gamma", "lam"), [(0.99, 0.95), (0.9, 0.0), (0.5, 1.0)])
def test_generalized_advantage_equals_a_loop_over_steps(gamma, lam):
    rng = np.random.default_rng(2)
    reward, value = rng.normal(size=(2, 20, 6)).astype(np.float32)
    done = rng.random((20, 6)) < 0.15
    done[-1, 0], done[0, 1], done[:, 2] = True, True, False
    done[-1, 1] = False
    last = rng.normal(size=6).astype(np.float32)
    config = replace(CONFIG, discount=gamma, gae_lambda=lam)
    compute = jax.jit(generalized_advantage, static_argnums=4)
    found = compute(reward, value, done, last, config)
    np.testing.assert_allclose(found, plain_advantage(reward, value, done, last, gamma, lam), rtol=0, atol=1e-5)


def replay(learner: Learner, state: LearnerState, rollout: Rollout, reset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the network's log-probabilities and values on the ego's training sequences."""
    own = ego_sequences(state, rollout)
    output: Any = jax.jit(learner.network.apply)(state.params, own.hidden[0], own.seen, reset)
    log_probs = np.asarray(jax.nn.log_softmax(output[1]))
    return np.take_along_axis(log_probs, np.asarray(own.action)[..., None], axis=-1)[..., 0], np.asarray(output[2])


def test_training_sequences_give_the_log_probs_and_values_of_the_rollout(learner, played):
    """The second rollout starts inside an episode with a nonzero hidden state; the next episode starts at step 4."""
    state, rollout = played.before[1], played.rollouts[1]
    np.testing.assert_array_equal(rollout.reset.nonzero()[0], [4] * 4)
    np.testing.assert_array_equal(rollout.done.nonzero()[0], [3] * 4)
    assert np.abs(state.carry.memories[EGO]).min() > 0
    log_prob, value = replay(learner, state, rollout, rollout.reset)
    np.testing.assert_allclose(log_prob, ego_choices(rollout).log_prob, rtol=0, atol=1e-4)
    np.testing.assert_allclose(value, ego_choices(rollout).value, rtol=0, atol=1e-4)
    # If the memory is reset one step too early, at the last step of an episode, values are wrong from this step on.
    _, value = replay(learner, state, rollout, rollout.done)
    wrong = np.abs(value - ego_choices(rollout).value).max(axis=1)
    assert wrong[:3].max() < 1e-4 < 1e-2 < wrong[3:].min()


def test_ppo_loss_equals_formulas_in_numpy(learner, played):
    """Compare the loss with NumPy formulas, for parameters other than the rollout's, which cause clipping."""
    rollout = played.rollouts[1]
    rng = np.random.default_rng(6)
    params = jax.tree.map(lambda w: w + rng.normal(size=w.shape).astype(np.float32) * 0.1, played.before[1].params)
    hidden = played.before[1].carry.memories[EGO]
    advantage, target = rng.normal(size=(2, *rollout.done.shape)).astype(np.float32)
    weight = np.array([1.0, -1.0, 0.5, -2.0], np.float32)  # a negative weight trains for lower returns
    own = ego_sequences(played.before[1], rollout)._replace(weight=weight[None])
    batch = jax.tree.map(jnp.asarray, Batch(own, advantage, target))
    total, parts = jax.jit(learner.ppo.loss)(params, batch)

    obs = observe(CLOSET, rollout.record, EGO)
    output: Any = jax.jit(learner.network.apply)(params, hidden, obs, rollout.reset)
    logits, value = np.asarray(output[1], np.float64), np.asarray(output[2], np.float64)
    log_probs = logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))
    chosen = np.take_along_axis(log_probs, rollout.actions[..., EGO, None], axis=-1)[..., 0]
    ratio = np.exp(chosen - ego_choices(rollout).log_prob)
    change = value - ego_choices(rollout).value
    assert (np.abs(ratio - 1) > CONFIG.clip).any() and (np.abs(change) > CONFIG.clip).any()
    normalized = (advantage - advantage.mean()) / advantage.std() * weight
    policy = -np.minimum(ratio * normalized, np.clip(ratio, 0.8, 1.2) * normalized).mean()
    near = ego_choices(rollout).value + np.clip(change, -0.2, 0.2)
    value_loss = 0.5 * np.maximum((value - target) ** 2, (near - target) ** 2).mean()
    entropy = -(np.exp(log_probs) * log_probs).sum(axis=-1).mean()
    expected = {"policy_loss": policy, "value_loss": value_loss, "entropy": entropy}
    assert set(parts) == set(expected)
    for name, loss in expected.items():
        np.testing.assert_allclose(parts[name], loss, rtol=1e-4, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(total, policy + 0.5 * value_loss - 0.01 * entropy, rtol=1e-4, atol=1e-5)


def test_teammate_actions_depend_on_the_parameters_in_the_state(update, frozen_state, played):
    """The same compiled update can train with every teammate of a family."""
    state, rollout, _ = update(frozen_state._replace(teammate={"turn": jnp.uint32(1)}))
    first = played.rollouts[0].actions[0, :, TEAMMATE]
    np.testing.assert_array_equal(rollout.actions[0, :, TEAMMATE], (first + 1) % 4)
    assert int(state.teammate["turn"]) == 1


def test_shaping_weight_falls_linearly_to_zero(played):
    found = [metrics["shaping"] for metrics in played.metrics]
    expected = [1 - n / 30 if n < 30 else 0 for n in range(len(found))]  # an update has 32 steps
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_learning_rate_rises_linearly_then_falls_along_a_cosine():
    """The rate is computed from Adam's steps: with a constant gradient g, a step is rate * g / (g + eps)."""
    steps = CONFIG.updates * CONFIG.epochs * CONFIG.minibatches
    warm = steps // 10
    gradient = jnp.float32(1e-3)

    def adam_step(state, _):
        change, state = ppo_optimizer(CONFIG).update(gradient, state)
        return state, change

    changes = jax.lax.scan(adam_step, ppo_optimizer(CONFIG).init(gradient), length=steps + 1)[1]
    rates = -np.asarray(changes, np.float64) * (1e-3 + 1e-5) / 1e-3
    t = np.arange(steps + 1)
    expected = np.where(t < warm, t / warm, 0.5 * (1 + np.cos(np.pi * (t - warm) / (steps - warm))))
    assert (expected[0], expected[warm], expected[-1]) == (0, 1, 0)
    np.testing.assert_allclose(rates / CONFIG.learning_rate, expected, rtol=0, atol=1e-3)
    assert rates[0] == 0
    assert rates.argmax() == warm
    assert rates[-1] == 0


@pytest.mark.parametrize("steps", [1, 100, 101, 400, 500, 501, 899, 901, 58_368])
def test_number_of_complete_episodes_follows_from_total_steps(steps):
    """An episode counts if its first 100 steps and the state after them are recorded."""
    complete = sum(start + 100 < steps for start in range(0, steps, 400))
    assert PPOConfig(total_steps=steps, environments=1, rollout=1, minibatches=1).episodes == complete


def test_ego_learns_not_to_press_buttons(trained):
    """Pressing a button costs 5, and a random ego presses a button about once in each episode."""
    early = np.mean([rollout.reward.mean() for rollout in trained.rollouts[:5]])
    late = np.mean([rollout.reward.mean() for rollout in trained.rollouts[-20:]])
    assert early < -0.1
    assert late > 0.2 * early


REWARDS = np.array([-20, -25, -30, -10, -5, 0, 20, 15], np.float32)
"""Rewards of a step: a wrong delivery with 0, 1 and 2 presses of a button; 2 presses and 1 press; nothing; a correct
delivery with 0 and 1 press."""


def rewarded_rollout() -> Rollout:
    """Return a rollout of two environments with `REWARDS`; shaped rewards are 1 for the ego and 2 for the teammate."""
    size = (len(REWARDS), 2)
    zeros, choices = jnp.zeros(size), jnp.zeros((len(REWARDS), 4))
    return Rollout(
        record=jnp.zeros((*size, 12), jnp.uint8),
        reset=zeros > 0,
        actions=jnp.zeros((*size, 2), jnp.int32),
        reward=jnp.tile(REWARDS[:, None], (1, 2)),
        shaped=jnp.ones((*size, 2)) * jnp.arange(1, 3),
        done=zeros > 0,
        returns=zeros,
        choices=(Choice(choices, choices, choices),),
    )


def test_forgiveness_offsets_wrong_deliveries_while_rewards_are_shaped():
    """With forgiveness, shaping offsets the penalty of wrong deliveries for both agents, but not of button presses."""
    slots = np.arange(4)  # one slot for each agent in each environment
    agents = np.repeat([EGO, TEAMMATE], 2)
    for weight, forgiven in ((1.0, 20), (0.25, 5), (0.0, 0)):
        found = sequences(
            lambda records: records,  # type: ignore[arg-type]
            rewarded_rollout(),
            0,
            slots,
            jnp.zeros((4, 8)),
            jnp.zeros(4),
            jnp.float32(weight),
            forgiveness=20.0,
        )
        expected = REWARDS + np.array([forgiven] * 3 + [0] * 5, np.float32)
        np.testing.assert_allclose(found.reward, expected[:, None] + weight * (agents + 1), atol=1e-5)
