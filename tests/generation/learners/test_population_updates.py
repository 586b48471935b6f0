"""Test one update of a population: training data of each policy, changes of the state, and metrics."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners.population import population as population_module
from icrl4aht_generation.learners.population.comedi import CoMeDi
from icrl4aht_generation.learners.population.lbrdiv import LBRDiv, Multipliers
from icrl4aht_generation.learners.population.population import Algorithm, Population, PopulationState
from icrl4aht_generation.learners.ppo import sequences, shaping_weight
from icrl4aht_generation.learners.rollout import Rollout, RolloutCarry, roll_out

from tests.helpers.populations import CONFIG, lbrdiv_multipliers, population
from tests.helpers.trees import same_bytes

pytestmark = pytest.mark.slow


def select(tree: Any, number: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[number], tree)


@pytest.fixture(scope="module")
def learn(lbrdiv):
    """Return the compiled PPO update of a single policy."""
    return jax.jit(lbrdiv.population.ppo.learn)


class UpdateResult(NamedTuple):
    """An update of a population, with the states before and after.

    Attributes:
        population: the updated population.
        update: compiled function from a state to the next state, the metrics, and the carry and steps of the rollout.
        before: state before the update.
        after: state after the update.
        metrics: metrics of the update.
        carry: environments and memories after the update's rollout.
        rollout: steps of the update's rollout.
    """

    population: Population
    update: Any
    before: PopulationState
    after: PopulationState
    metrics: dict[str, float]
    carry: RolloutCarry
    rollout: Rollout


def second_update(algorithm: Algorithm) -> UpdateResult:
    """Return the second update of a population, in which the learning rate's warm-up is over."""
    trained = population(algorithm)

    @jax.jit
    def update(state: PopulationState):
        rollouts = []

        def recording_roll_out(*arguments):
            rollouts.append(roll_out(*arguments))
            return rollouts[-1]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(population_module, "roll_out", recording_roll_out)
            return *trained.update(state), *rollouts[0]

    before = update(jax.jit(trained.init)(jax.random.key(5)))[0]
    after, metrics, carry, rollout = update(before)
    return UpdateResult(trained, update, before, after, {n: float(v) for n, v in metrics.items()}, carry, rollout)


@pytest.fixture(scope="module")
def comedi() -> UpdateResult:
    return second_update(CoMeDi())


@pytest.fixture(scope="module")
def lbrdiv() -> UpdateResult:
    return second_update(LBRDiv(2))


@pytest.fixture(params=["comedi", "lbrdiv"])
def updated(request) -> UpdateResult:
    return request.getfixturevalue(request.param)


def test_population_update_depends_only_on_the_state(updated):
    assert same_bytes(updated.update(updated.before)[0], updated.after)
    other = updated.update(updated.before._replace(key=jax.random.key(77)))[0]
    assert not same_bytes(other.params, updated.after.params)
    later = updated.update(updated.before._replace(update=jnp.int32(5)))[0]
    assert not same_bytes(later.params, updated.after.params)


def test_population_update_changes_learning_policies_only(updated):
    learning = updated.population.assignment.learning
    for number in range(updated.population.assignment.policies):
        same = same_bytes(select(updated.before.params, number), select(updated.after.params, number))
        assert same == (number >= learning)


