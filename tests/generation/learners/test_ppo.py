"""PPO: advantages, replay of the recurrent state, purity, schedules, and that it learns.

One tiny learner for all tests. Its ego is in a closet between two buttons, a pile and a pot, so pressing (-5) and
placing (+3 shaped) happen often; of every three roll-outs of 8 steps, an episode of 12 ends inside the second and one
with the third.
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
    generalised_advantage,
    ppo_optimizer,
    sequences,
)
from icrl4aht_generation.learners.rollout import Choice, Rollout
from icrl4aht_generation.policy import Policy

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.trees import same_bytes

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
"""Parameters of the scripted teammate: the number of directions by which its steps are rotated."""


class Diary(NamedTuple):
    """Memory of the scripted teammate."""

    offset: jax.Array  # from the episode's key
    steps: jax.Array  # number of its steps in the episode


def begin(params, key) -> Diary:
    return Diary(jax.random.key_data(key)[1] % 4, jnp.uint32(0))


def acts(params, memory: Diary, view, key):
    """Take a step in a direction that depends on the memory and the observation."""
    action = (memory.offset + memory.steps + view.sum(dtype=jnp.uint32) + params["turn"]) % 4
    return action.astype(jnp.int32), memory._replace(steps=memory.steps + 1)


@pytest.fixture(scope="module")
def learner() -> Learner:
    return Learner(Environment(CLOSET, max_steps=EPISODE), Policy(PARAMS, begin, acts, "observation"), CONFIG)


@pytest.fixture(scope="module")
def update(learner) -> UpdateFunction:
    return jax.jit(learner.update)


@pytest.fixture(scope="module")
def untrained(learner) -> LearnerState:
    return jax.jit(learner.init)(jax.random.key(3))


@pytest.fixture(scope="module")
def frozen(untrained) -> LearnerState:
    """A state at the end of the learning-rate schedule, where nothing is learned any more; its logits and values are
    wide apart and depend on the hidden state."""
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda w: w + rng.normal(size=w.shape).astype(np.float32) * 0.3, untrained.params)
    steps = CONFIG.updates * CONFIG.epochs * CONFIG.minibatches
    return untrained._replace(params=params, optimizer=counted(untrained.optimizer, steps))


def counted(optimizer: Any, steps: int) -> Any:
    """Return the optimizer's state, its counters set."""
    return jax.tree.map(lambda x: jnp.full_like(x, steps) if jnp.issubdtype(x.dtype, jnp.integer) else x, optimizer)


class Played(NamedTuple):
    before: list[LearnerState]
    rollouts: list[Rollout]  # NumPy
    metrics: list[dict[str, float]]
    after: LearnerState


def play(update: UpdateFunction, state: LearnerState, updates: int) -> Played:
    before, rollouts, metrics = [], [], []
    for _ in range(updates):
        before.append(state)
        state, rollout, values = update(state)
        rollouts.append(jax.tree.map(np.asarray, rollout))
        metrics.append({name: float(value) for name, value in values.items()})
    return Played(before, rollouts, metrics, state)


@pytest.fixture(scope="module")
def played(update, frozen) -> Played:
    """Return 40 roll-outs of one policy."""
    return play(update, frozen, 40)


@pytest.fixture(scope="module")
def trained(update, untrained) -> Played:
    return play(update, untrained, CONFIG.updates)


def egos(rollout: Rollout) -> Choice:
    """Return the ego's actions, log-probabilities and values."""
    return rollout.choices[EGO]


def egos_sequences(state: LearnerState, rollout: Rollout) -> Sequences:
    """Return the sequences that the ego learns from in the roll-out from this state."""
    slots, hidden = np.arange(CONFIG.environments), state.carry.memories[EGO]
    view = CompactView("paper", (CLOSET,))
    return sequences(view, rollout, EGO, slots, hidden, jnp.zeros(slots.size), jnp.float32(0))


# Advantages.


