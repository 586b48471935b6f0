"""Test the population algorithms: policies of agent slots, weights of slots, and LBRDiv's multipliers.

Expected values are computed by the formulas of the paper's App. B.1.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners.population.brdiv import BRDiv
from icrl4aht_generation.learners.population.comedi import CoMeDi
from icrl4aht_generation.learners.population.fcp import FCP
from icrl4aht_generation.learners.population.lbrdiv import LBRDiv, Multipliers

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from tests.helpers.populations import lbrdiv_multipliers, population


def test_each_fcp_member_plays_both_agents():
    assignment = FCP(3).assignment(4)
    np.testing.assert_array_equal(assignment.policy, [[0] * 4 + [1] * 4 + [2] * 4] * 2)
    np.testing.assert_array_equal(assignment.term, assignment.policy)
    assert (assignment.learning, assignment.envs, assignment.self_play.all()) == (3, 12, True)
    np.testing.assert_array_equal(assignment.starts_from, -1)
    for member in range(3):
        counting, others = assignment.agent_slots(member)
        np.testing.assert_array_equal(
            counting, [*range(4 * member, 4 * member + 4), *range(12 + 4 * member, 16 + 4 * member)]
        )
        assert others.size == 0


@pytest.mark.parametrize("algorithm", [BRDiv, LBRDiv])
@pytest.mark.parametrize(("members", "environments"), [(1, 4), (2, 8), (3, 8), (10, 256)])
def test_confederates_play_teammates_and_best_responses_play_egos(algorithm, members, environments):
    assignment = algorithm(members).assignment(environments)
    responses, confederates = assignment.policy
    assert set(responses) == set(range(members, 2 * members))
    assert set(confederates) == set(range(members))
    assert assignment.learning == assignment.policies == 2 * members
    np.testing.assert_array_equal(assignment.group, [*range(members)] * 2)
    np.testing.assert_array_equal(assignment.self_play, responses - members == confederates)
    np.testing.assert_array_equal(assignment.starts_from, -1)
    for policy in range(2 * members):
        counting, others = assignment.agent_slots(policy)
        agent = EGO if policy >= members else TEAMMATE
        assert (counting.size, others.size) == (environments, 0)
        np.testing.assert_array_equal(counting // assignment.envs, agent)
        np.testing.assert_array_equal(assignment.policy[agent, counting % assignment.envs], policy)


@pytest.mark.parametrize(("members", "environments"), [(2, 8), (3, 8), (4, 24), (10, 256)])
def test_brdiv_has_three_quarters_self_play_and_all_cross_play_pairs(members, environments):
    responses, confederates = BRDiv(members).assignment(environments).policy
    pairs = np.zeros((members, members), int)
    np.add.at(pairs, (confederates, responses - members), 1)
    assert (pairs > 0).all()
    np.testing.assert_array_equal(pairs.diagonal(), environments * 3 // 4)
    others = pairs[~np.eye(members, dtype=bool)]
    assert others.max() - others.min() <= 1
    np.testing.assert_array_equal(pairs.sum(axis=1), environments)


@pytest.mark.parametrize("environments", [8, 16, 256])
def test_comedi_divides_environments_equally_among_four_kinds_of_play(environments):
    assignment = CoMeDi().assignment(environments)
    quarter = environments // 4
    play, cross, mixed, from_mixed = np.split(assignment.policy, 4, axis=1)
    terms = np.split(assignment.term, 4, axis=1)
    np.testing.assert_array_equal(play, 0)
    np.testing.assert_array_equal(terms[0], 0)
    half = quarter // 2
    np.testing.assert_array_equal(cross, [[1] * half + [0] * half, [0] * half + [1] * half])
    np.testing.assert_array_equal(terms[1], np.where(cross == 0, 1, -1))
    np.testing.assert_array_equal(mixed[:, ::2], 0)
    np.testing.assert_array_equal(mixed[:, 1::2].sum(axis=0), 1)
    np.testing.assert_array_equal(terms[2], -1)
    np.testing.assert_array_equal(from_mixed, mixed)
    np.testing.assert_array_equal(terms[3][:, ::2], 2)
    np.testing.assert_array_equal(terms[3][:, 1::2], np.where(mixed[:, 1::2] == 0, 3, -1))
    envs = np.arange(environments)
    np.testing.assert_array_equal(assignment.starts_from, np.where(envs < 3 * quarter, -1, envs - quarter))
    assert (assignment.learning, assignment.policies) == (1, 2)
    np.testing.assert_array_equal(assignment.self_play, (assignment.policy == 0).all(axis=0))
    assert assignment.agent_slots(0)[0].size == 2 * quarter + quarter + quarter * 3 // 2
    assert assignment.agent_slots(1)[0].size == 0
    assert assignment.agent_slots(0)[1].size + assignment.agent_slots(1)[1].size == 2 * quarter + quarter + quarter // 2


def test_comedi_rejects_a_number_of_environments_that_is_not_a_multiple_of_eight():
    with pytest.raises(ValueError, match="environments = 12: expected a multiple of 8 for CoMeDi"):
        CoMeDi().assignment(12)


@pytest.mark.parametrize("algorithm", [FCP(3), BRDiv(3), LBRDiv(4), CoMeDi()])
def test_groups_of_policies_contain_every_slot_once(algorithm):
    trained = population(algorithm)
    assignment = trained.assignment
    everyone = np.concatenate([group.agent_slots.ravel() for group in trained.groups])
    np.testing.assert_array_equal(np.sort(everyone), np.arange(2 * assignment.envs))
    policies = [group.first + k for group in trained.groups for k in range(len(group.agent_slots))]
    assert policies == list(range(assignment.policies))
    for group in trained.groups:
        for k, slots in enumerate(group.agent_slots):
            counting, others = assignment.agent_slots(group.first + k)
            np.testing.assert_array_equal(slots, np.concatenate([counting, others]))
            assert group.counting == counting.size


def test_critics_receive_the_partner_if_partners_vary():
    algorithms = (FCP(3), BRDiv(1), BRDiv(3), LBRDiv(2), CoMeDi())
    assert [population(algorithm).network.partners for algorithm in algorithms] == [0, 0, 6, 4, 2]
    assert population(FCP(1), partners=2).network.partners == 2


def paper_slot_weights(algorithm: Any, memory: Any) -> np.ndarray:
    """Return the weights of the slots' returns in the paper's objectives, float64 of shape (2, N).

    The return of a slot counts in the objective of the policy that plays the slot. The expected return of a pair of
    policies is estimated by the mean over the slots in which the pair plays.
    """
    assignment = algorithm.assignment(16)
    k = getattr(algorithm, "members", 0)
    expected = np.zeros(assignment.policy.shape)
    for env, (left, right) in enumerate(assignment.policy.T):
        if isinstance(algorithm, FCP):
            expected[:, env] = 1 / 32
        elif isinstance(algorithm, CoMeDi):
            quarter = env // 4
            alpha, beta = algorithm.cross_play_weight, algorithm.mixed_play_weight
            # J_MP is half the mean over the 4 self-play slots plus half that over the 2 with the frozen member.
            mixed = beta / 2 / 4 if left == right else beta / 2 / 2
            both = {0: 1 / 8, 1: -alpha / 4, 2: 0, 3: mixed}[quarter]
            expected[:, env] = [both * (left == 0), both * (right == 0)]
        else:
            i, j = int(right), int(left) - k
            n = np.sum((assignment.policy[0] == left) & (assignment.policy[1] == right))
            if isinstance(algorithm, BRDiv):
                conf = 1 + 2 * algorithm.cross_play_weight if i == j else -algorithm.cross_play_weight
                expected[:, env] = [float(i == j) / n, conf / n]
            elif i == j:
                expected[:, env] = sum(memory.vertical[i, m] + memory.horizontal[i, m] for m in range(k)) / n
            else:
                expected[:, env] = -(memory.horizontal[i, j] + memory.vertical[j, i]) / n
    return expected


def random_multipliers(members: int) -> Multipliers:
    rng = np.random.default_rng(members)
    vertical, horizontal, returns = rng.uniform(0, 2, (3, members, members)).astype(np.float32)
    np.fill_diagonal(vertical, 0.5)
    np.fill_diagonal(horizontal, 0.5)
    return Multipliers(*(jnp.asarray(x) for x in (vertical, horizontal, returns, rng.random((members, members)) < 0.5)))


@pytest.mark.parametrize(
    ("algorithm", "memory"),
    [
        (FCP(3), ()),
        (BRDiv(3), ()),
        (BRDiv(2, cross_play_weight=0.25), ()),
        (LBRDiv(3), random_multipliers(3)),
        (LBRDiv(4), LBRDiv(4).init()),
        (CoMeDi(), ()),
        (CoMeDi(cross_play_weight=0.3, mixed_play_weight=2.0), ()),
    ],
)
def test_slot_weights_follow_the_equations_of_the_paper(algorithm, memory):
    """Each policy's weights are those of the paper, divided by their mean absolute value."""
    trained = population(algorithm)
    found = np.asarray(trained._slot_weights(memory))
    expected, policy, counts = (
        paper_slot_weights(algorithm, memory).ravel(),
        trained.assignment.policy.ravel(),
        trained.assignment.term >= 0,
    )
    np.testing.assert_array_equal(found[~counts.ravel()], 0)
    for number in range(trained.assignment.learning):
        mine = (policy == number) & counts.ravel()
        np.testing.assert_allclose(np.abs(found[mine]).mean(), 1, rtol=1e-5)
        np.testing.assert_allclose(found[mine], expected[mine] / np.abs(expected[mine]).mean(), rtol=1e-5)


