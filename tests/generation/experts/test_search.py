"""The scripted searcher: what it knows, and how its returns rise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import oracle
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, task_key
from icrl4aht_generation.experts.search import searcher
from icrl4aht_generation.teammates.preference import WATCHER, all_dishes
from icrl4aht_generation.teammates.registry import build_teammate

from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.layouts import get_layout, with_recipes

EPISODES = 6


@pytest.fixture(scope="module")
def played():
    """Episodes of the searcher and of the oracle beside a teammate that watches, one task for each dish, equal keys."""
    layout = get_layout("asymm_both_plain")
    layouts = [with_recipes(layout, (dish,)) for dish in all_dishes(layout)]
    tasks = len(layouts)
    found = {}
    for name, make in (("search", searcher), ("oracle", oracle)):
        mates = [build_teammate(None, WATCHER)] * tasks
        rollout = EvaluationRollout(layouts, make(layouts), mates, get_protocol("seeded"), np.arange(tasks))
        state = jax.jit(rollout.start)(jnp.stack([task_key(0, "one")] * tasks))
        episode, batches = jax.jit(rollout.episode), []
        for _ in range(EPISODES):
            state, batch = episode(rollout.ego.params, rollout.teammate_params, state)
            batches.append((np.asarray(batch.reward), np.asarray(batch.actions[..., EGO])))
        found[name] = tuple(np.stack(part, axis=1) for part in zip(*batches, strict=True))  # (tasks, episodes, T)
    return found


def test_it_does_not_see_the_dish(played):
    """Tasks that differ in the dish alone are played alike until a dish was paid or refused."""
    reward, actions = played["search"]
    first = int((reward.reshape(len(reward), -1) != 0).any(axis=0).argmax())
    assert first > 20
    flat = actions.reshape(len(actions), -1)
    assert (flat[:, : first + 1] == flat[:1, : first + 1]).all()
    assert not (flat == flat[:1]).all()


def test_it_tries_remembers_and_repeats(played):
    """Each dish is refused at most once; after the first paid one there is no refusal, and it earns what the oracle
    does but for the way on which it was when it learned."""
    reward = played["search"][0].reshape(len(played["search"][0]), -1)
    for own in reward:
        paid = int((own > 0).argmax())
        assert (own < 0).sum() <= len(reward) - 1
        assert not (own[paid:] < 0).any()
    returns = {name: reward.sum(axis=2) for name, (reward, _) in played.items()}
    assert returns["search"][:, 0].mean() < returns["oracle"][:, 0].mean() - 20
    np.testing.assert_array_equal(returns["search"][:, -2:], returns["oracle"][:, -2:])
