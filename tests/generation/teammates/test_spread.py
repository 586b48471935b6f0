"""Test how widely different teammates are chosen, the package's list of them, and teammates with random actions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.policy import Noise, Situation
from icrl4aht_generation.teammates import spread as module
from icrl4aht_generation.teammates.distances import (
    INSTANCE_NAMES,
    act_on_records,
    common_states,
    distances_to_tests,
)
from icrl4aht_generation.teammates.draws import DIVERSE_DISTANCE, find_draw
from icrl4aht_generation.teammates.heuristics.heuristic import RANDOM_ACTIONS, Heuristic, Sampling
from icrl4aht_generation.teammates.preference import WATCHER
from icrl4aht_generation.teammates.registry import HEURISTIC_FAMILIES, build_teammate, check_theta, sample_teammate
from icrl4aht_generation.teammates.spread import (
    MOST_CHOSEN,
    LayoutSpread,
    SpreadTeammate,
    choose_spread,
    find_measured,
    read_spread,
    spread_candidates,
    spread_rows,
    spread_teammates,
)

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM, SPREAD_SEED, TESTED_ON
from icrl4aht_data.benchmark.tasks import teammate_id
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.layouts import get_layout

POINTS = np.array([0.0, 0.3, 0.35, 1.0, 0.05])
DISTANCES = abs(POINTS[:, None] - POINTS)


def make_teammate(split: str, theta_id: int, oracle: float = 30.0) -> SpreadTeammate:
    theta = {"w_deliver": float(theta_id)}
    return SpreadTeammate(split, "utility_greedy", theta_id, theta, "H4/t0", 0.5, "H1/t2", 0.4, 0.25, 0.0, 1.0, oracle)


@pytest.fixture
def small_spread(monkeypatch) -> LayoutSpread:
    """Replace the shipped list by two training teammates and one validation teammate on demo_wide."""
    chosen = (make_teammate("train", 3), make_teammate("validation", 7), make_teammate("train", 1))
    spread = LayoutSpread("demo_wide", 9, 6, 5, chosen)
    monkeypatch.setattr(module, "_bundled_spreads", lambda: {"demo_wide": spread})
    return spread


def test_the_farthest_candidate_is_chosen_next():
    """Of points on a line, 0 and 1 are chosen first, then 0.35; the point 0.05 is too near 0."""
    assert choose_spread(DISTANCES, 0.1, 9) == ([0, 3, 2], [1.0, 1.0, pytest.approx(0.35)])
    assert choose_spread(DISTANCES, 0.04, 9)[0] == [0, 3, 2, 4, 1]
    assert choose_spread(DISTANCES, 0.05, 2)[0] == [0, 3]
    assert choose_spread(DISTANCES[:0, :0], 0.1, 9) == ([], [])
    assert choose_spread(np.zeros((2, 2)), 0.1, 9) == ([0], [1.0])


def test_spread_candidates_are_distinct_and_valid():
    found = spread_candidates()
    assert {entry["base_seed"] for entry in found} == {SPREAD_SEED}
    assert len({(entry["family"], entry["theta_id"]) for entry in found}) == len(found)
    assert all(0 <= entry["theta_id"] < 500 for entry in found)  # with larger ids, two tasks could have the same seed
    assert {entry["family"] for entry in found} == set(HEURISTIC_FAMILIES)
    assert teammate_id(WATCHER) in {teammate_id(entry) for entry in found}
    for entry in found:
        check_theta(entry)


def test_spread_teammates_are_returned_in_order_of_the_list(small_spread):
    assert [entry["theta_id"] for entry in spread_teammates("demo_wide", "train", 2)] == [3, 1]
    assert spread_teammates("demo_cook_wide", "validation", 1) == [small_spread.chosen[1].entry]
    assert spread_teammates("demo_simple", "train", 0) == []
    assert small_spread.chosen[0].entry["theta"] == {"w_deliver": 3.0}


def test_request_for_too_many_spread_teammates_raises_error(small_spread):
    numbers = "demo_wide: 2 validation teammates requested .* has 1: 6 of 9 candidates differ .* and 5 of these"
    with pytest.raises(OptionError, match=numbers):
        spread_teammates("demo_wide", "validation", 2)
    with pytest.raises(OptionError, match="no line for demo_simple"):
        spread_teammates("demo_simple", "train", 1)
    with pytest.raises(UnknownNameError, match="training layout 'asymm_right'"):
        read_spread("asymm_right")


def test_measured_values_are_looked_up_by_teammate_entry(small_spread):
    found = find_measured("demo_wide", small_spread.chosen[1].entry)
    assert found is not None
    assert (found.behaviour, found.nearest, found.other_distance, found.oracle) == (1, "H4/t0", 0.4, 30.0)
    assert find_measured("demo_simple", small_spread.chosen[1].entry) is None
    assert find_measured("demo_wide", small_spread.chosen[1].entry | {"theta": {"w_deliver": 7.5}}) is None
    assert find_measured("demo_wide", small_spread.chosen[1].entry | {"theta_id": 2}) is None
    drawn = sample_teammate("assembly_line", 4, "train")
    assert find_measured("demo_wide", drawn) == find_draw("demo_wide", drawn) is not None


def test_spread_table_counts_teammates_and_families(small_spread):
    (row,) = spread_rows([small_spread])
    assert (row["train"], row["validation"], row["candidates"], row["with_headroom"]) == (2, 1, 9, 5)
    assert (row["families"], row["least_distance"], row["least_to_tests"]) == ("H1:0 H2:0 H3:0 H4:3", 0.25, 0.4)


@pytest.mark.parametrize("layout", TESTED_ON)
def test_listed_teammates_differ_by_at_least_the_minimum_distance(layout):
    spread = read_spread(layout)
    assert 0 < len(spread.chosen) <= MOST_CHOSEN
    assert min(mate.separation for mate in spread.chosen) >= DIVERSE_DISTANCE
    assert min(min(mate.distance, mate.other_distance) for mate in spread.chosen) >= DIVERSE_DISTANCE
    separations = [mate.separation for mate in spread.chosen]
    assert separations == sorted(separations, reverse=True)
    assert [k for k, mate in enumerate(spread.chosen) if mate.split == "validation"] == [
        *range(4, len(spread.chosen), 5)
    ]
    candidates = {(entry["family"], entry["theta_id"]): entry["theta"] for entry in spread_candidates()}
    assert spread.tried == len(candidates)
    for mate in spread.chosen:
        assert mate.theta == pytest.approx(candidates[mate.family, mate.theta_id])
        returns = (mate.stay, mate.random, mate.oracle)
        assert max(returns) - min(returns) >= LEAST_HEADROOM or spread.headroom == 0


@pytest.mark.slow
@pytest.mark.usefixtures("optimized_actions")
def test_listed_distances_between_spread_teammates_can_be_measured_again():
    """The test measures two teammates of one family, to compile only this family and the test teammates."""
    layout = get_layout("cramped_up")
    spread = read_spread(layout.name)
    family = "assembly_line"
    chosen = [mate for mate in spread.chosen if mate.family == family and RANDOM_ACTIONS not in mate.theta][:2]
    records, tested = common_states(layout, 4)
    actions = act_on_records(layout, [build_teammate(None, mate.entry) for mate in chosen], records)
    assert (actions[0] != actions[1]).mean() >= DIVERSE_DISTANCE
    for mate, distances in zip(chosen, distances_to_tests(tested, actions), strict=True):
        assert distances[INSTANCE_NAMES.index(mate.nearest)] == pytest.approx(mate.distance, abs=1e-4)
        assert distances.min() == pytest.approx(min(mate.distance, mate.other_distance), abs=1e-4)


def always_interact(params, memory, scene):
    return jnp.int32(5), memory


SIMPLE = Heuristic("simple", lambda key: (), always_interact, {"a": 0.5}, {}, Sampling((), {}), Sampling((), {}), {})


def actions_of(theta: dict[str, float], noise: Noise = "seeded", seed: int = 0, steps: int = 600) -> np.ndarray:
    """Return the actions of the heuristic `SIMPLE` in one episode."""
    policy = SIMPLE.build(None, theta, noise=noise)
    layout = get_layout("cramped_up")
    view = Situation(layout.tables, jnp.zeros(64, jnp.uint8))
    key = jax.random.key(seed)

    def step(memory, _):
        action, memory = policy.act(policy.params, memory, view, key)
        return memory, action

    return np.asarray(jax.lax.scan(step, policy.init(policy.params, key), length=steps)[1])


def test_teammate_acts_randomly_with_the_given_probability():
    assert set(actions_of({"a": 0.5, RANDOM_ACTIONS: 0.0})) == {5} == set(actions_of({"a": 0.5}))
    half, whole = (actions_of({"a": 0.5, RANDOM_ACTIONS: chance}) for chance in (0.5, 1.0))
    assert abs((half != 5).mean() - 0.5 * 5 / 6) < 0.08
    assert all(abs((whole == action).mean() - 1 / 6) < 0.07 for action in range(6))
    np.testing.assert_array_equal(half[half != 5], whole[half != 5])  # both episodes use the same random numbers


def test_random_actions_with_fixed_noise_repeat_in_every_episode():
    theta = {"a": 0.5, RANDOM_ACTIONS: 0.5}
    np.testing.assert_array_equal(actions_of(theta, "fixed", 1), actions_of(theta, "fixed", 2))
    assert (actions_of(theta, "seeded", 1) != actions_of(theta, "seeded", 2)).any()