def random_returns(k: int, rng: np.random.Generator, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a random matrix of mean returns and a mask of the pairs that played, both of shape (2k, 2k).

    A best response as the ego has played with a confederate as the teammate with probability `share`; no others have.
    The returns (float32) of pairs that did not play are NaN.
    """
    seen = np.zeros((2 * k, 2 * k), bool)
    seen[k:, :k] = rng.random((k, k)) < share
    return np.where(seen, rng.normal(size=seen.shape) * 30, np.nan).astype(np.float32), seen


def test_lbrdiv_multipliers_follow_the_update_of_the_paper():
    """Compare the multipliers after each of seven updates that observe different shares of the pairs."""
    k, rng = 4, np.random.default_rng(12)
    algorithm = LBRDiv(k, tolerance=0.3, learning_rate=0.05)
    found, expected = algorithm.init(), algorithm.init()
    adapt, clipped, unknown = jax.jit(algorithm.adapt), 0, 0
    for share in (0.0, 0.2, 0.5, 0.0, 0.5, 0.9, 1.0):
        returns, seen = random_returns(k, rng, share)
        found = adapt(found, returns, seen)
        expected = lbrdiv_multipliers(expected, returns, seen, 0.3, 0.05)
        for name, one, other in zip(Multipliers._fields, found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4, err_msg=name)
        for multipliers in found[:2]:
            np.testing.assert_array_equal(np.diag(multipliers), 0.5)
            assert np.min(multipliers) >= 0
        clipped += np.sum((expected.vertical == 0) & (expected.known.T))
        unknown += np.sum(~np.array(expected.known))
    assert clipped
    assert unknown
    assert np.max(found.vertical) > 0.5
