"""Test how learned teammates act: greedy or sampled actions, memory, both agent slots, and invalid checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, save_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.rollout import policy_player
from icrl4aht_generation.teammates import learned

from icrl4aht_data.errors import OptionError, TaskFormatError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.utils.files import file_hash
from tests.helpers.states import random_records

LAYOUT = get_layout("cramped_up")
WIDTHS = Widths(pointwise=(4,), spatial=(4,), dense=8, gru=8, head=8)
STEPS, ENVS = 5, 3


def save_random_checkpoint(
    folder: Path, layout: Layout = LAYOUT, widths: Widths = WIDTHS, partners: int = 0, seed: int = 0
) -> Any:
    """Save a checkpoint of random parameters with action probabilities far from uniform; return the parameters."""
    network, rng = ActorCritic(widths, partners), np.random.default_rng(seed)
    shapes = jax.eval_shape(lambda key: network.untrained(key, layout.channels), jax.random.key(0))
    params = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32) * 0.5, shapes)
    save_policy(folder, network, params, {"layout": layout.name})
    return params


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    """Return a suite with checkpoints `a`, `b` and `c`.

    Only the critic of `a` receives the partner. Checkpoint `c` is for the layout test_simple.
    """
    root = tmp_path_factory.mktemp("suite")
    save_random_checkpoint(root / "a", partners=4)
    save_random_checkpoint(root / "b", seed=1)
    save_random_checkpoint(root / "c", get_layout("test_simple"))
    return root


def states(steps: int, seed: int) -> np.ndarray:
    """Return random state records, uint8 of shape (steps, ENVS, S)."""
    return random_records(LAYOUT, steps * ENVS, np.random.default_rng(seed)).reshape(steps, ENVS, -1)


def logits_of(params: Any, partners: int, record: np.ndarray, slot: int) -> np.ndarray:
    """Return the logits of the whole actor-critic network on a sequence of states, of shape (T, N, 6)."""
    obs = observe(LAYOUT, record, slot)
    network = ActorCritic(WIDTHS, partners)
    reset = np.arange(len(record))[:, None] == np.zeros(ENVS)
    apply = jax.jit(network.apply)
    outputs: Any = apply(params, network.initial_hidden(ENVS), obs, jnp.asarray(reset))
    return np.asarray(outputs[1], np.float64)


def played_actions(policy: Any, record: np.ndarray, slot: int) -> np.ndarray:
    """Return the actions, of shape (T, N), that a policy takes step by step in N environments with the given states."""
    player = policy_player(Environment(LAYOUT), policy, policy.params, slot, ENVS)
    act = jax.jit(player.act)
    zero = jnp.zeros(ENVS, jnp.int32)
    state = EnvState(jax.random.split(jax.random.key(0), ENVS), zero, zero, jnp.asarray(record[0]))
    memory, actions = player.init(state), []
    for step, now in enumerate(record):
        choice, memory = act(memory, state._replace(record=jnp.asarray(now)), jax.random.key(step))
        actions.append(np.asarray(choice.action))
    return np.array(actions)


@pytest.mark.parametrize("slot", [EGO, TEAMMATE])
def test_greedy_action_is_the_most_probable_given_the_memory_of_the_episode(tmp_path, slot):
    params = save_random_checkpoint(tmp_path / "a", partners=4)
    record = states(STEPS, 2)
    logits = logits_of(params, 4, record, slot)
    actions = played_actions(learned.build_learned(LAYOUT, tmp_path / "a"), record, slot)
    np.testing.assert_array_equal(actions, logits.argmax(axis=-1))
    assert len(np.unique(actions)) > 1


def test_sampled_actions_follow_the_policys_probabilities(suite):
    """Shares of 3,000 sampled actions in one state are within five standard deviations of the probabilities."""
    greedy, sampled = (learned.build_learned(LAYOUT, suite / "b", action) for action in ("greedy", "sampled"))
    record = states(1, 8)[:, :1]
    params = {"params": save_random_checkpoint(suite.parent / f"{suite.name}-b", seed=1)["params"]}
    logits = logits_of(params, 0, np.repeat(record, ENVS, axis=1), TEAMMATE)[0, 0]
    probability = np.exp(logits) / np.exp(logits).sum()
    obs, keys = observe(LAYOUT, record[0, 0], TEAMMATE), jax.random.split(jax.random.key(1), 3000)

    def draw_actions(policy):
        many = jax.vmap(policy.act, in_axes=(None, None, None, 0))
        hidden = policy.init(policy.params, jax.random.key(0))
        return np.asarray(jax.jit(many)(policy.params, hidden, obs, keys)[0])

    shares = np.bincount(draw_actions(sampled), minlength=len(ACTIONS)) / 3000
    bound = 5 * (probability * (1 - probability) / 3000) ** 0.5 + 1e-3
    assert (np.abs(shares - probability) < bound).all()
    assert np.sort(probability)[-2] > 0.05
    np.testing.assert_array_equal(draw_actions(greedy), logits.argmax())


def test_policies_of_different_checkpoints_share_compiled_functions(suite):
    """Checkpoints share a compiled program even if their critics differ."""
    one, other = (learned.build_learned(LAYOUT, suite / name) for name in "ab")
    elsewhere = learned.build_learned(get_layout("test_simple"), suite / "c")
    assert one.init is other.init is elsewhere.init
    assert one.act is other.act is elsewhere.act
    assert one.sees == "observation"
    assert jax.tree.map(jnp.shape, one.params) == jax.tree.map(jnp.shape, other.params)
    assert learned.build_learned(LAYOUT, suite / "a", "sampled").act is not one.act


def test_checkpoint_of_another_layout_raises_error_with_both_shapes(suite):
    """Observations have 35 channels on cramped_up and 41 channels on test_simple."""
    with pytest.raises(OptionError) as error:
        learned.build_learned(LAYOUT, suite / "c")
    text = str(error.value)
    for part in (str(suite / "c"), "does not fit cramped_up", "5 x 5 x 35", "(41, 4)", "expected", "(35, 4)"):
        assert part in text
    assert "gru" not in text, "the error names only arrays that differ"
    learned.build_learned(get_layout("cramped_down"), suite / "a")


@pytest.mark.parametrize("missing", [POLICY_CARD, POLICY_WEIGHTS, "."])
def test_incomplete_checkpoint_raises_error_with_expected_files(tmp_path, missing):
    folder = tmp_path / "gone"
    if missing != ".":
        save_random_checkpoint(folder)
        (folder / missing).unlink()
    with pytest.raises(OptionError, match=rf"gone: not a checkpoint .*expected {POLICY_WEIGHTS} and {POLICY_CARD}"):
        learned.build_learned(LAYOUT, folder)


def test_checkpoint_with_another_hash_than_the_task_raises_error(suite):
    theta = {"checkpoint": "b", "sha256": file_hash(suite / "a" / POLICY_WEIGHTS)}
    other = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0, "theta": theta}
    with pytest.raises(TaskFormatError, match=f"sha256 {file_hash(suite / 'b' / POLICY_WEIGHTS)}, expected") as error:
        learned.build_learned_entry(LAYOUT, other, suite)
    assert other["theta"]["sha256"] in str(error.value)