def test_metrics_separate_returns_of_self_play_and_cross_play(updated):
    assignment, done = updated.population.assignment, np.asarray(updated.rollout.done)
    returns = np.asarray(updated.rollout.returns)
    fresh, group = assignment.starts_from < 0, assignment.policy[0] % 2 == assignment.policy[1] % 2
    assert done[-1].all()
    assert updated.metrics["episodes"] == assignment.envs
    np.testing.assert_allclose(updated.metrics["self_play"], returns[-1][group & fresh].mean(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(updated.metrics["cross_play"], returns[-1][~group].mean(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(updated.metrics["shaping"], 1 - 96 / CONFIG.shaping_horizon, rtol=1e-6)


def test_population_update_equals_separate_updates_of_each_policy(lbrdiv, learn):
    """Compare an update of the population with a separate update of each policy on the slots that it plays."""
    trained, before = lbrdiv.population, lbrdiv.before
    assignment = trained.assignment
    key = jax.random.split(jax.random.fold_in(before.key, before.update), 3)[1]
    keys = jax.random.split(jax.random.fold_in(key, 0), 4)
    weight = np.asarray(trained._slot_weights(before.memory))
    (group,) = trained.groups

    def sequences_of_all_slots(state, carry, rollout):
        last = trained._players(state.params)[0].act(carry.memories[0], carry.env, key)[0].value
        shaping = shaping_weight(CONFIG, state.update)
        return sequences(trained.view, rollout, 0, group.agent_slots.ravel(), state.carry.memories[0], last, shaping)

    everyone = jax.tree.map(np.asarray, jax.jit(sequences_of_all_slots)(before, lbrdiv.carry, lbrdiv.rollout))
    for number in range(4):
        slots = assignment.agent_slots(number)[0]
        chosen = np.array([group.agent_slots.ravel().tolist().index(slot) for slot in slots])
        played = jax.tree.map(lambda leaf, chosen=chosen: leaf[:, chosen], everyone)._replace(
            weight=jnp.asarray(weight[slots])[None],
            partner=jnp.asarray(assignment.policy[1 - slots[0] // assignment.envs, slots % assignment.envs])[None],
        )
        expected = learn(select(before.params, number), select(before.optimizer, number), played, keys[number])[0]
        for a, b in zip(jax.tree.leaves(select(lbrdiv.after.params, number)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=5e-5)


def test_shaped_rewards_are_ignored_in_slots_with_negative_weight(lbrdiv):
    trained, before = lbrdiv.population, lbrdiv.before
    lowered = np.asarray(trained._slot_weights(before.memory)).reshape(2, -1).T < 0  # shape (N, 2)
    assert 0 < lowered.sum() < lowered.size
    shaped = np.random.default_rng(8).uniform(size=lbrdiv.rollout.shaped.shape).astype(np.float32)

    @jax.jit
    def learn_from(shaped):
        rollout = lbrdiv.rollout._replace(shaped=shaped)
        return trained._learn(before, trained._players(before.params), lbrdiv.carry, rollout, jax.random.key(1))[0]

    params = learn_from(shaped)
    assert same_bytes(params, learn_from(np.where(lowered, 0.0, shaped)))
    assert not same_bytes(params, learn_from(np.where(lowered, shaped, 0.0)))


def test_lbrdiv_multipliers_follow_the_returns_of_the_environments(lbrdiv):
    assignment, returns = lbrdiv.population.assignment, np.asarray(lbrdiv.rollout.returns)[-1]
    env = np.full((4, 4), np.nan)
    seen = np.zeros((4, 4), bool)
    for left, right in product((2, 3), (0, 1)):
        env[left, right] = returns[(assignment.policy[0] == left) & (assignment.policy[1] == right)].mean()
        seen[left, right] = True
    expected = lbrdiv_multipliers(lbrdiv.before.memory, env, seen, 0.1, 0.01)
    for name, one, other in zip(Multipliers._fields, lbrdiv.after.memory, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6, err_msg=name)


def test_comedi_starts_some_episodes_in_states_of_mixed_play(comedi):
    """The last quarter of environments starts from states that the third quarter visited in the previous rollout."""
    source = comedi.population.assignment.starts_from
    started = np.asarray(comedi.after.carry.env.record)
    visited = np.asarray(comedi.before.visited)
    moved = source >= 0
    assert moved.sum() == 4
    np.testing.assert_array_equal(started[moved], visited[source[moved]])
    env = comedi.after.carry.env
    fresh = np.asarray(jax.jit(comedi.population.env.first_record)(env.key, env.episode))
    np.testing.assert_array_equal(started[~moved], fresh[~moved])
    assert (started[moved] != fresh[moved]).any(axis=1).all()
