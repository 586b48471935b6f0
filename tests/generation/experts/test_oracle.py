"""Test the scripted oracle ego: it makes no wrong deliveries and earns more than the heuristic H4 as the ego."""

from __future__ import annotations

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import AGENTS
from icrl4aht_baselines.evaluate.evaluator import play_tasks
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_tasks, published_teammates
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.overcooked.actions import EGO, STAY
from icrl4aht_data.overcooked.cells import COOKED
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.rules import CORRECT, PRESSED, WRONG, step
from icrl4aht_data.overcooked.state import ingredient_count, unpack
from tests.helpers.layout_params import layout_params

SHORT = dataclasses.replace(PROTOCOLS["seeded"], episodes=2)
TASKS = [task for track in TRACKS for task in published_tasks(track)]

FAMILY_ON = {
    # One family for each layout. The tests cover teammates that cook, block the ego, only deliver, or wander.
    "coord_simple": "H4",
    "coord_ring": "H2",
    "test_simple": "H3",
    "test_wide": "H1",
    "demo_simple": "H1",
    "demo_wide": "H2",
    "asymm_right": "H3",
    "cramped_down": "H3",
}
QUICK = ["asymm_right"]


def h4_ego(layout: Layout) -> Policy:
    """Return the heuristic H4 in the ego's slot."""
    return build_teammate(layout, published_teammates(layout.name, "utility_greedy")[0], EGO)


@cache
def episodes(agent: str, layout: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return records, actions and rewards of a layout's N episodes, of shapes (N, T, S), (N, T, 2) and (N, T)."""
    tasks = [t for t in TASKS if t.layout.name == layout and t.teammate_family == FAMILY_ON[layout]]
    make = h4_ego if agent == "h4" else AGENTS[agent]
    played = list(play_tasks(make, tasks, SHORT))
    record, actions, reward = (np.concatenate([np.asarray(p[k]) for p in played]) for k in range(3))
    return record, actions, reward


@pytest.mark.parametrize("layout", layout_params(QUICK, FAMILY_ON))
def test_oracle_never_presses_buttons_or_delivers_wrong_dishes(layout):
    record, actions, _ = episodes("oracle", layout)
    events = step(LAYOUTS[layout], record, actions, record[..., 6]).events[..., EGO]
    assert not (events & (PRESSED | WRONG)).any()


@pytest.mark.parametrize("layout", layout_params(QUICK, ["coord_simple", "test_simple"]))
def test_oracle_stays_if_the_agents_can_share_no_items(layout):
    assert (episodes("oracle", layout)[1][..., EGO] == STAY).all()


@pytest.mark.parametrize("layout", layout_params(QUICK, ["test_wide", "asymm_right", "cramped_down"]))
def test_oracle_earns_more_than_h4_in_the_same_slot(layout):
    oracle, other = (episodes(agent, layout)[2].sum(axis=1).mean() for agent in ("oracle", "h4"))
    assert oracle > other


@pytest.mark.slow
def test_oracle_delivers_dishes_that_the_teammate_put_on_counters():
    """On coord_ring the H2 teammate plates soups without delivering them, and the ego cannot reach a pot."""
    record, actions, _ = episodes("oracle", "coord_ring")
    delivered = step(LAYOUTS["coord_ring"], record, actions, record[..., 6]).events[..., EGO] & CORRECT > 0
    assert delivered.sum() > 0


@pytest.mark.slow
def test_oracle_fills_only_one_pot_at_a_time():
    layout = LAYOUTS["test_wide"]  # the teammate reaches no ingredient of any recipe, so only the ego fills pots
    state = unpack(layout, episodes("oracle", "test_wide")[0])
    contents = state.pot_items & (0xFF - COOKED)
    begun = (ingredient_count(contents) > 0) & (ingredient_count(contents) < 3)
    fits = (ingredient_counts(contents) <= ingredient_counts(state.recipe)[..., None, :]).all(axis=-1)
    assert (begun & fits).any()
    assert (begun & fits).sum(axis=-1).max() == 1


def ingredient_counts(items: np.ndarray) -> np.ndarray:
    return (items[..., None] >> np.array([2, 4, 6]) & 3).astype(int)


def test_oracle_is_deterministic():
    """The oracle takes equal actions in equal states with different random keys."""
    policy = AGENTS["oracle"](LAYOUTS["asymm_right"])
    record = jnp.asarray(episodes("oracle", "asymm_right")[0][0, 0])
    act = jax.jit(lambda key: policy.act(policy.params, policy.init(policy.params, key), record, key)[0])
    assert act(jax.random.key(1)) == act(jax.random.key(3))
