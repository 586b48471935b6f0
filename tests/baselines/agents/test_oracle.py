"""The scripted ego: never its own undoing, and better than H4 in its seat."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from baselines.agents.egos import get_agent
from baselines.evaluate.evaluator import play_tasks
from baselines.evaluate.protocols import PROTOCOLS
from generation.policy import Policy
from generation.teammates.instances import published_tasks, published_thetas
from generation.teammates.registry import build_teammate
from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS
from icrl4aht_data.overcooked.actions import EGO, STAY
from icrl4aht_data.overcooked.layouts import COOKED, LAYOUTS, Layout
from icrl4aht_data.overcooked.rules import CORRECT, PRESSED, WRONG, step
from icrl4aht_data.overcooked.state import ingredient_count, unpack

SHORT = dataclasses.replace(PROTOCOLS["seeded"], episodes=4)
TASKS = [task for track in TRACKS for task in published_tasks(track)]

# One family a layout, chosen so that the ego meets teammates that cook, block, deliver only, and wander.
PLACES = {
    "coord_simple": "H4",
    "coord_ring": "H2",
    "test_simple": "H3",
    "test_wide": "H1",
    "demo_simple": "H1",
    "demo_wide": "H2",
    "asymm_right": "H3",
    "cramped_down": "H3",
}


def h4(layout: Layout) -> Policy:
    """The heuristic H4 in the ego's seat."""
    theta = published_thetas(layout.name, "utility_greedy")[0]
    return build_teammate(layout, {"family": "utility_greedy", "theta": theta}, EGO)


@cache
def episodes(agent: str, layout: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """records uint8 (N, T, S), actions (N, T, 2), rewards (N, T)."""
    tasks = [t for t in TASKS if t.layout.name == layout and t.teammate_family == PLACES[layout]]
    make = h4 if agent == "h4" else get_agent(agent)
    played = list(play_tasks(make, tasks, SHORT))
    record, actions, reward = (np.concatenate([np.asarray(p[k]) for p in played]) for k in range(3))
    return record, actions, reward


@pytest.mark.parametrize("layout", PLACES)
def test_it_never_presses_and_never_delivers_wrongly(layout):
    record, actions, _ = episodes("oracle", layout)
    events = step(LAYOUTS[layout], record, actions, record[..., 6]).events[..., EGO]
    assert not (events & (PRESSED | WRONG)).any()


@pytest.mark.parametrize("layout", ["coord_simple", "test_simple"])
def test_it_stays_where_the_rooms_share_nothing(layout):
    assert (episodes("oracle", layout)[1][..., EGO] == STAY).all()


@pytest.mark.parametrize("layout", ["test_wide", "asymm_right", "cramped_down"])
def test_it_gets_more_than_h4_in_its_seat(layout):
    oracle, other = (episodes(agent, layout)[2].sum(axis=1).mean() for agent in ("oracle", "h4"))
    assert oracle > other


def test_it_delivers_dishes_that_the_teammate_leaves_on_shared_counters():
    """On coord_ring H2's counter-parker plates soups and never delivers; the ego has no pot of its own."""
    record, actions, _ = episodes("oracle", "coord_ring")
    delivered = step(LAYOUTS["coord_ring"], record, actions, record[..., 6]).events[..., EGO] & CORRECT > 0
    assert delivered.sum() > 0


def test_it_never_splits_a_recipe_over_two_pots():
    layout = LAYOUTS["test_wide"]  # the teammate reaches no ingredient of any recipe: both pots are the ego's work
    state = unpack(layout, episodes("oracle", "test_wide")[0])
    contents = state.pot_items & (0xFF - COOKED)
    begun = (ingredient_count(contents) > 0) & (ingredient_count(contents) < 3)
    fits = (_counts(contents) <= _counts(state.recipe)[..., None, :]).all(axis=-1)
    assert (begun & fits).any()
    assert (begun & fits).sum(axis=-1).max() == 1


def _counts(items: np.ndarray) -> np.ndarray:
    return (items[..., None] >> np.array([2, 4, 6]) & 3).astype(int)


def test_chance_plays_no_part_in_it():
    """The same states and another key give the same actions."""
    import jax
    import jax.numpy as jnp

    layout = LAYOUTS["demo_wide"]
    policy = get_agent("oracle")(layout)
    memory = policy.init(policy.params, jax.random.key(0))
    record = jnp.asarray(episodes("oracle", "demo_wide")[0][0, 0])
    assert (
        policy.act(policy.params, memory, record, jax.random.key(1))[0]
        == policy.act(policy.params, policy.init(policy.params, jax.random.key(2)), record, jax.random.key(3))[0]
    )


def test_families_are_all_met():
    assert set(PLACES.values()) == set(HEURISTIC_KINDS.values())
