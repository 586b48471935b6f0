"""Who sits where in each algorithm, what each place counts, the multipliers, and one update of a whole population.

Formulas are from the paper's App. B.1, written out here by hand.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxes import compiled, same_bytes

from generation.env import Environment
from generation.learners.brdiv import BRDiv
from generation.learners.comedi import CoMeDi
from generation.learners.fcp import FCP
from generation.learners.lbrdiv import LBRDiv, Multipliers
from generation.learners.network import Widths
from generation.learners.population import Algorithm, Population, PopulationState
from generation.learners.ppo import Batch, PPOConfig, Sequences, sequences
from generation.learners.rollout import Rollout, Seats, roll_out
from icrl4aht_data.benchmark import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe

LAYOUT = get_layout("cramped_up")
EPISODE = 6
CONFIG = PPOConfig(
    total_steps=16 * EPISODE * 10,
    environments=16,
    rollout=EPISODE,
    epochs=2,
    minibatches=2,
    learning_rate=0.01,
    widths=Widths(pointwise=(4,), spatial=(4,), dense=8, gru=8, head=8),
)


def population(algorithm: Algorithm, config: PPOConfig = CONFIG, **options: Any) -> Population:
    return Population(Environment(LAYOUT, max_steps=EPISODE), algorithm, config, **options)


# Who sits where.


def test_fcp_members_play_themselves_in_both_seats():
    seating = FCP(3).seating(4)
    np.testing.assert_array_equal(seating.policy, [[0] * 4 + [1] * 4 + [2] * 4] * 2)
    np.testing.assert_array_equal(seating.term, seating.policy)
    assert (seating.learning, seating.tables, seating.self_play.all()) == (3, 12, True)
    np.testing.assert_array_equal(seating.starts_from, -1)
    for member in range(3):
        counting, others = seating.places(member)
        np.testing.assert_array_equal(
            counting, [*range(4 * member, 4 * member + 4), *range(12 + 4 * member, 16 + 4 * member)]
        )
        assert others.size == 0


@pytest.mark.parametrize("algorithm", [BRDiv, LBRDiv])
@pytest.mark.parametrize(("members", "environments"), [(1, 4), (2, 8), (3, 8), (10, 256)])
def test_confederates_sit_in_seat_1_and_best_responses_in_seat_0(algorithm, members, environments):
    seating = algorithm(members).seating(environments)
    responses, confederates = seating.policy
    assert set(responses) == set(range(members, 2 * members))
    assert set(confederates) == set(range(members))
    assert seating.learning == seating.policies == 2 * members
    np.testing.assert_array_equal(seating.kin, [*range(members)] * 2)
    np.testing.assert_array_equal(seating.self_play, responses - members == confederates)
    np.testing.assert_array_equal(seating.starts_from, -1)
    for policy in range(2 * members):
        counting, others = seating.places(policy)
        seat = EGO if policy >= members else TEAMMATE
        assert (counting.size, others.size) == (environments, 0)
        np.testing.assert_array_equal(counting // seating.tables, seat)
        np.testing.assert_array_equal(seating.policy[seat, counting % seating.tables], policy)


@pytest.mark.parametrize(("members", "environments"), [(2, 8), (3, 8), (4, 24), (10, 256)])
def test_every_pair_plays_three_quarters_of_all_tables_self_play(members, environments):
    responses, confederates = BRDiv(members).seating(environments).policy
    pairs = np.zeros((members, members), int)
    np.add.at(pairs, (confederates, responses - members), 1)
    assert (pairs > 0).all()
    np.testing.assert_array_equal(pairs.diagonal(), environments * 3 // 4)
    others = pairs[~np.eye(members, dtype=bool)]
    assert others.max() - others.min() <= 1
    np.testing.assert_array_equal(pairs.sum(axis=1), environments)


def test_each_pair_of_brdiv_is_a_term_for_either_side():
    seating = BRDiv(3).seating(8)
    for table, (response, confederate) in enumerate(seating.policy.T):
        pair = 3 * confederate + response - 3
        assert seating.term[:, table].tolist() == [9 + pair, pair]


@pytest.mark.parametrize("environments", [8, 16, 256])
def test_comedi_has_a_quarter_each_of_self_play_cross_play_mixed_play_and_its_states(environments):
    seating = CoMeDi().seating(environments)
    quarter = environments // 4
    play, cross, mixed, from_mixed = np.split(seating.policy, 4, axis=1)
    terms = np.split(seating.term, 4, axis=1)
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
    tables = np.arange(environments)
    np.testing.assert_array_equal(seating.starts_from, np.where(tables < 3 * quarter, -1, tables - quarter))
    assert (seating.learning, seating.policies) == (1, 2)
    np.testing.assert_array_equal(seating.self_play, (seating.policy == 0).all(axis=0))
    assert seating.places(0)[0].size == 2 * quarter + quarter + quarter * 3 // 2
    assert seating.places(1)[0].size == 0
    assert seating.places(0)[1].size + seating.places(1)[1].size == 2 * quarter + quarter + quarter // 2


def test_comedi_mixes_the_frozen_member_into_both_seats():
    mixed = np.split(CoMeDi().seating(16).policy, 4, axis=1)[2]
    assert (mixed == 1).any(axis=1).all()


def test_comedi_needs_tables_that_divide_by_eight():
    with pytest.raises(ValueError, match="environments = 12: CoMeDi needs a multiple of 8"):
        CoMeDi().seating(12)


@pytest.mark.parametrize("algorithm", [FCP(3), BRDiv(3), LBRDiv(4), CoMeDi()])
def test_groups_hold_every_place_once_those_that_count_first(algorithm):
    whole = population(algorithm)
    seating = whole.seating
    everyone = np.concatenate([group.places.ravel() for group in whole.groups])
    np.testing.assert_array_equal(np.sort(everyone), np.arange(2 * seating.tables))
    policies = [group.first + k for group in whole.groups for k in range(len(group.places))]
    assert policies == list(range(seating.policies))
    for group in whole.groups:
        for k, places in enumerate(group.places):
            counting, others = seating.places(group.first + k)
            np.testing.assert_array_equal(places, np.concatenate([counting, others]))
            assert group.counting == counting.size


def test_critics_are_told_the_partner_where_partners_vary():
    partners = {type(a): population(a).network.partners for a in (FCP(3), BRDiv(1), BRDiv(3), LBRDiv(2), CoMeDi())}
    assert partners == {FCP: 0, BRDiv: 6, LBRDiv: 4, CoMeDi: 2}
    assert population(BRDiv(1)).network.partners == 0
    assert population(FCP(1), partners=2).network.partners == 2


# What counts how much.


def by_hand(algorithm: Any, memory: Any) -> np.ndarray:
    """The weight of each place's return in its policy's objective, from the paper's equations, (2, N); each expected
    return is a mean over its places."""
    seating = algorithm.seating(16)
    k = getattr(algorithm, "members", 0)
    expected = np.zeros(seating.policy.shape)
    for table, (left, right) in enumerate(seating.policy.T):
        if isinstance(algorithm, FCP):
            expected[:, table] = 1 / 32
        elif isinstance(algorithm, CoMeDi):
            quarter = table // 4
            alpha, beta = algorithm.cross_play_weight, algorithm.mixed_play_weight
            mixed = beta / 2 / 4 if left == right else beta / 2 / 2  # half of J_MP over 4 places, half over 2
            both = {0: 1 / 8, 1: -alpha / 4, 2: 0, 3: mixed}[quarter]
            expected[:, table] = [both * (left == 0), both * (right == 0)]
        else:
            i, j = int(right), int(left) - k
            n = np.sum((seating.policy[0] == left) & (seating.policy[1] == right))
            if isinstance(algorithm, BRDiv):
                conf = 1 + 2 * algorithm.cross_play_weight if i == j else -algorithm.cross_play_weight
                expected[:, table] = [float(i == j) / n, conf / n]
            elif i == j:
                expected[:, table] = sum(memory.vertical[i, m] + memory.horizontal[i, m] for m in range(k)) / n
            else:
                expected[:, table] = -(memory.horizontal[i, j] + memory.vertical[j, i]) / n
    return expected


def some_multipliers(members: int) -> Multipliers:
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
        (LBRDiv(3), some_multipliers(3)),
        (LBRDiv(4), LBRDiv(4).begin()),
        (CoMeDi(), ()),
        (CoMeDi(cross_play_weight=0.3, mixed_play_weight=2.0), ()),
    ],
)
def test_place_weights_are_the_papers(algorithm, memory):
    """Up to a positive factor for each policy, which makes the mean size of a policy's weights 1."""
    whole = population(algorithm)
    found = np.asarray(whole._place_weights(memory))
    expected, policy, counts = by_hand(algorithm, memory).ravel(), whole.seating.policy.ravel(), whole.seating.term >= 0
    np.testing.assert_array_equal(found[~counts.ravel()], 0)
    for number in range(whole.seating.learning):
        mine = (policy == number) & counts.ravel()
        np.testing.assert_allclose(np.abs(found[mine]).mean(), 1, rtol=1e-5)
        np.testing.assert_allclose(found[mine], expected[mine] / np.abs(expected[mine]).mean(), rtol=1e-5)