def plain_advantage(reward, value, done, last_value, gamma: float, lam: float) -> np.ndarray:
    """Return GAE by a loop over environments and steps."""
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
def test_generalised_advantage(gamma, lam):
    rng = np.random.default_rng(2)
    reward, value = rng.normal(size=(2, 20, 6)).astype(np.float32)
    done = rng.random((20, 6)) < 0.15
    done[-1, 0], done[0, 1], done[:, 2] = True, True, False
    done[-1, 1] = False
    last = rng.normal(size=6).astype(np.float32)
    config = replace(CONFIG, discount=gamma, gae_lambda=lam)
    compute = jax.jit(generalised_advantage, static_argnums=4)
    found = compute(reward, value, done, last, config)
    np.testing.assert_allclose(found, plain_advantage(reward, value, done, last, gamma, lam), rtol=0, atol=1e-5)


# Replay.


def replay(learner: Learner, state: LearnerState, rollout: Rollout, reset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return log-probabilities and values of the network on the sequences that the ego learns from."""
    own = egos_sequences(state, rollout)
    output: Any = jax.jit(learner.network.apply)(state.params, own.hidden[0], own.seen, reset)
    log_probs = np.asarray(jax.nn.log_softmax(output[1]))
    return np.take_along_axis(log_probs, np.asarray(own.action)[..., None], axis=-1)[..., 0], np.asarray(output[2])


def test_sequences_replay_the_rollout_across_an_episode_end(learner, played):
    """The second roll-out: it starts within an episode, with a hidden state, and the next episode starts at step 4."""
    state, rollout = played.before[1], played.rollouts[1]
    np.testing.assert_array_equal(rollout.reset.nonzero()[0], [4] * 4)
    np.testing.assert_array_equal(rollout.done.nonzero()[0], [3] * 4)
    assert np.abs(state.carry.memories[EGO]).min() > 0
    log_prob, value = replay(learner, state, rollout, rollout.reset)
    np.testing.assert_allclose(log_prob, egos(rollout).log_prob, rtol=0, atol=1e-4)
    np.testing.assert_allclose(value, egos(rollout).value, rtol=0, atol=1e-4)
    # The same from dones that are not shifted: wrong from the step of the end on.
    _, value = replay(learner, state, rollout, rollout.done)
    wrong = np.abs(value - egos(rollout).value).max(axis=1)
    assert wrong[:3].max() < 1e-4 < 1e-2 < wrong[3:].min()


def test_loss_against_plain_numpy(learner, played):
    """At moved parameters, where ratios and value changes are clipped, from hand-written formulas."""
    rollout = played.rollouts[1]
    rng = np.random.default_rng(6)
    params = jax.tree.map(lambda w: w + rng.normal(size=w.shape).astype(np.float32) * 0.1, played.before[1].params)
    hidden = played.before[1].carry.memories[EGO]
    advantage, target = rng.normal(size=(2, *rollout.done.shape)).astype(np.float32)
    weight = np.array([1.0, -1.0, 0.5, -2.0], np.float32)  # populations lower the returns of negative weights
    own = egos_sequences(played.before[1], rollout)._replace(weight=weight[None])
    batch = jax.tree.map(jnp.asarray, Batch(own, advantage, target))
    total, parts = jax.jit(learner.ppo.loss)(params, batch)

    obs = observe(CLOSET, rollout.record, EGO)
    output: Any = jax.jit(learner.network.apply)(params, hidden, obs, rollout.reset)
    logits, value = np.asarray(output[1], np.float64), np.asarray(output[2], np.float64)
    log_probs = logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))
    chosen = np.take_along_axis(log_probs, rollout.actions[..., EGO, None], axis=-1)[..., 0]
    ratio = np.exp(chosen - egos(rollout).log_prob)
    change = value - egos(rollout).value
    assert (np.abs(ratio - 1) > CONFIG.clip).any() and (np.abs(change) > CONFIG.clip).any()
    normalised = (advantage - advantage.mean()) / advantage.std() * weight
    policy = -np.minimum(ratio * normalised, np.clip(ratio, 0.8, 1.2) * normalised).mean()
    near = egos(rollout).value + np.clip(change, -0.2, 0.2)
    value_loss = 0.5 * np.maximum((value - target) ** 2, (near - target) ** 2).mean()
    entropy = -(np.exp(log_probs) * log_probs).sum(axis=-1).mean()
    expected = {"policy_loss": policy, "value_loss": value_loss, "entropy": entropy}
    assert set(parts) == set(expected)
    for name, loss in expected.items():
        np.testing.assert_allclose(parts[name], loss, rtol=1e-4, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(total, policy + 0.5 * value_loss - 0.01 * entropy, rtol=1e-4, atol=1e-5)


# Purity.


def test_update_is_a_pure_function(update, played):
    state = played.before[3]
    once, again = update(state), update(state)
    assert same_bytes(once, again)
    other_state, other_rollout, _ = update(state._replace(key=jax.random.key(77)))
    assert not np.array_equal(other_rollout.actions[..., EGO], once[1].actions[..., EGO])
    assert not same_bytes(other_state.carry.memories[EGO], once[0].carry.memories[EGO])


# Episodes.


def test_the_teammates_parameters_are_in_the_state(update, frozen, played):
    """One compiled update serves every teammate of a family."""
    state, rollout, _ = update(frozen._replace(teammate={"turn": jnp.uint32(1)}))
    first = played.rollouts[0].actions[0, :, TEAMMATE]
    np.testing.assert_array_equal(rollout.actions[0, :, TEAMMATE], (first + 1) % 4)
    assert int(state.teammate["turn"]) == 1


# Schedules.


def test_shaping_weight_falls_linearly_to_zero(played):
    found = [metrics["shaping"] for metrics in played.metrics]
    expected = [1 - n / 30 if n < 30 else 0 for n in range(len(found))]  # 32 of 960 steps an update
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_learning_rate_schedule():
    """Read from the optimizer: under a constant gradient g, Adam moves by rate * g / (g + eps)."""
    steps = CONFIG.updates * CONFIG.epochs * CONFIG.minibatches
    warm = steps // 10
    gradient = jnp.float32(1e-3)

    def one(state, _):
        change, state = ppo_optimizer(CONFIG).update(gradient, state)
        return state, change

    changes = jax.lax.scan(one, ppo_optimizer(CONFIG).init(gradient), length=steps + 1)[1]
    rates = -np.asarray(changes, np.float64) * (1e-3 + 1e-5) / 1e-3
    t = np.arange(steps + 1)
    expected = np.where(t < warm, t / warm, 0.5 * (1 + np.cos(np.pi * (t - warm) / (steps - warm))))
    assert (expected[0], expected[warm], expected[-1]) == (0, 1, 0)
    np.testing.assert_allclose(rates / CONFIG.learning_rate, expected, rtol=0, atol=1e-3)
    assert rates[0] == 0
    assert rates.argmax() == warm
    assert rates[-1] == 0


# Configuration.


@pytest.mark.parametrize("steps", [1, 100, 101, 400, 500, 501, 899, 901, 58_368])
def test_episodes_are_those_with_a_hundred_steps_and_the_state_after_them(steps):
    """The records of `steps` steps hold what is kept of an episode if they reach its step 100."""
    complete = sum(start + 100 < steps for start in range(0, steps, 400))
    assert PPOConfig(total_steps=steps, environments=1, rollout=1, minibatches=1).episodes == complete


# Learning.


def test_the_ego_learns_not_to_press(trained):
    """A press costs 5, and a random ego presses about once an episode."""
    early = np.mean([rollout.reward.mean() for rollout in trained.rollouts[:5]])
    late = np.mean([rollout.reward.mean() for rollout in trained.rollouts[-20:]])
    assert early < -0.1
    assert late > 0.2 * early


# Rewards.


REWARDS = np.array([-20, -25, -30, -10, -5, 0, 20, 15], np.float32)
"""A wrong delivery, one with one press of a button and with two, presses alone, nothing, a delivery without and with a
press."""


def rewarded() -> Rollout:
    """Return steps of two environments with these rewards; agent a has the shaped reward a + 1 in every step."""
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


def test_a_wrong_delivery_is_forgiven_as_long_as_rewards_are_shaped():
    """A wrong delivery is forgiven for both agents, with or without button presses; presses alone are not."""
    slots = np.arange(4)  # both agents of both environments
    agents = np.repeat([EGO, TEAMMATE], 2)
    for weight, forgiven in ((1.0, 20), (0.25, 5), (0.0, 0)):
        found = sequences(
            lambda records: records,  # type: ignore[arg-type]
            rewarded(),
            0,
            slots,
            jnp.zeros((4, 8)),
            jnp.zeros(4),
            jnp.float32(weight),
            forgiveness=20.0,
        )
        expected = REWARDS + np.array([forgiven] * 3 + [0] * 5, np.float32)
        np.testing.assert_allclose(found.reward, expected[:, None] + weight * (agents + 1), atol=1e-5)