def test_brdiv_weighs_self_play_by_one_more_than_twice_cross_play():
    """Of a confederate's weights, summed over its places by opposite: 2 for its own, -1/2 for each other one's."""
    seating = BRDiv(3).seating(16)
    weights = np.asarray(population(BRDiv(3))._place_weights(()))[seating.tables :]
    totals = np.array(
        [[weights[(seating.policy[1] == i) & (seating.policy[0] == 3 + j)].sum() for j in range(3)] for i in range(3)]
    )
    np.testing.assert_allclose(
        totals / totals[0, 0], [[1, -0.25, -0.25], [-0.25, 1, -0.25], [-0.25, -0.25, 1]], rtol=1e-5
    )


# Multipliers.


def plain_adapt(old: Multipliers, returns: np.ndarray, seen: np.ndarray, tolerance: float, rate: float) -> Multipliers:
    """Entry by entry, from the paper's update; J[i, j] of confederate i with best response j."""
    k = len(old.vertical)
    vertical, horizontal, latest = (np.array(x, np.float64) for x in old[:3])
    known = np.array(old.known)
    for i, j in product(range(k), range(k)):
        if seen[k + j, i]:
            latest[i, j], known[i, j] = returns[k + j, i], True
    if seen.any():
        for i, j in product(range(k), range(k)):
            if i != j and known[i, i] and known[j, i]:
                vertical[i, j] = max(vertical[i, j] - rate * (latest[i, i] - latest[j, i] - tolerance), 0)
            if i != j and known[i, i] and known[i, j]:
                horizontal[i, j] = max(horizontal[i, j] - rate * (latest[i, i] - latest[i, j] - tolerance), 0)
    return Multipliers(vertical, horizontal, latest, known)  # type: ignore[arg-type]


def random_returns(k: int, rng: np.random.Generator, share: float) -> tuple[np.ndarray, np.ndarray]:
    """(2k, 2k) returns that are not a number where none was seen; only responses in seat 0 are."""
    seen = np.zeros((2 * k, 2 * k), bool)
    seen[k:, :k] = rng.random((k, k)) < share
    return np.where(seen, rng.normal(size=seen.shape) * 30, np.nan).astype(np.float32), seen


def test_multipliers_follow_the_papers_update():
    """From the start, a few pairs seen at a time."""
    k, rng = 4, np.random.default_rng(12)
    algorithm = LBRDiv(k, tolerance=0.3, learning_rate=0.05)
    found, expected = algorithm.begin(), algorithm.begin()
    adapt, clipped, unknown = jax.jit(algorithm.adapt), 0, 0
    for share in (0.0, 0.2, 0.5, 0.0, 0.5, 0.9, 1.0):
        returns, seen = random_returns(k, rng, share)
        found = adapt(found, returns, seen)
        expected = plain_adapt(expected, returns, seen, 0.3, 0.05)
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


def test_unknown_pairs_keep_their_multipliers():
    """Confederate 0 with response 0, and with response 1, which violates a horizontal constraint and no other."""
    algorithm, old = LBRDiv(3, tolerance=0.1, learning_rate=0.01), some_multipliers(3)
    old = old._replace(known=jnp.zeros((3, 3), bool))
    returns, seen = np.full((6, 6), np.nan, np.float32), np.zeros((6, 6), bool)
    returns[3, 0], returns[4, 0] = 10.0, 30.0
    seen[3, 0] = seen[4, 0] = True
    new = algorithm.adapt(old, jnp.asarray(returns), jnp.asarray(seen))
    np.testing.assert_array_equal(new.vertical, old.vertical)
    changed = np.array(new.horizontal - old.horizontal)
    np.testing.assert_allclose(changed[0, 1], 0.01 * (30 - 10 + 0.1), rtol=1e-4)
    changed[0, 1] = 0
    np.testing.assert_array_equal(changed, 0)


def test_nothing_moves_while_no_episode_ends():
    algorithm, old = LBRDiv(3), some_multipliers(3)._replace(known=jnp.ones((3, 3), bool))
    new = algorithm.adapt(old, jnp.zeros((6, 6)), jnp.zeros((6, 6), bool))
    assert same_bytes(new, old)


# Negative weights.


class Parts(NamedTuple):
    """Two policies with their parts of one roll-out, leaves (2, ...)."""

    params: Any
    optimizer: Any
    played: Sequences


REWARDED = 2


@pytest.fixture(scope="module")
def parts(lbrdiv) -> Parts:
    """Made-up sequences in which one action brings a reward at once; the second policy's weights are -1."""
    before, rng = lbrdiv.before, np.random.default_rng(2)
    steps, places = EPISODE, 16
    action = rng.integers(0, 6, (2, steps, places))
    record = np.asarray(before.seats.env.record)[rng.integers(0, 32, (2, steps, places))]
    zeros = np.zeros((2, steps, places), np.float32)
    arrays: dict[str, Any] = {
        "record": record,
        "reset": np.broadcast_to(np.arange(steps)[:, None] == 0, zeros.shape),
        "action": action,
        "log_prob": zeros - np.log(6, dtype=np.float32),
        "value": zeros,
        "reward": (action == REWARDED).astype(np.float32),
        "done": zeros > -1,
        "hidden": np.zeros((2, 1, places, 8), np.float32),
        "partner": np.zeros((2, 1, places), np.int32),
        "weight": np.array([1, -1], np.float32)[:, None, None] * np.ones((2, 1, places), np.float32),
        "last_value": zeros[:, :1],
    }
    optimizer = jax.tree.map(
        lambda x: jnp.full_like(x, 20) if jnp.issubdtype(x.dtype, jnp.integer) else x, before.optimizer
    )  # past the warm-up
    params, optimizer = (jax.tree.map(lambda leaf: leaf[:2], tree) for tree in (before.params, optimizer))
    return Parts(params, optimizer, Sequences(**{name: jnp.asarray(array) for name, array in arrays.items()}))


def part(tree: Any, number: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[number], tree)


@pytest.fixture(scope="module")
def surrogate(lbrdiv):
    """The policy loss's gradient, and the other losses."""

    def policy_loss(params, batch):
        losses = dict(lbrdiv.population.ppo.loss(params, batch)[1])
        return losses.pop("policy_loss"), losses

    return compiled(jax.grad(policy_loss, has_aux=True))


def test_the_surrogate_of_weight_minus_1_is_that_of_negated_advantages(surrogate, parts):
    params, played = part(parts.params, 0), part(parts.played, 0)
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda w: w + rng.normal(size=w.shape).astype(np.float32) * 0.3, params)  # ratios are clipped
    advantage, target = jnp.asarray(rng.normal(size=(2, *played.done.shape)), jnp.float32)
    down, others = surrogate(params, Batch(played._replace(weight=-played.weight), advantage, target))
    negated, same_others = surrogate(params, Batch(played, -advantage, target))
    up, _ = surrogate(params, Batch(played, advantage, target))
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(down)) > 1e-2
    for a, b in zip(jax.tree.leaves(down), jax.tree.leaves(negated), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)
    assert same_bytes(others, same_others)
    assert set(others) == {"value_loss", "entropy"}
    assert not same_bytes(down, up)


def test_weights_scale_the_surrogate_place_by_place(surrogate, parts):
    """At unchanged parameters the surrogate is linear in the weights."""
    params, played = part(parts.params, 0), part(parts.played, 0)
    rng = np.random.default_rng(5)
    advantage = jnp.asarray(rng.normal(size=played.done.shape), jnp.float32)
    weights = jnp.asarray(rng.normal(size=(2, *played.weight.shape)), jnp.float32)

    def gradient(weight):
        return surrogate(params, Batch(played._replace(weight=weight), advantage, advantage))[0]

    both = jax.tree.map(jnp.add, gradient(weights[0]), gradient(weights[1]))
    for a, b in zip(jax.tree.leaves(gradient(weights.sum(axis=0))), jax.tree.leaves(both), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def learn(lbrdiv):
    """Of one policy."""
    return compiled(lbrdiv.population.ppo.learn)


@pytest.fixture(scope="module")
def learned(lbrdiv, parts) -> tuple[Any, Any, dict[str, Any]]:
    """Both parts at once."""
    return compiled(jax.vmap(lbrdiv.population.ppo.learn))(*parts, jax.random.split(jax.random.key(8), 2))


def test_policies_that_learn_at_once_learn_as_each_alone(learn, parts, learned):
    keys = jax.random.split(jax.random.key(8), 2)
    for number in range(2):
        expected = learn(*part(parts, number), keys[number])
        for a, b in zip(jax.tree.leaves(part(learned, number)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5)
        assert not same_bytes(expected[0], part(parts.params, number))


def test_a_negative_weight_lowers_the_return(lbrdiv, parts, learned):
    """Of the two policies the first plays the rewarded action more often than before, the second less often."""
    obs = observe(LAYOUT, np.asarray(parts.played.record[0, 0]), EGO)[None]

    def probability(params):
        hidden, reset = jnp.zeros((obs.shape[1], 8)), jnp.ones(obs.shape[:2], bool)
        outputs: Any = lbrdiv.population.network.apply(params, hidden, obs, reset)
        return jax.nn.softmax(outputs[1])[..., REWARDED].mean()

    probability = compiled(jax.vmap(probability))
    change = np.asarray(probability(learned[0]) - probability(parts.params))
    assert change[0] > 0.005
    assert change[1] < -0.005


# A whole update.


class Updated(NamedTuple):
    population: Population
    update: Any
    before: PopulationState
    after: PopulationState
    metrics: dict[str, float]
    seats: Seats  # of the roll-out made anew
    rollout: Rollout


def updated(algorithm: Algorithm) -> Updated:
    """The second update, in which the warm-up of the learning rate is over; its roll-out once more by itself."""
    whole = population(algorithm)
    update = compiled(whole.update)
    before, _ = update(compiled(whole.init)(jax.random.key(5)))
    after, metrics = update(before)

    def again(state):
        rolling = jax.random.split(jax.random.fold_in(state.key, state.update), 3)[0]
        players, restart = whole._players(state.params), whole._restart(state.visited)
        return roll_out(whole.env, players, state.seats, EPISODE, rolling, restart)

    seats, rollout = compiled(again)(before)
    return Updated(whole, update, before, after, {n: float(v) for n, v in metrics.items()}, seats, rollout)


@pytest.fixture(scope="module")
def comedi() -> Updated:
    return updated(CoMeDi())


@pytest.fixture(scope="module")
def lbrdiv() -> Updated:
    return updated(LBRDiv(2))


@pytest.fixture(params=["comedi", "lbrdiv"])
def either(request) -> Updated:
    return request.getfixturevalue(request.param)


def test_an_update_is_a_pure_function_of_the_state(either):
    assert same_bytes(either.update(either.before)[0], either.after)
    other = either.update(either.before._replace(key=jax.random.key(77)))[0]
    assert not same_bytes(other.params, either.after.params)
    later = either.update(either.before._replace(update=jnp.int32(5)))[0]
    assert not same_bytes(later.params, either.after.params)


def test_the_state_moves_on(either):
    assert int(either.after.update) == 2
    assert same_bytes(either.after.key, either.before.key)
    np.testing.assert_array_equal(either.after.seats.env.record, either.seats.env.record)
    np.testing.assert_array_equal(either.after.seats.env.episode, 2)


def test_all_learning_policies_change_and_no_other(either):
    learning = either.population.seating.learning
    for number in range(either.population.seating.policies):
        same = same_bytes(part(either.before.params, number), part(either.after.params, number))
        assert same == (number >= learning)


def test_untrained_policies_differ(either):
    flat = [np.concatenate([w[n].ravel() for w in jax.tree.leaves(either.before.params)]) for n in range(2)]
    assert np.abs(flat[0] - flat[1]).max() > 0.1


def test_metrics_tell_self_play_from_cross_play(either):
    seating, done = either.population.seating, np.asarray(either.rollout.done)
    returns = np.asarray(either.rollout.returns)
    fresh, kin = seating.starts_from < 0, seating.policy[0] % 2 == seating.policy[1] % 2
    assert done[-1].all()
    assert either.metrics["episodes"] == seating.tables
    np.testing.assert_allclose(either.metrics["self_play"], returns[-1][kin & fresh].mean(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(either.metrics["cross_play"], returns[-1][~kin].mean(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(either.metrics["shaping"], 1 - 96 / CONFIG.shaping_horizon, rtol=1e-6)


def test_an_update_learns_each_policys_sequences_with_its_weights_and_partners(lbrdiv, learn):
    """Policy by policy, each from its own places of the roll-out."""
    whole, before = lbrdiv.population, lbrdiv.before
    seating = whole.seating
    key = jax.random.split(jax.random.fold_in(before.key, before.update), 3)[1]
    keys = jax.random.split(jax.random.fold_in(key, 0), 4)
    weight = np.asarray(whole._place_weights(before.memory))
    (group,) = whole.groups

    def sequences_of_all(state, seats, rollout):
        last = whole._players(state.params)[0].act(seats.memories[0], seats.env, key)[0].value
        shaping = CONFIG.shaping(state.update)
        return sequences(rollout, 0, group.places.ravel(), state.seats.memories[0], last, shaping)

    everyone = jax.tree.map(np.asarray, compiled(sequences_of_all)(before, lbrdiv.seats, lbrdiv.rollout))
    for number in range(4):
        places = seating.places(number)[0]
        chosen = np.array([group.places.ravel().tolist().index(place) for place in places])
        played = jax.tree.map(lambda leaf, chosen=chosen: leaf[:, chosen], everyone)._replace(
            weight=jnp.asarray(weight[places])[None],
            partner=jnp.asarray(seating.policy[1 - places[0] // seating.tables, places % seating.tables])[None],
        )
        expected = learn(part(before.params, number), part(before.optimizer, number), played, keys[number])[0]
        for a, b in zip(jax.tree.leaves(part(lbrdiv.after.params, number)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=5e-5)


def test_shaped_rewards_count_only_where_a_return_is_raised(lbrdiv):
    whole, before = lbrdiv.population, lbrdiv.before
    lowered = np.asarray(whole._place_weights(before.memory)).reshape(2, -1).T < 0  # (N, 2)
    assert 0 < lowered.sum() < lowered.size
    shaped = np.random.default_rng(8).uniform(size=lbrdiv.rollout.shaped.shape).astype(np.float32)

    @compiled
    def learned(shaped):
        rollout = lbrdiv.rollout._replace(shaped=shaped)
        return whole._learn(before, whole._players(before.params), lbrdiv.seats, rollout, jax.random.key(1))[0]

    params = learned(shaped)
    assert same_bytes(params, learned(np.where(lowered, 0.0, shaped)))
    assert not same_bytes(params, learned(np.where(lowered, shaped, 0.0)))


def test_the_multipliers_follow_the_returns_of_the_tables(lbrdiv):
    seating, returns = lbrdiv.population.seating, np.asarray(lbrdiv.rollout.returns)[-1]
    table = np.full((4, 4), np.nan)
    seen = np.zeros((4, 4), bool)
    for left, right in product((2, 3), (0, 1)):
        table[left, right] = returns[(seating.policy[0] == left) & (seating.policy[1] == right)].mean()
        seen[left, right] = True
    expected = plain_adapt(lbrdiv.before.memory, table, seen, 0.1, 0.01)
    for name, one, other in zip(Multipliers._fields, lbrdiv.after.memory, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6, err_msg=name)


def test_episodes_from_mixed_play_start_where_mixed_play_had_been(comedi):
    """A quarter of the tables starts from states that the third quarter went through in the roll-out before."""
    source = comedi.population.seating.starts_from
    started = np.asarray(comedi.after.seats.env.record)
    visited = np.asarray(comedi.before.visited)
    moved = source >= 0
    assert moved.sum() == 4
    np.testing.assert_array_equal(started[moved], visited[source[moved]])
    env = comedi.after.seats.env
    fresh = np.asarray(compiled(comedi.population.env.first_record)(env.key, env.episode))
    np.testing.assert_array_equal(started[~moved], fresh[~moved])
    assert (started[moved] != fresh[moved]).any(axis=1).all()


def test_a_visited_state_is_one_of_the_tables_own_last_roll_out(comedi):
    record, visited = np.asarray(comedi.rollout.record), np.asarray(comedi.after.visited)
    steps = [(record[:, table] == visited[table]).all(axis=1).nonzero()[0].tolist() for table in range(len(visited))]
    assert all(steps)
    assert len({own[0] for own in steps if len(own) == 1}) > 2, "the step is drawn"
